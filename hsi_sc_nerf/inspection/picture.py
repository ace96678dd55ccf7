"""The picture of an inspection: every frame with its name, and brightness, sharpness and markers by frame."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib import rc_context

from hsi_sc_nerf.inspection.inspect import Inspection
from hsi_sc_nerf.plotting.figures import COLOURS, STYLE, new_figure, save_figure, show_image

COLUMNS = 12
THUMBNAIL_PX = 112
GAMMA = 1.0 / 2.2


def draw_inspection(inspection: Inspection, path: Path) -> None:
    """Draw the picture.

    Raises:
        InputError: the operating system refused to write.
    """
    looks, session = inspection.looks, inspection.session
    names = [look.name for look in looks]
    red = " ".join(finding.sentence for finding in inspection.findings if finding.level == "red")
    rows = -(-len(looks) // COLUMNS)
    thumbnails = [_thumbnail(np.rot90(look.picture, session.quarter_turns)) for look in looks]
    height, width = thumbnails[0].shape[:2]
    sheet = np.ones((rows * height, COLUMNS * width, 3), np.float32)
    for index, thumbnail in enumerate(thumbnails):
        top, left = index // COLUMNS * height, index % COLUMNS * width
        sheet[top : top + height, left : left + width] = thumbnail
    lines: dict[str, Sequence[float]] = {
        "brightness": [float(look.picture.mean()) for look in looks],
        "sharpness, 1/px": [look.sharpness_per_px for look in looks],
        "markers": [len(seen) for seen in inspection.markers.detections],
    }
    with rc_context(STYLE):
        figure = new_figure(11.0, 1.0 + 11.0 / COLUMNS * rows * height / width + 3.6)
        parts = figure.subplots(1 + len(lines), 1, height_ratios=[max(1.2 * rows, 1.2), 1, 1, 1])
        show_image(parts[0], sheet)
        parts[0].set_title(session.path.resolve().name)
        for index, name in enumerate(names):
            parts[0].text(
                index % COLUMNS * width + 3,
                index // COLUMNS * height + 3,
                name,
                fontsize=6,
                va="top",
                color="white",
                bbox={"color": COLOURS[1] if name in red.replace(",", " ").split() else "0.2", "pad": 1},
            )
        for axes, (label, values) in zip(parts[1:], lines.items(), strict=True):
            axes.plot(values, marker=".", color=COLOURS[0])
            axes.set(ylabel=label, ylim=(0, 1.1 * max(max(values), 1e-9)))
            shown = range(0, len(names), max(1, len(names) // 12))
            labels = [names[index] for index in shown] if axes is parts[-1] else []
            axes.set_xticks(list(shown), labels or [""] * len(shown), rotation=30, ha="right", fontsize=7)
        save_figure(figure, path)


def _thumbnail(picture: np.ndarray) -> np.ndarray:
    """A small picture, brightened as a photograph, with a white border at the right and below."""
    scale = THUMBNAIL_PX / max(picture.shape[:2])
    small = cv2.resize(np.ascontiguousarray(picture), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.pad(np.clip(small, 0.0, 1.0) ** GAMMA, ((0, 3), (0, 3), (0, 0)), constant_values=1.0)
