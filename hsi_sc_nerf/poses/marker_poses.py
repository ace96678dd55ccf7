"""Camera poses of a turntable session from its ArUco markers, whose layout need not be known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.poses.marker_detection import find_dictionary
from hsi_sc_nerf.poses.marker_initialisation import initialise
from hsi_sc_nerf.poses.marker_observations import observe_expected, observe_markers
from hsi_sc_nerf.poses.model_selection import LOSS_SIGMAS, adjust_without_outliers, usable, without_uncertain_frames
from hsi_sc_nerf.poses.object_frame import lie_on_disc, scale_of
from hsi_sc_nerf.poses.pixel_aspect import check_pixel_aspect, pixel_aspect
from hsi_sc_nerf.poses.posed_session import in_object_frame, with_hidden_errors
from hsi_sc_nerf.poses.residuals import MarkerResiduals, loop_closure_deg
from hsi_sc_nerf.poses.result import RejectedMarker, TurntablePoses
from hsi_sc_nerf.poses.session_pictures import require_frames
from hsi_sc_nerf.poses.turntable import FEWEST_FRAMES, require_parallax

# Taken for the markers' side where only the container's diameter is known; any length would do.
_SIDE_WITHOUT_SCALE_M = 0.03

# Upright markers that are seen from about their own height do not tell which end of the axis is up: it is the upper
# one in the pictures. They face away from the axis by this cosine, and the camera is level to this sine (5 degrees).
_UPRIGHT_COSINE, _LEVEL_SINE = 0.5, 0.087


def poses_from_markers(
    images: Sequence[UInt8[np.ndarray, "h w"]],
    names: Sequence[str],
    info: SessionInfo,
) -> TurntablePoses:
    """Poses from markers that turn with the object in front of a stationary camera.

    Estimated are the focal length, the camera's pose, the axis, one angle per frame and the markers' layout; radial
    lens distortion and small motions of a wobbling table if the images show them (``select_model``). A few displaced
    frames are left out. Pixels are square. The principal point is the image's centre: one axis hardly determines it
    (docs/concepts/poses.md).

    Args:
        images: one grey image per frame, all of one size, linear in reflectance (a gamma moves every edge).
        names: the frames' names, for messages and the report.
        info: the dictionary, found if it is not given; the markers' side or the container's size, which give the
            scale; the nominal step and the direction, which are only compared with the result.

    Raises:
        InputError: no markers, too few frames with linked markers to fix an axis, or nothing that gives the scale.
        ValueError: images of different sizes, or not one name per image.

    Example:
        >>> info = SessionInfo(marker_dictionary="DICT_5X5_50", marker_side_m=0.03)
        >>> poses = poses_from_markers(images, [f"frame_{i:03d}" for i in range(len(images))], info)
        >>> poses.camera_to_world.shape  # (frames, 4, 4), metres
    """
    require_frames(images, names)
    if info.marker_side_m is info.container_diameter_m is info.camera_distance_m is None:
        raise InputError(
            "nothing gives the scale; give marker_side_m, the side of the markers' black square in metres, or "
            "container_diameter_m and container_height_m, or camera_distance_m"
        )
    dictionary = info.marker_dictionary or find_dictionary(images)
    observed = observe_markers(images, dictionary) if dictionary else None
    if dictionary is None or observed is None or len(observed.observations) == 0:
        raise InputError(
            f"no marker was found in any of the {len(images)} frames {names[0]} ... {names[-1]}; check that the "
            f"markers are visible and well exposed, and the marker dictionary ({dictionary or 'all were tried'})"
        )
    height, width = images[0].shape
    linked, rejected, static = usable(observed.observations)
    if len(np.unique(linked.frame)) < FEWEST_FRAMES:
        advice = "take smaller steps or show more markers"
        if static:
            advice = f"markers {', '.join(map(str, static))} stand still in the image: check that the table turns"
        raise InputError(
            f"only {len(np.unique(linked.frame))} of the {len(images)} frames {names[0]} ... {names[-1]} share "
            f"markers with others, {FEWEST_FRAMES} are needed; {advice}"
        )
    start = initialise(linked, (width / 2, height / 2), width, info.marker_side_m or _SIDE_WITHOUT_SCALE_M)
    right, down, forward = start.camera_rotation[:, 2]
    none_is_flat = np.abs(start.marker_poses[:, 2, 2]).max() < _UPRIGHT_COSINE
    if none_is_flat and abs(forward) < _LEVEL_SINE and down > abs(right):
        start = start.turned_over()
    require_parallax(start.distance, np.linalg.norm(start.marker_poses[:, :3, 3] - [start.distance, 0, 0], axis=-1))
    first, _, outliers = adjust_without_outliers(start, linked)
    start = first.turntable
    rejected += [r for r in outliers if r.frame not in start.frames]
    linked = linked.select(np.isin(linked.frame, start.frames))
    linked = observe_expected(images, dictionary, start, linked, observed.blur_px)
    adjusted, kept, outliers = adjust_without_outliers(start, linked)
    adjusted, kept, uncertain = without_uncertain_frames(adjusted, kept)
    found_later = set(zip(linked.frame.tolist(), linked.marker.tolist(), strict=True))
    rejected += outliers + uncertain + [r for r in observed.unexplained if (r.frame, r.marker) not in found_later]
    if scale_of(adjusted.turntable, info)[0] is None:
        raise InputError(
            "no marker stands upright around the container, so that its diameter gives no scale; give marker_side_m, "
            "the side of the markers' black square in metres"
        )
    turntable = adjusted.turntable
    found = [Finding("poses-markers", "amber", f"Marker {m} stands still and was left out.") for m in static]
    if not lie_on_disc(turntable.corners()).any():
        sentence = (
            "No marker lies on the disc: the origin is at the height of the lowest marker corner, and where the "
            "container's lid is remains unknown; put a marker flat on the disc."
        )
        found.append(Finding("poses-origin", "amber", sentence))
    found += check_pixel_aspect(*pixel_aspect(adjusted, kept))
    errors_px, overall_px = turntable.frame_errors_px(kept, len(names))
    return in_object_frame(
        with_hidden_errors(adjusted),
        kept,
        names,
        (width, height),
        info,
        reprojection_error_px=errors_px,
        overall_error_px=overall_px,
        dropped=_dropped(names, np.isin(np.arange(len(names)), turntable.frames), rejected),
        dictionary=dictionary,
        markers_per_frame=tuple(np.bincount(kept.frame, minlength=len(names)).tolist()),
        blur_px=float(np.median(observed.blur_px)),
        loop_closure_deg=loop_closure_deg(MarkerResiduals(turntable, kept, LOSS_SIGMAS), turntable),
        findings=tuple(found),
        outliers=tuple(rejected),
    )


def _dropped(names: Sequence[str], used: np.ndarray, rejected: Sequence[RejectedMarker]) -> dict[str, str]:
    """Why each unused frame is left out: no marker, or what is wrong with most of its markers."""
    reasons: dict[int, Counter[str]] = {}
    for r in rejected:
        reasons.setdefault(r.frame, Counter())[r.why] += 1
    dropped = {}
    for f in np.flatnonzero(~used).tolist():
        why = reasons.get(f)
        dropped[names[f]] = (
            f"markers that cannot be used: {why.most_common(1)[0][0]}" if why else "no marker was found"
        )
    return dropped
