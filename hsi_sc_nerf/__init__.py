"""Hyperspectral 3D reconstruction of turntable captures: a nerfstudio plugin.

What notebooks need has its name here, and is imported when it is first used (docs/how-to/python.md).
"""

from importlib import import_module
from typing import Any

__version__ = "0.3.0"

_API = {
    "load_scene": "simulate.scene",
    "simulate_session": "simulate.session",
    "inspect_session": "inspection.inspect",
    "process_session": "processing.process",
    "open_dataset": "packed.dataset:open_packed",
    "open_run": "api.runs",
    "read_cloud": "api.clouds",
    "from_xarray": "export.table",
    "read_calibration": "analysis.calibrations",
    "read_library": "analysis.library",
    "read_drawn_regions": "analysis.drawn_regions",
    "write_drawn_regions": "analysis.drawn_regions",
    "propose_regions": "analysis.drawn_regions",
    "write_library": "analysis.library",
    "traits": "analysis.measurement:measure_traits",
    "write_traits": "analysis.measurement_files:write_measurement",
    "find_indices": "indices.catalogue",
    "days_on_one_mesh": "analysis.change_days",
    "compare_days": "analysis.change",
    "read_reference": "evaluation.comparison",
    "compare": "evaluation.comparison",
    "write_report": "report.build",
    "read_table": "batch.tables",
}
"""Module of each name; behind a colon its name there, where that is another one."""


def __getattr__(name: str) -> Any:
    if name not in _API:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, own_name = _API[name].partition(":")
    return getattr(import_module(f"{__name__}.{module}"), own_name or name)


def __dir__() -> list[str]:
    return [*globals(), *_API]
