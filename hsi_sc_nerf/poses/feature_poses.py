"""Poses of a turntable session from features of the object: free poses by COLMAP, or known angles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.poses.marker_detection import find_dictionary
from hsi_sc_nerf.poses.marker_observations import observe
from hsi_sc_nerf.poses.marker_outliers import usable
from hsi_sc_nerf.poses.object_frame import lie_on_disc, scale_by_markers, to_object_frame, triangulate_markers
from hsi_sc_nerf.poses.result import Scale, TurntablePoses
from hsi_sc_nerf.poses.session_pictures import SessionPictures
from hsi_sc_nerf.poses.structure_from_motion import FeatureConfig, matched_tracks, structure_from_motion
from hsi_sc_nerf.poses.track_adjustment import AdjustedTracks, adjust_tracks, split_half_error_deg, with_lost_frames
from hsi_sc_nerf.poses.turntable import Tracks
from hsi_sc_nerf.poses.turntable_from_angles import turntable_from_angles
from hsi_sc_nerf.poses.turntable_from_poses import turntable_from_poses

LARGEST_SPLIT_HALF_DEG = 0.3
"""Halves of the points that differ by more cause a warning: the target of poses without markers."""
MOST_CONTRADICTING = 1 / 3
"""Of COLMAP's poses; where a larger fraction contradicts one turntable, it is not known which are right."""
LOWEST_POINTS_PERCENTILE = 1.0
"""Without a marker on the disc the origin is at the height of the lowest points."""

Images = Sequence[UInt8[np.ndarray, "h w"]]
"""One image per frame, or ``SessionPictures``."""


def poses_from_colmap(
    images: Images, names: Sequence[str], info: SessionInfo, config: FeatureConfig
) -> TurntablePoses:
    """Poses from features alone: free poses by COLMAP, a turntable fitted to them, and its bundle adjustment.

    Args:
        images: one gray image per frame.
        names: the frames' names.
        info: what gives the scale; the nominal step and the direction, which are only compared with the result.
        config: settings.

    Raises:
        InputError: too little texture, or poses that do not turn about one axis.
    """
    pictures = SessionPictures.of(images)
    free = structure_from_motion(pictures.named(pictures.features), names, config)
    fit = turntable_from_poses(free.world_to_camera)
    if fit.contradicts.sum() > MOST_CONTRADICTING * free.used.sum():
        raise InputError(
            f"{int(fit.contradicts.sum())} of the {int(free.used.sum())} poses that COLMAP found contradict one "
            "turntable; take images of more pixels, show markers, or give the angles"
        )
    start = fit.turntable(free.points_3d, free.focal_px, free.centre_px)
    adjusted = _with_lost_frames(adjust_tracks(start, free.tracks), free.tracks)
    return _in_object_frame(adjusted, images, names, info, "colmap")


def poses_from_angles(
    images: Images,
    names: Sequence[str],
    angles_deg: Float[np.ndarray, "n"],
    info: SessionInfo,
    config: FeatureConfig,
    *,
    free_angles: bool = False,
) -> TurntablePoses:
    """Poses from known angles; features give the camera before the axis.

    Args:
        images: one gray image per frame.
        names: the frames' names.
        angles_deg: of each frame, relative to the first; positive counter-clockwise where the direction is known.
        info: as in ``poses_from_colmap``.
        config: settings.
        free_angles: adjust the angles too, which follows uneven steps, but lets features that creep over the object
            bend the turn; they must be right to about a degree.

    Raises:
        InputError: too little texture, or features that contradict the angles.
    """
    pictures = SessionPictures.of(images)
    tracks = matched_tracks(pictures.named(pictures.features), names, config)
    height, width = images[0].shape
    frames = np.unique(tracks.frame)
    start = turntable_from_angles(
        tracks, frames, np.deg2rad(angles_deg[frames]), (width, height), direction_known=info.direction is not None
    )
    adjusted = adjust_tracks(start, tracks, free_angles=False)
    if free_angles:
        adjusted = _with_lost_frames(adjust_tracks(adjusted.turntable, tracks), tracks)
    return _in_object_frame(adjusted, images, names, info, "angles", free_angles=free_angles)


def _with_lost_frames(adjusted: AdjustedTracks, tracks: Tracks) -> AdjustedTracks:
    """Adjusted once more with the frames that were lost so far."""
    return adjust_tracks(with_lost_frames(adjusted.turntable, tracks), tracks)


def _in_object_frame(
    adjusted: AdjustedTracks,
    images: Images,
    names: Sequence[str],
    info: SessionInfo,
    method: Literal["colmap", "angles"],
    *,
    free_angles: bool = True,
) -> TurntablePoses:
    """The turntable in metres, with the disc at z = 0 and the first frame's camera over the x axis."""
    turntable, n = adjusted.turntable, len(names)
    height, width = images[0].shape
    intrinsics = PinholeIntrinsics(width, height, turntable.focal_px, turntable.focal_px, *turntable.centre_px)
    used = np.isin(np.arange(n), turntable.frames)
    # The disc's height is not known before the markers are triangulated.
    poses = turntable.over_session(to_object_frame(turntable, 0.0) @ turntable.camera_to_world(), n)

    corners, dictionary, per_frame = _markers(images, info, poses, intrinsics)
    markers = np.array(sorted(corners), dtype=int)
    on_disc = lie_on_disc(np.array([corners[m] for m in markers.tolist()]).reshape(-1, 4, 3))
    disc_markers = tuple(markers[on_disc].tolist())
    disc = float(np.percentile(turntable.points_3d[:, 2], LOWEST_POINTS_PERCENTILE))
    if disc_markers:
        disc = float(np.median([corners[m][:, 2].mean() for m in disc_markers]))
    scale, metres = scale_by_markers(corners, disc, info)
    poses[:, 2, 3] -= disc
    poses[:, :3, 3] *= metres
    return TurntablePoses(
        names=tuple(names),
        intrinsics=intrinsics,
        distortion=(*turntable.radial, 0.0, 0.0),
        camera_to_world=poses,
        angles_deg=turntable.over_session(turntable.relative_angles_deg(), n),
        reprojection_error_px=turntable.over_session(adjusted.frame_errors_px(), n),
        used=used,
        marker_corners_m={m: (c - [0.0, 0.0, disc]) * metres for m, c in corners.items()},
        dropped={names[int(i)]: "it shares too few features with other frames" for i in np.flatnonzero(~used)},
        dictionary=dictionary,
        markers_per_frame=per_frame,
        overall_error_px=adjusted.overall_error_px,
        disc_markers=disc_markers,
        loop_closure_deg=adjusted.loop_closure_deg(),
        nominal_step_deg=info.nominal_step_deg,
        nominal_direction=info.direction,
        warnings=tuple(
            _warnings(split_half_error_deg(adjusted, free_angles=free_angles), scale, info, bool(disc_markers))
        ),
        method=method,
        metric=scale is not None or info.camera_distance_m is not None,
        scale=scale,
    )


def _markers(
    images: Images, info: SessionInfo, poses: Float[np.ndarray, "n 4 4"], intrinsics: PinholeIntrinsics
) -> tuple[dict[int, Float[np.ndarray, "4 3"]], str | None, tuple[int, ...]]:
    """Corners of markers in the same frames, their dictionary, and their number in each frame."""
    dictionary = info.marker_dictionary or find_dictionary(images)
    if dictionary is None:
        return {}, None, (0,) * len(images)
    seen, _, _ = usable(observe(images, dictionary, progress=False).observations)
    corners = triangulate_markers(seen, poses, intrinsics)
    return corners, dictionary if corners else None, tuple(np.bincount(seen.frame, minlength=len(images)).tolist())


def _warnings(error_deg: float | None, scale: Scale | None, info: SessionInfo, disc_is_known: bool) -> list[str]:
    warnings = []
    if error_deg is None:
        warnings.append("too few features to tell how far the poses can be trusted")
    elif error_deg > LARGEST_SPLIT_HALF_DEG:
        warnings.append(
            f"poses from one half of the features and from the other differ by {error_deg:.1f} degrees; show markers "
            "or an object with more texture"
        )
    if scale is None and info.camera_distance_m is None:
        warnings.append(
            "nothing gives the scale: lengths are in units of the camera's distance from the axis; show markers and "
            "give marker_side_m, or give camera_distance_m in session.json"
        )
    if not disc_is_known:
        warnings.append("no marker lies on the disc: the origin is at the height of the lowest features")
    return warnings
