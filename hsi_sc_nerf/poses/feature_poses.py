"""Poses of a turntable session from features of the object: free poses by COLMAP, or known angles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.poses.marker_detection import find_dictionary
from hsi_sc_nerf.poses.marker_observations import observe
from hsi_sc_nerf.poses.marker_outliers import usable
from hsi_sc_nerf.poses.object_frame import in_object_frame, lie_on_disc, scale_of
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.poses.session_pictures import GRAY, SessionPictures
from hsi_sc_nerf.poses.structure_from_motion import structure_from_motion
from hsi_sc_nerf.poses.track_adjustment import (
    AdjustedTracks,
    adjust_tracks,
    adjust_with_markers,
    split_half_error_deg,
    with_lost_frames,
)
from hsi_sc_nerf.poses.turntable_from_poses import turntable_from_poses

LARGEST_SPLIT_HALF_DEG = 0.3
"""Halves of the points that differ by more cause a warning: the target of poses without markers."""
MOST_CONTRADICTING = 1 / 3
"""Of COLMAP's poses; where a larger fraction contradicts one turntable, it is not known which are right."""

Images = Sequence[UInt8[np.ndarray, "h w"]]
"""One image per frame, or ``SessionPictures``."""


def poses_from_features(
    images: Images, names: Sequence[str], info: SessionInfo, *, angles_deg: Float[np.ndarray, "n"] | None = None
) -> TurntablePoses:
    """Poses from features: free poses by COLMAP, a turntable fitted to them, and its bundle adjustment.

    Args:
        images: one gray image per frame.
        names: the frames' names.
        info: what gives the scale, and the markers' dictionary.
        angles_deg: known angles that are held, relative to the first frame; their direction is that of the images.

    Raises:
        InputError: too little texture, or poses that do not turn about one axis.
    """
    grays = SessionPictures.of(images).named(GRAY)
    free = structure_from_motion(grays, names)
    start, contradicts = turntable_from_poses(free.world_to_camera, free.points_3d, free.focal_px, free.centre_px)
    if contradicts.sum() > MOST_CONTRADICTING * free.used.sum():
        raise InputError(
            f"{int(contradicts.sum())} of the {int(free.used.sum())} poses that COLMAP found contradict one "
            "turntable; take images of more pixels, show markers, or give the angles"
        )
    if angles_deg is not None:
        known = np.deg2rad(angles_deg[start.frames])
        sign = np.copysign(1.0, np.dot(np.diff(known), np.diff(start.angles_rad)))
        start = replace(start, angles_rad=sign * known)
    found = adjust_tracks(start, free.tracks, free_angles=angles_deg is None)
    if angles_deg is None:
        found = adjust_tracks(with_lost_frames(found.turntable, free.tracks), free.tracks)
    return _posed(found, images, names, info, free_angles=angles_deg is None)


def _posed(
    found: AdjustedTracks,
    images: Images,
    names: Sequence[str],
    info: SessionInfo,
    *,
    free_angles: bool,
) -> TurntablePoses:
    """Adjust once more with the markers that are seen, if any, and go over to the object frame."""
    turntable, n = found.turntable, len(names)
    dictionary = info.marker_dictionary or find_dictionary(images)
    markers, per_frame = None, (0,) * n
    if dictionary is not None:
        markers, _, _ = usable(observe(images, dictionary, progress=False).observations)
        markers = markers.select(np.isin(markers.frame, turntable.frames))
        per_frame = tuple(np.bincount(markers.frame, minlength=n).tolist())
    adjusted, markers = adjust_with_markers(found, markers, free_angles=free_angles)
    height, width = images[0].shape
    findings = _split_half_finding(split_half_error_deg(found, free_angles=free_angles))
    if scale_of(adjusted.turntable, info)[0] is None:
        sentence = (
            "Nothing gives the scale: lengths are in units of the camera's distance from the axis; show markers and "
            "give marker_side_m, or give camera_distance_m in session.json."
        )
        findings.append(Finding("poses-no-scale", "amber", sentence))
    if not lie_on_disc(adjusted.turntable.corners()).any():
        sentence = "No marker lies on the disc: the origin is at the height of the lowest marker or feature."
        findings.append(Finding("poses-origin", "amber", sentence))
    return in_object_frame(
        adjusted,
        markers,
        names,
        (width, height),
        info,
        reprojection_error_px=turntable.over_session(found.frame_errors_px(), n),
        dropped={
            names[i]: "it shares too few features with other frames"
            for i in np.setdiff1d(np.arange(n), turntable.frames).tolist()
        },
        dictionary=None if markers is None else dictionary,
        markers_per_frame=per_frame,
        overall_error_px=found.overall_error_px,
        loop_closure_deg=found.loop_closure_deg(),
        findings=tuple(findings),
        method="colmap" if free_angles else "angles",
    )


def _split_half_finding(error_deg: float | None) -> list[Finding]:
    if error_deg is None:
        sentence = "Too few features are seen to tell how far the poses can be trusted."
    elif error_deg > LARGEST_SPLIT_HALF_DEG:
        sentence = (
            f"Poses from one half of the features and from the other differ by {error_deg:.1f} degrees; show markers "
            "or an object with more texture."
        )
    else:
        return []
    return [Finding("poses-halves", "amber", sentence, {"difference_deg": error_deg})]
