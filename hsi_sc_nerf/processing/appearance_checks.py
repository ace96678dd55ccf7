"""Does the object look the same in all frames, and does its spectrum have the right order of bands? As findings.

Masks and markers show neither a shadow on one frame nor an object that slipped on the disc: a shadow does not change
the outline, and a body of revolution has one outline from all sides. The brightness of the points on the masks' hull
shows both (`PointViews`), after the part that depends on the direction a point faces is removed: that part is light
that is stationary in the camera's frame.

A header that lists the wavelengths in reverse mirrors every spectrum. The counts do not show it, because lamp and
detector are weak at both ends. The object does: biological tissue absorbs blue light and scatters near-infrared
light, and so do most pigments, also blue ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.stats import median_abs_deviation

from hsi_sc_nerf.findings import Finding, Level, leave_out, names_in_short
from hsi_sc_nerf.poses.turntable import rotations_about_z
from hsi_sc_nerf.processing.view_changes import PointViews, facing_cell, mean_by_index

LEVEL_AMBER, LEVEL_RED = 0.04, 0.15
"""Deviation of a frame's brightness (logarithm) from the other frames, above that of good sessions
(docs/validation/masks.md)."""
PATCH_AMBER, PATCH_RED, PATCH_TIMES = 0.06, 0.2, 3.0
"""The same for parts of a frame (root mean square over directions). It must also exceed that of a typical frame by a
factor, because noise and a rough hull change all frames."""
LEAST_IN_PATCH = 15
"""Fewest points of a part."""
FEW = 0.1
"""Up to this fraction of the frames, those with different light are to be left out."""
LEAST_FRAMES, LEAST_SHARED = 6, 200
"""Fewest frames with which one can be compared, and fewest points that two frames must share."""
SLIPS_DEG = np.arange(-30.0, 30.1, 1.5)
"""Turns of the object on the disc that are tried."""
LEAST_SLIP_DEG, SLIP_FIT = 3.0, 0.65
"""Least angle of a slip, and the fraction of two frames' difference that may remain with it. It is below that of good
sessions, in which another part of a plain object may look the same by chance."""
MOST_SLIPS, ONE_DIRECTION = 0.5, 0.8
"""If more of the pairs seem to slip, nearly all in one direction, the object is smooth and reflections are
stationary."""
MATCHED_M = 0.003
"""Largest distance of points that are compared."""
LARGEST_SIGMAS = 3.0
"""Differences are limited to this many standard deviations: highlights do not move with the object."""
LEAST_SCATTER = 0.003
"""Scatter of a channel (logarithm) that is stated at least."""
_ROUNDS = 12
BLUE_NM, INFRARED_NM = (430.0, 500.0), (850.0, 970.0)
"""Within 400 to 1000 nm, the range of silicon, each is about the mirror image of the other."""
ORDER_AMBER, ORDER_RED = 1.3, 2.0
"""Reflectance in the blue over that in the infrared; 1 for white and grey things, less for tissue."""
LEAST_BLUE = 0.1
"""In darker objects, noise and stray light may exceed the reflectance."""


def check_appearance(views: PointViews, names: Sequence[str]) -> list[Finding]:
    """The findings ``frames-light`` and ``frames-slip``, where something is wrong.

    Args:
        views: points of the object as the frames see them.
        names: names of all frames.

    Example:
        >>> refuse_red(check_appearance(point_views(bins, masks, poses, lens, distortion, hull), names))
    """
    if len(np.unique(views.frame)) < LEAST_FRAMES:
        return []
    channels = without_stationary_light(views)
    light = _frames_light(views, channels, names)
    # A frame in shade matches no other frame, whatever the slip.
    shaded = {name for finding in light if finding.level == "red" for name in finding.values}
    return [*light, *_frames_slip(views, channels, names, shaded)]


def without_stationary_light(views: PointViews) -> Float[np.ndarray, "n channels"]:
    """Logarithm of each view's brightness and of its colours over it, without what its direction explains."""
    log = np.log(np.maximum(views.reflectance, 1e-3))
    brightness = log.mean(axis=1, keepdims=True)
    channels = np.concatenate([brightness, log - brightness], axis=1)
    cell, points = facing_cell(views), len(views.positions_m)
    of_cell = np.zeros((cell.max() + 1, channels.shape[1]))
    for _ in range(_ROUNDS):
        of_point = mean_by_index(channels - of_cell[cell], views.point, points)
        of_cell = mean_by_index(channels - of_point[views.point], cell, len(of_cell))
    return channels - of_cell[cell]


def _frames_light(
    views: PointViews, channels: Float[np.ndarray, "n channels"], names: Sequence[str]
) -> list[Finding]:
    """Frames in which the object is brighter or darker than in the others, as a whole or in parts."""
    numbers, cell = np.unique(views.frame), facing_cell(views)
    of_point = mean_by_index(channels[:, 0], views.point, len(views.positions_m))
    rest = channels[:, 0] - of_point[views.point]
    level, patches = np.zeros((2, len(numbers)))
    for row, number in enumerate(numbers):
        own, cells = rest[views.frame == number], cell[views.frame == number]
        level[row] = np.median(own)
        large = [c for c in np.unique(cells) if np.count_nonzero(cells == c) >= LEAST_IN_PATCH]
        parts = [float(np.median(own[cells == c]) - level[row]) for c in large]
        patches[row] = np.sqrt(np.mean(np.square(parts))) if parts else 0.0
    level = np.abs(level - np.median(level))
    unusual = PATCH_TIMES * float(np.median(patches))
    odd = (level > LEVEL_AMBER) | (patches > max(PATCH_AMBER, unusual))
    red = (level > LEVEL_RED) | (patches > max(PATCH_RED, unusual))
    if not odd.any():
        return []
    named = np.flatnonzero(red if red.any() else odd)
    changes = {names[numbers[row]]: round(float(max(level[row], patches[row])), 4) for row in named}
    percent = 100.0 * -np.expm1(-max(changes.values()))
    sentence = (
        f"The light on the object in {names_in_short([*changes])} differs from that in the other frames by up to "
        f"{percent:.0f} %: a shadow fell on it, or a lamp changed or moved"
    )
    few = len(named) < FEW * len(numbers)
    advice = f"leave out with {leave_out([*changes])}" if few else "take the session again under steady lamps"
    return [Finding("frames-light", "red" if red.any() else "amber", f"{sentence}; {advice}.", changes)]


def _frames_slip(
    views: PointViews, channels: Float[np.ndarray, "n channels"], names: Sequence[str], shaded: set[str]
) -> list[Finding]:
    """Successive frames whose points match better where the object is turned on the disc between them."""
    numbers = [number for number in np.unique(views.frame) if names[number] not in shaded]
    if len(numbers) < LEAST_FRAMES:
        return []
    pairs = list(zip(numbers, [*numbers[1:], numbers[0]], strict=True))
    by_frame = {number: np.flatnonzero(views.frame == number) for number in numbers}
    scatter = _scatter(views, channels, [(by_frame[a], by_frame[b]) for a, b in pairs])
    if scatter is None:
        return []
    slipped = {}
    for first, second in pairs:
        slip_deg, fit = slip_between(views, channels / scatter, by_frame[first], by_frame[second])
        if fit < SLIP_FIT and abs(slip_deg) >= LEAST_SLIP_DEG:
            slipped[f"{names[first]} to {names[second]}"] = slip_deg
    directions = np.sign([*slipped.values()])
    if not slipped or (len(slipped) > MOST_SLIPS * len(pairs) and abs(directions.mean()) > ONE_DIRECTION):
        return []
    slips = ", ".join(f"{pair} (by about {abs(deg):.0f} degrees)" for pair, deg in list(slipped.items())[:3])
    sentence = (
        f"The object slipped on the disc from {slips}: its texture moved differently from the markers; fasten it and "
        "take the session again, or leave out the frames before or after with --exclude."
    )
    return [Finding("frames-slip", "red", sentence, {"slip_deg": slipped})]


def _scatter(
    views: PointViews, channels: np.ndarray, pairs: Sequence[tuple[np.ndarray, np.ndarray]]
) -> Float[np.ndarray, "channels"] | None:
    """Usual scatter of the channels between neighbouring points of successive frames; None with too few points."""
    found = []
    for first, second in pairs:
        tree = cKDTree(views.positions_m[views.point[first]])
        change = _change(views, channels, tree, first, second, float(SLIPS_DEG[len(SLIPS_DEG) // 2 + 1]))
        if change is not None:
            found.append(median_abs_deviation(change, scale="normal"))
    return np.maximum(np.median(found, axis=0), LEAST_SCATTER) if found else None


def slip_between(
    views: PointViews, channels: Float[np.ndarray, "n channels"], first: np.ndarray, second: np.ndarray
) -> tuple[float, float]:
    """Turn of the object about the axis from one frame to another by which its points fit best.

    Args:
        views: all of them.
        channels: channels of each, in units of their scatter.
        first, second: rows of the two frames.

    Returns:
        Degrees, counter-clockwise from above; and the difference that is left, over that without a slip.
    """
    tree, differences = cKDTree(views.positions_m[views.point[first]]), []
    for slip_deg in SLIPS_DEG:
        change = _change(views, channels, tree, first, second, float(slip_deg))
        differences.append(np.inf if change is None else float(np.minimum(change**2, LARGEST_SIGMAS**2).mean()))
    none, best = len(SLIPS_DEG) // 2, int(np.argmin(differences))
    if not np.isfinite(differences[none]):
        return 0.0, 1.0
    return float(SLIPS_DEG[best]), differences[best] / max(differences[none], 1e-12)


def _change(
    views: PointViews,
    channels: Float[np.ndarray, "n channels"],
    tree: cKDTree,
    first: np.ndarray,
    second: np.ndarray,
    slip_deg: float,
) -> Float[np.ndarray, "k channels"] | None:
    """Change of the object's points from frame to frame, their median left out; None with too few points.

    ``tree`` holds the points of the first frame.
    """
    # What is now at a point was before at the point that the slip brings there.
    before = rotations_about_z(np.deg2rad([-slip_deg]))[0]
    points = views.positions_m[views.point[second]] @ before.T
    distance_m, nearest = tree.query(points, distance_upper_bound=MATCHED_M)
    near = np.isfinite(distance_m)
    if near.sum() < LEAST_SHARED:
        return None
    change = channels[second[near]] - channels[first[nearest[near]]]
    return change - np.median(change, axis=0)


def check_band_order(
    spectrum: Float[np.ndarray, "bands"], wavelengths_nm: Float[np.ndarray, "bands"]
) -> list[Finding]:
    """The finding ``band-order`` where the object is far brighter in the blue than in the infrared.

    Args:
        spectrum: the object's mean reflectance.
        wavelengths_nm: wavelengths of its bands.

    Example:
        >>> check_band_order(np.array([0.6, 0.1]), np.array([450.0, 900.0]))[0].level
        'red'
    """
    in_blue, in_infrared = (
        (wavelengths_nm >= low) & (wavelengths_nm <= high) for low, high in (BLUE_NM, INFRARED_NM)
    )
    if not (in_blue.any() and in_infrared.any()):
        return []
    blue, infrared = float(spectrum[in_blue].mean()), float(spectrum[in_infrared].mean())
    ratio = blue / max(infrared, 1e-3)
    if blue < LEAST_BLUE or ratio <= ORDER_AMBER:
        return []
    level: Level = "red" if ratio > ORDER_RED else "amber"
    sentence = (
        f"The object reflects {100.0 * blue:.0f} % from {BLUE_NM[0]:g} to {BLUE_NM[1]:g} nm and "
        f"{100.0 * infrared:.0f} % from {INFRARED_NM[0]:g} to {INFRARED_NM[1]:g} nm, unlike plants and nearly all "
        "pigments: the headers probably list the wavelengths in reverse; compare them with a leaf, which is dark at "
        "680 nm and bright from 750 nm, and correct them."
    )
    return [Finding("band-order", level, sentence, {"blue_over_infrared": ratio})]
