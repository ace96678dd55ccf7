"""Which effects the model simulates for a session, decided at the end of its processing.

Calibration and poses have already decided some effects, which are reported with their evidence. The others are
measured here.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib import rc_context
from rich.console import Console

from hsi_sc_nerf.calibration.lamp_drift import SIGNIFICANCE, LampDriftEstimate, NotMeasurable
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import CERTAIN, EFFECT_COLUMNS, EffectEvidence, effect_rows
from hsi_sc_nerf.packed.cube import PixelFlag
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.plotting import COLOURS, STYLE, logarithmic_axis, new_figure, save_figure
from hsi_sc_nerf.poses.model_selection import EVIDENCE_NEEDED
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.processing.chamber import background_pixels, gain_of_background_image
from hsi_sc_nerf.processing.spectral_subspace import training_subspace
from hsi_sc_nerf.processing.view_changes import (
    Change,
    PointViews,
    change_with_direction,
    change_with_height,
    point_views,
)
from hsi_sc_nerf.processing.visual_hull import VotedHull
from hsi_sc_nerf.terminal import screen_table

LEAST_VIEW_CHANGE_PERCENT = 0.35
"""Least change of a point with its direction: where modelling it begins to gain, and more than wrong poses cause on a
bumpy object (docs/validation/effects.md)."""
LEAST_PICTURE = 0.005
"""Least gain of an image of the chamber, reflectance; the noise of a pixel is larger."""
LEAST_HEIGHT_CHANGE_PERCENT = 2.0
"""Least change with height and slope: more than a colour that varies with the height causes in even light."""
LEAST_POSE_ERROR_PX = 0.1
"""Training corrects poses to this at best, and makes better poses worse (docs/notes/dead_ends.md)."""
FEWEST_POINT_VIEWS = 500
LARGEST_DRAWN = 100.0
_LOG_P_NOISE = 0.43
"""Standard deviation of -log10 of a probability that is evenly distributed."""


def points_of_object(
    dataset: PackedDataset,
    bins: Sequence[Float[np.ndarray, "bins h w"]],
    masks: Bool[np.ndarray, "frames h w"],
    hull: VotedHull,
) -> PointViews | None:
    """Points of the object as the frames see them; None where too few are seen."""
    if len(hull.core) == 0:
        return None
    seen = point_views(bins, masks, dataset.camera_to_worlds, dataset.intrinsics, dataset.distortion, hull)
    return seen if len(seen.point) >= FEWEST_POINT_VIEWS else None


def measure_effects(
    dataset: PackedDataset,
    bins: Sequence[Float[np.ndarray, "bins h w"]],
    masks: Bool[np.ndarray, "frames h w"],
    seen: PointViews | None,
    drift: tuple[LampDriftEstimate | NotMeasurable, bool],
    poses: TurntablePoses,
) -> tuple[EffectEvidence, ...]:
    """All effects, those that decide what the model simulates first.

    Args:
        dataset: whose files are written, all but ``transforms.json``.
        seen: points of the object as the frames see them (`points_of_object`).
        drift: what is known of the lamps, and whether the frames are corrected.
    """
    return (
        view_dependence(None if seen is None else change_with_direction(seen)),
        still_chamber(gain_of_background_image(*background_pixels(dataset, bins, masks))),
        pose_refinement(poses, dataset.object_box_m),
        lamp_drift(*drift),
        lens_distortion(poses),
        wobble(poses),
        saturated_highlights(dataset, masks),
        spectral_rank(dataset),
        uneven_light(seen),
    )


def view_dependence(change: Change | None) -> EffectEvidence:
    """Whether points look different from view to view, because of gloss or of lamps under which they turn."""
    if change is None:
        sentence = "Too little of the object is visible to decide, so the model shades points by direction."
        return EffectEvidence("view_dependence", True, None, None, None, "%", sentence)
    percent, noise = 100.0 * change.rms, 100.0 * change.noise
    return _decided(
        *("view_dependence", percent, noise, LEAST_VIEW_CHANGE_PERCENT, "%"),
        "Points change their brightness with the direction that they face in the chamber, so the model shades them "
        "by direction.",
        "Points look the same from all sides, so the model does not shade them.",
    )


def still_chamber(change: Change | None) -> EffectEvidence:
    """Whether an image of the chamber is a better background than its median spectrum."""
    if change is None:
        sentence = "Too little of the chamber is visible to decide, so its median spectrum is the background."
        return EffectEvidence("still_chamber", False, None, None, None, "reflectance", sentence)
    return _decided(
        *("still_chamber", change.rms, change.noise, LEAST_PICTURE, "reflectance"),
        "The chamber is stationary and uneven, so its image is the background.",
        "The chamber is even or moves, so its median spectrum is the background.",
    )


def pose_refinement(poses: TurntablePoses, object_box_m: Float[np.ndarray, "2 3"]) -> EffectEvidence:
    """Whether training can improve the poses: whether their uncertainty moves the object's surface by enough."""
    if poses.uncertainty is None:
        refined = poses.method != "markers"
        what = "training refines them" if refined else "training does not refine them"
        sentence = f"The uncertainty of the poses is not known; for poses by {poses.method}, {what}."
        return EffectEvidence("pose_refinement", refined, None, None, None, "px", sentence)
    radius_m = float(np.abs(object_box_m[:, :2]).max())
    cameras_m = poses.camera_to_world[poses.used, :3, 3]
    distance_m = float(np.linalg.norm(cameras_m - object_box_m.mean(axis=0), axis=1).mean())
    error_px = poses.intrinsics.fl_x / distance_m * radius_m * np.deg2rad(poses.uncertainty.rotation_deg)
    return _decided(
        *("pose_refinement", float(error_px), 0.0, LEAST_POSE_ERROR_PX, "px"),
        "The poses are less certain than those that training finds, so training refines them.",
        "The poses are more certain than those that training finds, so they are kept.",
    )


def lamp_drift(drift: LampDriftEstimate | NotMeasurable, corrected: bool) -> EffectEvidence:
    """The lamps' drift as calibration has decided it."""
    if isinstance(drift, NotMeasurable):
        return EffectEvidence(
            "lamp_drift", False, None, None, None, "-log10 p", f"Its drift was not measured: {drift.reason}."
        )
    evidence = max(0.0, -float(np.log10(max(drift.p_value, 1e-99))))
    sentence = "The frames show no change of the lamps beyond noise."
    if corrected or drift.significant:
        change = 100.0 * (drift.factor - 1.0)
        largest = float(change.flat[np.abs(change).argmax()])
        done = "corrected" if corrected else "not corrected"
        sentence = f"The lamps changed by up to {largest:+.2f} %, which calibration has {done}."
    return EffectEvidence(
        "lamp_drift", corrected, evidence, _LOG_P_NOISE, float(-np.log10(SIGNIFICANCE)), "-log10 p", sentence
    )


def lens_distortion(poses: TurntablePoses) -> EffectEvidence:
    """The lens as the poses have decided it."""
    k1, k2 = poses.distortion[:2]
    radius = np.hypot(poses.intrinsics.w, poses.intrinsics.h) / 2.0 / poses.intrinsics.fl_x
    shift_px = abs(k1 * radius**3 + k2 * radius**5) * poses.intrinsics.fl_x
    return _by_poses(poses, "lens_distortion", bool(k1 or k2), f"moves the picture's corners by {shift_px:.2g} px")


def wobble(poses: TurntablePoses) -> EffectEvidence:
    """The table's wobble as the poses have decided it."""
    return _by_poses(
        poses, "wobble", poses.model == "free poses", f"tilts the table by {poses.wobble_deg or 0.0:.2g}°"
    )


def saturated_highlights(dataset: PackedDataset, masks: Bool[np.ndarray, "frames h w"]) -> EffectEvidence:
    """Saturated pixels on the object, whose values losses and metrics leave out."""
    saturated = sum(
        int(((frame.flags() & PixelFlag.SATURATED > 0) & mask).sum())
        for frame, mask in zip(dataset.frames, masks, strict=True)
    )
    one_percent = max(int(masks.sum()), 1) / 100.0
    return _decided(  # a single pixel is enough
        *("saturated_highlights", saturated / one_percent, 0.0, 0.5 / one_percent, "% of pixels"),
        "Some of the object's pixels are saturated, and their saturated values are left out.",
        "No pixel of the object is saturated.",
    )


def spectral_rank(dataset: PackedDataset) -> EffectEvidence:
    """Number of spectra that span all others above the noise; training determines it again from its own frames."""
    bands = len(dataset.wavelengths_nm)
    try:
        rank = training_subspace(dataset, dataset.frames).basis.shape[1]
    except InputError:
        sentence = "Too few spectra are free of flagged values to determine the rank."
        return EffectEvidence("spectral_rank", False, None, None, None, "spectra", sentence)
    sentence = (
        f"All pixels are mixtures of {rank} spectra to within the noise, so the model learns {rank} numbers at each "
        f"point instead of {bands}."
    )
    return EffectEvidence("spectral_rank", rank < bands, float(rank), None, 1.0, "spectra", sentence)


def uneven_light(seen: PointViews | None) -> EffectEvidence:
    """A hint only: `hsi-sc-nerf material` decides it after training, when the surface is known."""
    if seen is None:
        sentence = "Too little of the object is visible to decide; `material` decides after training."
        return EffectEvidence("uneven_light", False, None, None, None, "%", sentence)
    change = change_with_height(seen)
    return _decided(
        *("uneven_light", 100.0 * change.rms, 100.0 * change.noise, LEAST_HEIGHT_CHANGE_PERCENT, "%"),
        "Similar spectra differ in brightness by height and slope, as in shade; `material` decides after training.",
        "Similar spectra are equally bright at all heights; `material` decides after training.",
    )


def show_effects(console: Console, effects: Sequence[EffectEvidence]) -> None:
    """Print the effects as a table, and what they mean."""
    console.print(screen_table(EFFECT_COLUMNS, effect_rows(effects), title="Effects in the session"))
    for effect in effects:
        console.print(f"{effect.name}: {effect.sentence}", highlight=False, markup=False, soft_wrap=True)


@rc_context(STYLE)
def draw_effects(path: Path, effects: Sequence[EffectEvidence]) -> None:
    """Draw the evidence of each effect as a multiple of its threshold.

    Raises:
        InputError: the operating system refused to write.
    """
    drawn = [
        (effect, effect.evidence / effect.threshold, CERTAIN * (effect.noise or 0.0) / effect.threshold)
        for effect in reversed(effects)
        if effect.evidence is not None and effect.threshold
    ]
    figure = new_figure(9.0, 1.0 + 0.5 * len(drawn))
    axes = figure.subplots()
    for row, (effect, ratio, error) in enumerate(drawn):
        at = float(np.clip(ratio, 1.0 / LARGEST_DRAWN, LARGEST_DRAWN))
        colour = COLOURS[1] if effect.present else "0.5"
        axes.errorbar(at, row, xerr=[[min(error, 0.99 * at)], [error]], fmt="o", capsize=3, color=colour)
        words = f"{effect.evidence:.2g} {effect.unit}, threshold {effect.threshold:.2g}"
        axes.annotate(words, (at, row), xytext=(0, 7), textcoords="offset points", ha="center", fontsize=8)
    axes.axvline(1.0, color="black", linestyle="--", linewidth=1)
    logarithmic_axis(axes, "x")
    axes.set(xlim=(0.2 / LARGEST_DRAWN, 5.0 * LARGEST_DRAWN), ylim=(-0.6, len(drawn) - 0.2))
    axes.set_yticks(range(len(drawn)), [effect.name for effect, _, _ in drawn])
    axes.set(xlabel="evidence over threshold (bars: 3 standard deviations); coloured: the effect is there")
    save_figure(figure, path)


def _decided(
    name: str, evidence: float, noise: float, least: float, unit: str, if_present: str, if_absent: str
) -> EffectEvidence:
    """The effect, which is present if its evidence exceeds both a least size and its noise."""
    threshold = max(least, CERTAIN * noise)
    present = evidence > threshold
    return EffectEvidence(name, present, evidence, noise, threshold, unit, if_present if present else if_absent)


def _by_poses(poses: TurntablePoses, name: str, present: bool, does: str) -> EffectEvidence:
    if name not in poses.evidence:
        known = f", but it is known: it {does}" if present else ""
        sentence = f"Poses by {poses.method} are not tested for it{known}."
        return EffectEvidence(name, present, None, None, None, "-log10 p", sentence)
    sentence = f"It {does}, and the poses include it." if present else "The markers show no sign of it."
    return EffectEvidence(name, present, poses.evidence[name], _LOG_P_NOISE, EVIDENCE_NEEDED, "-log10 p", sentence)
