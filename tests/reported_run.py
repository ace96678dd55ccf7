"""An untrained run with the cloud of a ball, with results beside it, and names that would be markup."""

import json
from pathlib import Path

import ball_run
import capture_factory as factory
import numpy as np
from page_of_a_ball import ball

from hsi_sc_nerf.analysis.maps import SurfaceMap
from hsi_sc_nerf.analysis.report import trait_content
from hsi_sc_nerf.analysis.size import Size
from hsi_sc_nerf.analysis.traits import WHOLE, MapMean, MeanAndSd, RegionTraits, Traits
from hsi_sc_nerf.export.cloud import write_spectral_ply
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.report.build import write_report

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&{{ 7 * 7 }}"
COMPARISON = {
    "scores": {
        name: {"threshold_m": at, "precision": 95.0, "recall": 97.5, "f_score": 96.25}
        for name, at in (("chosen", 0.002), ("knee", 0.0015))
    },
    **{
        way: {"mean_m": 1e-3, "median_m": 9e-4, "rms_m": 1.23e-3, "percentile_95_m": 2e-3, "largest_m": 3e-3}
        for way in ("cloud_to_reference", "reference_to_cloud")
    },
    "curves": {"thresholds_m": [0, 0.002], "precision": [0, 95], "recall": [0, 97], "f_score": [0, 96]},
}
TRAITS = trait_content(
    Size(0.0229, 0.25, 0.09, 0.07, 0.068, 0.078),
    {"scale": Size(0.0001, 0.002, 0.0001, 0.0001, 0.0001, 0.0001)},
    True,
    Traits(
        [
            RegionTraits(
                name, 0.02, MeanAndSd(np.full(3, 0.4), np.zeros(3)), {HOSTILE: MapMean(MeanAndSd(0.5, 0.1), 0.1, 0.0)}
            )
            for name in (WHOLE, HOSTILE)
        ],
        maps=[SurfaceMap(HOSTILE, HOSTILE, np.zeros(3), lambda spectra: spectra[:, 0])],
    ),
    {},
)


def write_run(folder: Path) -> Path:
    """Write the run; returns its folder."""
    data = ball_run.write_ball_dataset(folder / "data")
    transforms = (data / "transforms.json").read_text()
    (data / "transforms.json").write_text(transforms.replace('"ball"', json.dumps(HOSTILE)))
    finding = {"name": "white", "level": "amber", "sentence": f"{folder}/session: {HOSTILE}", "values": {}}
    write_json(data / "report" / "inspection.json", {"session": f"{folder}/session", "findings": [finding]})
    run = ball_run.write_untrained_run(data, folder / "runs").parent
    write_spectral_ply(run / "point_cloud.ply", ball(factory.WAVELENGTHS_NM))
    (run / "comparison.json").write_text(json.dumps(COMPARISON))
    (run / "traits.json").write_text(json.dumps(TRAITS))
    return run


def write_page(run: Path) -> Path:
    """Write the run's report; returns its path."""
    write_report(run, run / "report.html", indices=("NDVI", "own = R550 / R670"))
    return run / "report.html"
