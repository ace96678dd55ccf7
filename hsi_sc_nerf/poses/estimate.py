"""Camera poses of a turntable session from its ArUco markers, whose layout need not be known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses import frame as object_frame
from hsi_sc_nerf.poses.adjust import adjust, reproject, whitening
from hsi_sc_nerf.poses.geometry import PinholeIntrinsics, rotation_about_z
from hsi_sc_nerf.poses.initialise import Observations, Turntable, initialise, linked_rows
from hsi_sc_nerf.poses.markers import find_dictionary
from hsi_sc_nerf.poses.observe import observe, observe_expected
from hsi_sc_nerf.poses.report import pose_report

FEWEST_FRAMES = 3
# Weighted residuals beyond this many standard deviations count by their size, not its square.
_LOSS_SIGMAS = 3.0
# An observation is thrown out if its error is above this many pixels and this many times the median error.
_OUTLIER_PX = 0.5
_OUTLIER_MEDIANS = 5.0
# A marker whose centre moves by less than this share of its size over three frames or more is not on the turntable.
_STANDS_STILL_SIDES = 0.1


@dataclass(frozen=True)
class TurntablePoses:
    """Poses of all frames in the object frame (docs/architecture.md), and what they rest on.

    Rows of frames that are not ``used`` are nan: a frame that cannot be posed is left out, never guessed.
    ``dropped`` says why, by the frame's name. Angles are degrees, counter-clockwise seen from above, relative to the
    first used frame and unwrapped over the session.
    """

    names: tuple[str, ...]
    intrinsics: PinholeIntrinsics
    distortion: tuple[float, float, float, float]  # k1, k2, p1, p2
    camera_to_world: Float[np.ndarray, "n 4 4"]
    angles_deg: Float[np.ndarray, "n"]
    reprojection_error_px: Float[np.ndarray, "n"]
    used: Bool[np.ndarray, "n"]
    marker_corners_m: dict[int, Float[np.ndarray, "4 3"]]
    dropped: dict[str, str]
    dictionary: str
    markers_per_frame: tuple[int, ...]
    overall_error_px: float
    blur_px: float
    disc_markers: tuple[int, ...]
    disc_tilt_deg: float | None
    loop_closure_deg: float | None
    nominal_step_deg: float | None = None
    nominal_direction: Literal["ccw", "cw"] | None = None
    warnings: tuple[str, ...] = field(default=())

    def report(self) -> dict:
        """Everything a user needs to judge the poses, ready for JSON (see ``report.pose_report``)."""
        return pose_report(self)


def estimate_turntable_poses(
    images: Sequence[UInt8[np.ndarray, "h w"]],
    names: Sequence[str],
    *,
    dictionary: str | None = None,
    marker_side_m: float,
    nominal_step_deg: float | None = None,
    direction: Literal["ccw", "cw"] | None = None,
    progress: bool = True,
) -> TurntablePoses:
    """Poses from markers that turn with the object before a camera that stands still.

    Unknown and found: the focal length, the camera's pose, the axis, one angle a frame, where the markers sit, and
    the dictionary if it is not given. The principal point is the image's centre, pixels are square, there is no
    lens distortion. Only the side of the markers gives the scale.

    Args:
        images: one grey image a frame, all of one size, linear in reflectance (a gamma moves every edge).
        names: the frames' names, for messages and the report.
        dictionary: OpenCV's name of the markers' dictionary, such as ``DICT_5X5_50``.
        marker_side_m: side of the markers' black square in metres.
        nominal_step_deg: the turntable's step, only compared with what is found.
        direction: the turntable's turn seen from above, only compared with what is found.
        progress: show progress bars.

    Raises:
        InputError: no markers, or too few frames with linked markers to fix an axis.
        ValueError: images of different sizes, or as many names as images are not given.
    """
    if len(images) != len(names) or len({image.shape for image in images}) > 1:
        raise ValueError("estimate_turntable_poses: needs images of one size and one name an image")
    if marker_side_m <= 0:
        raise InputError(f"marker_side_m is {marker_side_m}; give the side of the markers' black square in metres")
    if len(images) < FEWEST_FRAMES:
        raise InputError(
            f"{len(images)} frame(s) ({', '.join(names)}) cannot fix a turntable's axis; "
            f"give {FEWEST_FRAMES} or more frames of one session"
        )
    dictionary = dictionary or find_dictionary(images)
    seen, blur_px = observe(images, dictionary, progress) if dictionary else (None, 0.0)
    if dictionary is None or seen is None or len(seen) == 0:
        raise InputError(
            f"no marker was found in any of the {len(images)} frames {names[0]} ... {names[-1]}; check that the "
            f"markers are visible and well exposed, and the marker dictionary ({dictionary or 'all were tried'})"
        )
    height, width = images[0].shape
    centre = (width / 2, height / 2)
    dropped = {names[i]: "no marker was found" for i in set(range(len(names))) - set(seen.frame.tolist())}
    linked, warnings = _usable(seen)
    if len(np.unique(linked.frame)) < FEWEST_FRAMES:
        raise InputError(
            f"only {len(np.unique(linked.frame))} of the {len(images)} frames {names[0]} ... {names[-1]} share "
            f"markers with others, {FEWEST_FRAMES} are needed; take smaller steps or show more markers"
        )

    start = initialise(linked, centre, width, marker_side_m)
    pixels = np.tile(np.eye(8), (len(linked), 1, 1))
    turntable = adjust(start, linked, centre, marker_side_m, pixels, loss_scale=1.0)
    turntable, linked = _adjust_without_outliers(turntable, linked, centre, marker_side_m)
    linked = observe_expected(images, dictionary, turntable, linked, centre, marker_side_m, blur_px)
    turntable, linked = _adjust_without_outliers(turntable, linked, centre, marker_side_m)
    for i in np.setdiff1d(seen.frame, linked.frame):
        dropped[names[i]] = "its markers are not seen in enough other frames or contradict them"
    return _result(
        turntable, linked, centre, marker_side_m, (width, height), names, dropped, dictionary, blur_px, warnings,
        nominal_step_deg, direction,
    )  # fmt: skip


def _usable(seen: Observations) -> tuple[Observations, list[str]]:
    """Observations of markers that turn, are seen twice or more, and link their frames; and warnings."""
    count = Counter(seen.marker.tolist())
    size = np.sqrt(np.median([np.ptp(c, axis=0).prod() for c in seen.corners_px]))
    still = []
    for marker, n in count.items():
        centres = seen.corners_px[seen.marker == marker].mean(1)
        if n >= 3 and np.ptp(centres, axis=0).max() < _STANDS_STILL_SIDES * size:
            still.append(marker)
    warnings = [f"marker {m} stands still in the image and was left out" for m in sorted(still)]
    keep = [count[m] >= 2 and m not in still for m in seen.marker.tolist()]
    usable = seen.select(np.array(keep))
    if len(usable) == 0:
        return usable, warnings
    return usable.select(linked_rows(usable.frame, usable.marker)), warnings


def _adjust_without_outliers(
    turntable: Turntable, observations: Observations, centre: tuple[float, float], side_m: float
) -> tuple[Turntable, Observations]:
    """Adjust, throw out what does not fit, adjust again."""
    weights = whitening(observations.covariance_px2)
    turntable = adjust(turntable, observations, centre, side_m, weights, _LOSS_SIGMAS)
    residual = reproject(turntable, observations, centre, side_m) - observations.corners_px
    error = np.sqrt((residual**2).sum(-1).mean(-1))
    good = error < max(_OUTLIER_PX, _OUTLIER_MEDIANS * float(np.median(error)))
    if good.all():
        return turntable, observations
    kept, _ = _usable(observations.select(good))
    if len(np.unique(kept.frame)) < FEWEST_FRAMES:
        raise InputError(
            "the markers do not move as on one turntable; check that camera and markers were not touched during "
            "the session and that all markers have the same side"
        )
    turntable = _restrict(turntable, kept)
    return adjust(turntable, kept, centre, side_m, whitening(kept.covariance_px2), _LOSS_SIGMAS), kept


def _restrict(turntable: Turntable, observations: Observations) -> Turntable:
    """The turntable with only the frames and markers that are observed."""
    frames = np.isin(turntable.frames, observations.frame)
    markers = np.isin(turntable.markers, observations.marker)
    angle = float(turntable.angles_rad[frames][0])
    turn = rotation_about_z(np.rad2deg(angle))
    return Turntable(
        turntable.focal_px,
        turntable.camera_rotation,
        turntable.distance_m,
        turntable.frames[frames],
        turntable.angles_rad[frames] - angle,
        turntable.markers[markers],
        turn @ turntable.marker_poses[markers],
    )


def _result(
    turntable: Turntable,
    observations: Observations,
    centre: tuple[float, float],
    side_m: float,
    size: tuple[int, int],
    names: Sequence[str],
    dropped: dict[str, str],
    dictionary: str,
    blur_px: float,
    warnings: Sequence[str],
    step: float | None,
    direction: Literal["ccw", "cw"] | None,
) -> TurntablePoses:
    """The adjusted machine in the object frame, frame by frame."""
    n = len(names)
    residual = reproject(turntable, observations, centre, side_m) - observations.corners_px
    squared = (residual**2).sum(-1).mean(-1)
    used = np.zeros(n, bool)
    used[turntable.frames] = True
    poses, angles, error = np.full((n, 4, 4), np.nan), np.full(n, np.nan), np.full(n, np.nan)
    disc_m = object_frame.disc_height_m(turntable, side_m)
    poses[turntable.frames] = object_frame.camera_to_world(turntable, disc_m)
    angles[turntable.frames] = np.rad2deg(np.unwrap(turntable.angles_rad))
    for f in turntable.frames:
        error[f] = np.sqrt(squared[observations.frame == f].mean())
    corners = object_frame.layout(turntable, side_m) - [0.0, 0.0, disc_m]
    flat = object_frame.on_disc(turntable, side_m)
    if not flat.any():
        warnings = [*warnings, "no marker lies on the disc: the origin is at the height of the lowest marker corner"]
    closure = object_frame.loop_closure_deg(
        turntable, observations, residual, whitening(observations.covariance_px2), centre, side_m
    )
    return TurntablePoses(
        names=tuple(names),
        intrinsics=PinholeIntrinsics(size[0], size[1], turntable.focal_px, turntable.focal_px, *centre),
        distortion=(0.0, 0.0, 0.0, 0.0),
        camera_to_world=poses,
        angles_deg=angles,
        reprojection_error_px=error,
        used=used,
        marker_corners_m={int(m): c for m, c in zip(turntable.markers, corners, strict=True)},
        dropped=dropped,
        dictionary=dictionary,
        markers_per_frame=tuple(np.bincount(observations.frame, minlength=n).tolist()),
        overall_error_px=float(np.sqrt(squared.mean())),
        blur_px=blur_px,
        disc_markers=tuple(turntable.markers[flat].tolist()),
        disc_tilt_deg=object_frame.disc_tilt_deg(turntable, side_m),
        loop_closure_deg=closure,
        nominal_step_deg=step,
        nominal_direction=direction,
        warnings=tuple(warnings),
    )
