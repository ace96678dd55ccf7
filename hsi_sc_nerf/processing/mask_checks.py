"""Checks of foreground masks: against the image's border, each other, and the visual hull of all of them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion
from scipy.stats import median_abs_deviation

from hsi_sc_nerf.findings import Finding, Level, leave_out, names_in_short
from hsi_sc_nerf.processing.visual_hull import VotedHull
from hsi_sc_nerf.robust_scatter import robust_std

MAX_EMPTY_FRACTION = 0.05
"""Fraction of frames without a mask that is tolerated."""
MAX_CUT_FRACTION = 0.3
"""Fraction of a mask's lines that may end at the side of the space where the object may be."""
CUT_LINES, CUT_FRAMES = 0.05, 0.1
"""A part of the object is cut off there where more than this fraction of a mask's lines end so, in more than this
fraction of the frames."""
MAX_CONTRADICTION = 0.04
"""Largest typical difference of mask and hull's silhouette (1 - intersection over union), to which a quarter of a
pixel along the mask's outline is added. Good masks differ too, because the hull is found by vote."""
VOTE_EXCESS = 0.015
"""A narrow or rough object may differ by more. Its limit is the difference of the hull's silhouettes from the hull of
these silhouettes, as consistent masks have it, plus this."""
MAX_ODDITY, ODDITY_SIGMAS = 0.015, 5.0
"""Largest excess of one frame's difference over the typical one, to which an eighth of a pixel is added; and the same
in standard deviations of the frames' differences, for noise frays masks."""
BACKGROUND_SIGMAS = 3.0
"""A pixel shows the same as in the other frames up to this deviation, in their standard deviations."""
STILL_OVERLAP = 0.97
"""Intersection over union of all masks from which they count as stationary."""
STILL_FRACTION = 0.7
"""Fraction of the masks' edge that must not change for it to be the background's."""
PIECES_FRACTION = 0.25
"""Fraction of the frames that show a piece beside the masked ones, from which it is no passing spot."""
STANDING_FRACTION = 0.5
"""Fraction of the lid's middle that is hidden by an object on it."""


def check_masks(
    masks: Bool[np.ndarray, "frames h w"],
    names: Sequence[str],
    hull: VotedHull,
    brightness: Float[np.ndarray, "frames h w"],
    left_out: Bool[np.ndarray, "frames"],
    silhouettes_of: Callable[[Bool[np.ndarray, "frames h w"]], Bool[np.ndarray, "frames h w"]],
    regions: Bool[np.ndarray, "frames h w"] | None = None,
    lid_middles: Bool[np.ndarray, "frames h w"] | None = None,
) -> list[Finding]:
    """Findings on the masks; none for good ones.

    Args:
        hull: hull of the masks.
        left_out: frames with a piece that its mask leaves out (`masks.foreground_masks`).
        silhouettes_of: gives those of the visual hull of other masks.
        regions: pixels that may be the object's (`lid_regions.above_lid`), if the container is known.
        lid_middles: pixels that see the middle of the lid (`lid_regions.lid_middle`), if the container is known.

    Example:
        >>> found = check_masks(masks, names, hull, brightness, left_out, silhouettes_of)
        >>> refuse_red(found, accepted=["masks-border"])
    """
    empty = np.logical_not(masks.any(axis=(1, 2)))
    found = []
    if empty.any():
        without = [name for name, is_empty in zip(names, empty, strict=True) if is_empty]
        level: Level = "red" if empty.mean() > MAX_EMPTY_FRACTION else "amber"
        sentence = (
            f"Nothing of the object was found in {names_in_short(without)}; look at report/masks.png and leave these "
            f"frames out with {leave_out(without)}."
        )
        found.append(Finding("masks-empty", level, sentence, {"frames": without}))
    if empty.all():
        return found
    if left_out.mean() > PIECES_FRACTION:
        sentence = (
            f"{left_out.sum()} of {len(masks)} frames show something else beside the object, apart from it, which "
            "the masks leave out; look at report/masks.png: take it away or, if it is part of the object, count the "
            "object's pieces by --masks.pieces."
        )
        found.append(Finding("masks-pieces", "amber", sentence, {"frames": int(left_out.sum())}))
    return [
        *found,
        *_border(masks[~empty], None if regions is None else regions[~empty]),
        *_still(masks[~empty], brightness, None if lid_middles is None else lid_middles[~empty]),
        *_hull(masks, names, hull, brightness, silhouettes_of),
    ]


def _border(masks: Bool[np.ndarray, "n h w"], regions: Bool[np.ndarray, "n h w"] | None) -> list[Finding]:
    """Masks that the image or the space above the lid cuts off."""
    found = []
    inner = np.zeros(masks.shape[1:], bool)
    inner[1:-1, 1:-1] = True
    touching = (masks & ~inner).any(axis=(1, 2))
    if touching.any():
        level: Level = "red" if touching.mean() > 0.5 else "amber"
        sentence = (
            f"The masks touch the image's border in {touching.sum()} of {len(masks)} frames: the object leaves the "
            "image, or they are the wall's; look at report/masks.png."
        )
        found.append(Finding("masks-border", level, sentence, {"frames": int(touching.sum())}))
    if regions is not None:
        sides = regions & ~binary_erosion(regions, np.ones((1, 1, 3), bool), border_value=1)
        cut = (masks & sides).any(axis=2).sum(axis=1) / masks.any(axis=2).sum(axis=1)
        if np.median(cut) > MAX_CUT_FRACTION:
            sentence = (
                f"The masks end at the side of the space above the lid in {100 * np.median(cut):.0f} % of their "
                "lines: they are the wall's, or the object is wider than --masks.overhang allows; look at "
                "report/masks.png."
            )
            found.append(Finding("masks-cut", "red", sentence, {"lines_fraction": float(np.median(cut))}))
        elif (cut > CUT_LINES).mean() > CUT_FRAMES:
            sentence = (
                f"The masks end at the side of the space above the lid in {(cut > CUT_LINES).sum()} of {len(masks)} "
                "frames, and what of the object reaches beyond it is cut off; raise --masks.overhang, or set the "
                "object on the middle of the lid."
            )
            found.append(Finding("masks-cut", "amber", sentence, {"lines_fraction": float(cut.max())}))
    return found


def _still(
    masks: Bool[np.ndarray, "n h w"],
    brightness: Float[np.ndarray, "frames h w"],
    lid_middles: Bool[np.ndarray, "n h w"] | None,
) -> list[Finding]:
    """Masks that are the same in all frames and show the same at their edge: they are of something stationary.

    A body of revolution has such masks as well, but it stands on the lid and hides its middle. A wall is behind the
    lid.
    """
    if lid_middles is not None and (masks & lid_middles).sum() > STANDING_FRACTION * lid_middles.sum():
        return []
    common, all_of_them = masks.all(axis=0), masks.any(axis=0)
    overlap = common.sum() / all_of_them.sum()
    if len(masks) < 3 or overlap < STILL_OVERLAP:
        return []
    width_px = max(2, round(0.03 * np.sqrt(common.sum())))
    edge = common & ~binary_erosion(common, iterations=width_px)
    # Median absolute differences of successive frames: lamps drift slowly, and a few pixels may flicker.
    change = np.median(np.abs(np.diff(brightness, axis=0)), axis=0)
    still = float((change[edge] <= 2.0 * np.median(change[~all_of_them])).mean())
    if still < STILL_FRACTION:
        return []
    sentence = (
        "The masks and the image at their edge are stationary while the table turns, so they are probably the "
        "wall's; look at report/masks.png and set --masks.threshold, or accept it for a smooth body of revolution on "
        "no known container."
    )
    return [Finding("masks-static", "red", sentence, {"overlap": float(overlap), "still_fraction": still})]


def _hull(
    masks: Bool[np.ndarray, "frames h w"],
    names: Sequence[str],
    hull: VotedHull,
    brightness: Float[np.ndarray, "frames h w"],
    silhouettes_of: Callable[[Bool[np.ndarray, "frames h w"]], Bool[np.ndarray, "frames h w"]],
) -> list[Finding]:
    """Masks that contradict the visual hull, which is found by vote."""
    silhouettes = hull.silhouettes
    filled = masks.any(axis=(1, 2))  # an empty mask has its own finding
    typical = float(np.median(_contradiction(masks, silhouettes)[filled]))
    outline = masks & ~binary_erosion(masks, np.ones((1, 3, 3), bool))
    pixel = outline.sum() / masks.sum()
    limit = MAX_CONTRADICTION + 0.25 * pixel
    if typical > limit:
        of_vote = float(np.median(_contradiction(silhouettes, silhouettes_of(silhouettes))[filled]))
        limit = max(limit, of_vote + VOTE_EXCESS + 0.25 * pixel)
    if typical > limit:
        sentence = (
            f"The masks contradict each other: a typical one differs by {100 * typical:.0f} % of its area from the "
            "visual hull of all, so the masks or the poses are wrong; look at report/masks.png and report/poses.png."
        )
        return [Finding("masks-hull", "red", sentence, {"contradiction": typical})]
    excess = MAX_ODDITY + 0.125 * pixel
    odd, contradiction = _odd(masks, silhouettes, brightness, excess)
    if not odd.any():
        return []
    # The outermost frames of a part of a turn carve alone and are outvoted, but the core agrees with all masks.
    core = hull.core_silhouettes
    odd_to_core, to_core = _odd(masks, core, brightness, excess)
    if not odd_to_core.any() and np.median(to_core[filled]) <= typical:
        return []
    # Fewer frames make a coarser core, but show how much masks that all agree differ from what is voted for them.
    odd &= contradiction > _contradiction(core, silhouettes_of(core)) + excess
    if not odd.any():
        return []
    others = {name: float(c) for name, c, is_odd in zip(names, contradiction, odd, strict=True) if is_odd}
    sentence = (
        f"The object in {names_in_short([*others])} has another shape than in the other frames: it is another "
        f"object, or it was moved; leave these frames out with {leave_out([*others])}."
    )
    return [Finding("frames-hull", "red", sentence, {"frames": others})]


def _odd(
    masks: Bool[np.ndarray, "frames h w"],
    silhouettes: Bool[np.ndarray, "frames h w"],
    brightness: Float[np.ndarray, "frames h w"],
    excess: float,
) -> tuple[Bool[np.ndarray, "frames"], Float[np.ndarray, "frames"]]:
    """Which masks contradict their silhouettes by ``excess`` more than a typical one; contradiction without noise."""
    filled, contradiction = masks.any(axis=(1, 2)), _contradiction(masks, silhouettes)
    scatter = float(median_abs_deviation(contradiction[filled], scale="normal"))
    limit = float(np.median(contradiction[filled])) + max(excess, ODDITY_SIGMAS * scatter)
    trimmed = _contradiction(masks & ~_background(masks, silhouettes, brightness), silhouettes)
    return (trimmed > limit) & filled, trimmed


def _background(
    masks: Bool[np.ndarray, "frames h w"],
    silhouettes: Bool[np.ndarray, "frames h w"],
    brightness: Float[np.ndarray, "frames h w"],
) -> Bool[np.ndarray, "frames h w"]:
    """Masked pixels outside of the hull that show what the other frames show there: noise, which trimming removes."""
    beyond = masks & ~silhouettes
    lines, samples = np.nonzero(beyond.any(axis=0))
    shown = np.where(masks[:, lines, samples], np.nan, brightness[:, lines, samples])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a pixel that all masks hold has nothing to compare with
        typical = np.nanmedian(shown, axis=0)
        scatter = robust_std(shown - typical, axis=0)
    alike = np.abs(brightness[:, lines, samples] - typical) <= BACKGROUND_SIGMAS * scatter
    background = np.zeros_like(masks)
    background[:, lines, samples] = alike & beyond[:, lines, samples]
    return background


def _contradiction(
    masks: Bool[np.ndarray, "frames h w"], silhouettes: Bool[np.ndarray, "frames h w"]
) -> Float[np.ndarray, "frames"]:
    """One minus intersection over union."""
    union = (masks | silhouettes).sum(axis=(1, 2))
    return 1.0 - (masks & silhouettes).sum(axis=(1, 2)) / np.maximum(1, union)
