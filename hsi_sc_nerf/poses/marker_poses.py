"""Camera poses of a turntable session from its ArUco markers, whose layout need not be known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.poses import object_frame
from hsi_sc_nerf.poses.bundle_adjustment import loop_closure_deg
from hsi_sc_nerf.poses.marker_adjustment import MarkerProblem
from hsi_sc_nerf.poses.marker_detection import find_dictionary
from hsi_sc_nerf.poses.marker_initialisation import initialise
from hsi_sc_nerf.poses.marker_observations import observe, observe_expected
from hsi_sc_nerf.poses.marker_outliers import adjust_without_outliers, usable, without_uncertain_frames
from hsi_sc_nerf.poses.model_selection import Adjusted
from hsi_sc_nerf.poses.result import RejectedMarker, Scale, TurntablePoses, Uncertainty
from hsi_sc_nerf.poses.session_pictures import check_frames
from hsi_sc_nerf.poses.turntable import FEWEST_FRAMES, MarkerObservations

# Taken for the markers' side where only the container's diameter is known; any length would do.
_SIDE_WITHOUT_SCALE_M = 0.03


@dataclass(frozen=True)
class _Found:
    """What the observation of the markers found, beside the adjusted turntable."""

    names: tuple[str, ...]
    size_px: tuple[int, int]
    dictionary: str
    blur_px: float
    warnings: tuple[str, ...]


def poses_from_markers(
    images: Sequence[UInt8[np.ndarray, "h w"]],
    names: Sequence[str],
    info: SessionInfo,
    *,
    progress: bool = True,
) -> TurntablePoses:
    """Poses from markers that turn with the object before a camera that stands still.

    Estimated are the focal length, the camera's pose, the axis, one angle per frame and the markers' layout; radial
    lens distortion and small motions of a wobbling table where the images call for them (``select_model``). A few
    displaced frames are left out. Pixels are square. The principal point is the image's centre: one axis hardly
    determines it (docs/concepts/poses.md).

    Args:
        images: one grey image per frame, all of one size, linear in reflectance (a gamma moves every edge).
        names: the frames' names, for messages and the report.
        info: the dictionary, found if it is not given; the markers' side or the container's size, which give the
            scale; the nominal step and the direction, which are only compared with the result.
        progress: show progress bars.

    Raises:
        InputError: no markers, too few frames with linked markers to fix an axis, or nothing that gives the scale.
        ValueError: images of different sizes, or not one name per image.

    Example:
        >>> info = SessionInfo(marker_dictionary="DICT_5X5_50", marker_side_m=0.03)
        >>> poses = poses_from_markers(images, [f"frame_{i:03d}" for i in range(len(images))], info)
        >>> poses.camera_to_world.shape  # (frames, 4, 4), metres
    """
    check_frames(images, names)
    _check_scale(info)
    dictionary = info.marker_dictionary or find_dictionary(images)
    observed = observe(images, dictionary, progress) if dictionary else None
    if dictionary is None or observed is None or len(observed.observations) == 0:
        raise InputError(
            f"no marker was found in any of the {len(images)} frames {names[0]} ... {names[-1]}; check that the "
            f"markers are visible and well exposed, and the marker dictionary ({dictionary or 'all were tried'})"
        )
    height, width = images[0].shape
    linked, rejected, static = usable(observed.observations)
    if len(np.unique(linked.frame)) < FEWEST_FRAMES:
        raise InputError(
            f"only {len(np.unique(linked.frame))} of the {len(images)} frames {names[0]} ... {names[-1]} share "
            f"markers with others, {FEWEST_FRAMES} are needed; take smaller steps or show more markers"
        )
    start = initialise(linked, (width / 2, height / 2), width, info.marker_side_m or _SIDE_WITHOUT_SCALE_M)
    # The first adjustment is unweighted, so that a wrong covariance can do no harm.
    unweighted = np.tile(np.eye(8), (len(linked), 1, 1))
    start = MarkerProblem(start, linked, loss_scale=1.0, weights=unweighted).minimise(start)
    first, _, outliers = adjust_without_outliers(start, linked)
    start = first.turntable
    rejected += [r for r in outliers if r.frame not in start.frames]
    linked = linked.select(np.isin(linked.frame, start.frames))
    linked = observe_expected(images, dictionary, start, linked, observed.blur_px)
    adjusted, kept, outliers = adjust_without_outliers(start, linked)
    adjusted, kept, uncertain = without_uncertain_frames(adjusted, kept)
    found_later = set(zip(linked.frame.tolist(), linked.marker.tolist(), strict=True))
    rejected += outliers + uncertain + [r for r in observed.unexplained if (r.frame, r.marker) not in found_later]
    found = _Found(
        names=tuple(names),
        size_px=(width, height),
        dictionary=dictionary,
        blur_px=float(np.median(observed.blur_px)),
        warnings=tuple(f"marker {m} stands still in the image and was left out" for m in static),
    )
    return _in_object_frame(adjusted, kept, rejected, info, found)


def _check_scale(info: SessionInfo) -> None:
    if info.marker_side_m is None and info.container_diameter_m is None:
        raise InputError(
            "nothing gives the scale; give marker_side_m, the side of the markers' black square in metres, or "
            "container_diameter_m and container_height_m"
        )
    if info.marker_side_m is not None and info.marker_side_m <= 0:
        raise InputError(
            f"marker_side_m is {info.marker_side_m}; give the side of the markers' black square in metres"
        )


def _in_object_frame(
    adjusted: Adjusted,
    observations: MarkerObservations,
    rejected: Sequence[RejectedMarker],
    info: SessionInfo,
    found: _Found,
) -> TurntablePoses:
    """The adjusted turntable in the object frame, frame by frame.

    Raises:
        InputError: the container should give the scale, but carries no markers around its side.
    """
    adjusted, measured_m = _with_container_scale(adjusted, info)
    turntable, n = adjusted.turntable, len(found.names)
    covariance = adjusted.covariance()
    sigmas = np.sqrt(np.diag(covariance))
    squared_px2 = ((turntable.reproject(observations) - observations.corners_px) ** 2).sum(-1).mean(-1)
    seen = np.bincount(observations.frame, minlength=n)
    used = np.isin(np.arange(n), turntable.frames)
    angle_sigmas_deg = turntable.over_session(adjusted.angle_sigmas_deg(covariance), n)
    disc_m = object_frame.disc_height_m(turntable)
    to_object = object_frame.to_object_frame(turntable, disc_m)
    corners = turntable.corners() @ to_object[:3, :3].T + to_object[:3, 3]
    on_disc = object_frame.lie_on_disc(turntable.corners())
    warnings = found.warnings
    if not on_disc.any():
        warnings += ("no marker lies on the disc: the origin is at the height of the lowest marker corner",)
    tilts = turntable.tilts_rad
    with np.errstate(invalid="ignore"):
        errors_px = np.sqrt(np.bincount(observations.frame, squared_px2, n) / seen)
    return TurntablePoses(
        names=found.names,
        intrinsics=PinholeIntrinsics(*found.size_px, turntable.focal_px, turntable.focal_px, *turntable.centre_px),
        distortion=(*turntable.radial, 0.0, 0.0),
        camera_to_world=turntable.over_session(to_object @ turntable.camera_to_world(), n),
        angles_deg=turntable.over_session(turntable.relative_angles_deg(), n),
        reprojection_error_px=errors_px,
        used=used,
        marker_corners_m={int(m): c for m, c in zip(turntable.markers, corners, strict=True)},
        dropped=_dropped(found.names, used, rejected),
        dictionary=found.dictionary,
        markers_per_frame=tuple(seen.tolist()),
        overall_error_px=float(np.sqrt(squared_px2.mean())),
        blur_px=found.blur_px,
        disc_markers=tuple(turntable.markers[on_disc].tolist()),
        disc_tilt_deg=object_frame.disc_tilt_deg(turntable),
        loop_closure_deg=loop_closure_deg(adjusted.problem, turntable),
        nominal_step_deg=info.nominal_step_deg,
        nominal_direction=info.direction,
        warnings=warnings,
        model="turntable" if tilts is None else "free poses",
        wobble_deg=None if tilts is None else float(np.rad2deg(np.sqrt((tilts**2).sum(-1).mean()))),
        outliers=tuple(rejected),
        scale=_scale(adjusted, covariance, measured_m, info),
        uncertainty=Uncertainty(float(sigmas[0]), float(sigmas[4]), angle_sigmas_deg),
    )


def _with_container_scale(adjusted: Adjusted, info: SessionInfo) -> tuple[Adjusted, float | None]:
    """The turntable in metres, and the container's diameter by the markers."""
    turntable, problem = adjusted.turntable, adjusted.problem
    poses, disc_m = turntable.marker_poses, object_frame.disc_height_m(turntable)
    measured_m = object_frame.container_diameter(
        poses[:, :3, 2], poses[:, :3, 3], turntable.side_m, disc_m, info.container_height_m
    )
    if info.marker_side_m is not None:
        return adjusted, measured_m
    if measured_m is None or info.container_diameter_m is None:
        raise InputError(
            "no marker stands upright around the container, so that its diameter gives no scale; give marker_side_m, "
            "the side of the markers' black square in metres"
        )
    factor, free = info.container_diameter_m / measured_m, problem.free
    if free.motion_sigmas is not None:
        free = replace(free, motion_sigmas=(free.motion_sigmas[0], free.motion_sigmas[1] * factor))
    turntable = turntable.resized(factor)
    problem = MarkerProblem(turntable, problem.observations, problem.loss_scale, free)
    return replace(adjusted, turntable=turntable, problem=problem), info.container_diameter_m


def _scale(
    adjusted: Adjusted, covariance: Float[np.ndarray, "p p"], measured_m: float | None, info: SessionInfo
) -> Scale:
    turntable, problem = adjusted.turntable, adjusted.problem
    uncertainty = object_frame.length_sigma(turntable, problem, covariance)
    sides, sigmas = np.zeros(0), np.zeros(0)
    if len(turntable.markers) > 1:
        sides, sigmas = object_frame.apparent_sides(turntable, problem)
        sigmas = sigmas * np.sqrt(adjusted.variance)
        uncertainty = float(np.hypot(uncertainty, np.std(sides, ddof=1) / np.sqrt(len(sides))))
    markers = turntable.markers.tolist()
    return Scale(
        source="container" if info.marker_side_m is None else "markers",
        marker_side_m=turntable.side_m,
        uncertainty=uncertainty,
        marker_sides=dict(zip(markers, sides.tolist(), strict=False)),
        marker_side_sigmas=dict(zip(markers, sigmas.tolist(), strict=False)),
        container_diameter_m=info.container_diameter_m,
        measured_container_diameter_m=measured_m,
    )


def _dropped(names: Sequence[str], used: np.ndarray, rejected: Sequence[RejectedMarker]) -> dict[str, str]:
    """Why each unused frame is left out: no marker, or what is wrong with most of its markers."""
    reasons: dict[int, Counter[str]] = {}
    for r in rejected:
        reasons.setdefault(r.frame, Counter())[r.why] += 1
    dropped = {}
    for f in np.flatnonzero(~used).tolist():
        why = reasons.get(f)
        dropped[names[f]] = f"its markers do not count: {why.most_common(1)[0][0]}" if why else "no marker was found"
    return dropped
