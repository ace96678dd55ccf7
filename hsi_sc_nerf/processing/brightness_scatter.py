"""How much the brightness of points scatters from frame to frame, beside the texture that all frames agree on.

Glints and noise that all bands share differ in every frame. A field that resolves more than a pixel has a place of
its own for nearly every ray, and learns them as texture (docs/validation/effects.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from hsi_sc_nerf.processing.view_changes import MOST_CHANGE, Change, PointViews, change_of, mean_by_index

LARGEST_STEP_DEG = 16.0
"""Frames further apart see a point in too different a light to tell what is by chance."""
FEWEST_OF_SECTOR = 30
"""Values of a sector from which its scatter is taken."""
NEIGHBOURS = 4
_MAD_TO_STD = 1.4826


@dataclass(frozen=True)
class BrightnessScatter:
    """Scatter and texture of an object's brightness, as fractions of it.

    Attributes:
        scatter: of a point in one frame, by chance.
        texture: root mean square of what a point differs from its neighbours in all frames alike.
    """

    scatter: Change
    texture: float


def brightness_scatter(
    views: PointViews, camera_to_worlds: Float[np.ndarray, "frames 4 4"]
) -> BrightnessScatter | None:
    """Scatter by the second difference of three successive frames, in which a steady change of the light cancels.

    Args:
        views: points as the frames see them.
        camera_to_worlds: poses of all frames, object frame; z is the turntable's axis.

    Returns:
        None where the frames are more than `LARGEST_STEP_DEG` apart, or hardly any point is seen in three of them.

    Example:
        >>> found = brightness_scatter(seen, dataset.camera_to_worlds)
        >>> found.scatter.rms, found.texture
        (0.025, 0.035)
    """
    frames = np.unique(views.frame)
    azimuth_deg = np.degrees(np.arctan2(camera_to_worlds[frames, 1, 3], camera_to_worlds[frames, 0, 3])) % 360.0
    order = np.argsort(azimuth_deg)
    if len(frames) < 3 or np.median(np.diff(azimuth_deg[order])) > LARGEST_STEP_DEG:
        return None
    place = np.empty(len(frames), int)
    place[order] = np.arange(len(frames))
    count, brightness = len(views.positions_m), views.reflectance.mean(axis=1)
    seen = np.full((count, len(frames)), np.nan)
    seen[views.point, place[np.searchsorted(frames, views.frame)]] = brightness
    scale = np.maximum(mean_by_index(brightness, views.point, count), 1e-3)[:, None]

    relative = seen / scale
    bend = relative - (np.roll(relative, 1, axis=1) + np.roll(relative, -1, axis=1)) / 2.0
    variances, sizes = [], []
    for sector in np.unique(views.sector):
        of_sector = bend[views.sector == sector]
        known = of_sector[np.isfinite(of_sector)]
        if len(known) >= FEWEST_OF_SECTOR:
            deviation = _MAD_TO_STD * np.median(np.abs(known - np.median(known)))
            variances.append(deviation**2 / 1.5)
            sizes.append(len(known))
    texture = _texture(seen, scale, views.positions_m)
    return None if len(sizes) < 2 or texture is None else BrightnessScatter(change_of(variances, sizes), texture)


def _texture(
    seen: Float[np.ndarray, "points frames"],
    scale: Float[np.ndarray, "points 1"],
    positions_m: Float[np.ndarray, "points 3"],
) -> float | None:
    """Root mean square difference of points from their neighbours, without what frames disagree on."""
    near = cKDTree(positions_m).query(positions_m, NEIGHBOURS + 1)[1][:, 1:]
    differences = ((seen - seen[near].mean(axis=1)) / scale).clip(-MOST_CHANGE, MOST_CHANGE)
    known = np.isfinite(differences)
    number = known.sum(axis=1)
    some = number >= 3
    if not some.any():
        return None
    values = np.where(known, differences, 0.0)[some]
    means = values.sum(axis=1) / number[some]
    within = (np.square(values).sum(axis=1) - number[some] * means**2) / (number[some] - 1)
    return float(np.sqrt(max(np.mean(means**2 - within / number[some]), 0.0)))
