"""What was rendered, as a table: the views, and how far they are from what was measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hsi_sc_nerf.evaluation.spectral_metrics import spectral_metrics
from hsi_sc_nerf.files import atomic_write, write_json
from hsi_sc_nerf.rendering.comparison_picture import draw_comparison
from hsi_sc_nerf.rendering.cubes import RenderedView

_COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "valid": ("valid pixels, %", lambda share: f"{100.0 * share:.1f}"),
    "sam": ("SAM, rad", "{:.4f}".format),
    "rmse": ("RMSE", "{:.4f}".format),
    "ssim": ("SSIM", "{:.3f}".format),
    "psnr": ("PSNR, dB", "{:.2f}".format),
}


def compare(
    folder: Path, name: str, view: RenderedView, item: Mapping[str, Any], rgb_bands: Sequence[int]
) -> dict[str, float]:
    """Metrics of a rendered frame on the object, and ``NAME.png``, measured and rendered side by side.

    Args:
        folder: where to write the picture.
        name: of the frame.
        view: the rendering.
        item: the frame as `SpectralDataset` gives it.
        rgb_bands: shown as red, green, blue.

    Raises:
        InputError: the picture cannot be written.
    """
    measured, mask, valid = item["spectral"], item["mask"][..., 0].bool(), item.get("valid")
    draw_comparison(folder / f"{name}.png", name, view.spectral, measured, mask, valid, rgb_bands)
    return spectral_metrics(view.spectral, measured, mask, valid)


def write_report(path: Path, rows: Sequence[Mapping[str, Any]], legends: Mapping[str, str]) -> None:
    """Write ``PATH.md``, and ``PATH.json`` beside it.

    Args:
        path: without an ending.
        rows: of each view its name, the share of valid pixels and, where it was measured, metrics.
        legends: of each video what its colours mean.

    Raises:
        InputError: they cannot be written.
    """
    columns = {key: column for key, column in _COLUMNS.items() if key in rows[0]}
    lines = [
        "| view | " + " | ".join(title for title, _ in columns.values()) + " |",
        "| --- |" + " ---: |" * len(columns),
        *(
            f"| {row['view']} | " + " | ".join(shown(row[key]) for key, (_, shown) in columns.items()) + " |"
            for row in rows
        ),
    ]
    if "sam" in columns:
        lines += ["", "Measured against rendered, on the object (masked)."]
    if legends:
        lines += ["", *(f"- `{name}`: {legend}" for name, legend in legends.items())]
    write_json(path.with_suffix(".json"), {"views": [dict(row) for row in rows], "videos": dict(legends)})
    with atomic_write(path.with_suffix(".md")) as (temporary,):
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
