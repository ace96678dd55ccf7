"""Poses of a turntable session from features of the object: found by COLMAP, or with angles that are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, rotation_about_z
from hsi_sc_nerf.poses.frame import lie_on_disc
from hsi_sc_nerf.poses.late_frames import with_late_frames
from hsi_sc_nerf.poses.loop_closure import track_loop_closure_deg
from hsi_sc_nerf.poses.markers import find_dictionary
from hsi_sc_nerf.poses.observe import observe
from hsi_sc_nerf.poses.outliers import usable
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.poses.scale import Scale, container_diameter
from hsi_sc_nerf.poses.session_pictures import BAND_GROUPS_NM, GRAY, SessionPictures
from hsi_sc_nerf.poses.static_background import StaticBackgroundConfig, moving_pixels
from hsi_sc_nerf.poses.structure_from_motion import StructureFromMotionConfig, matched_tracks, structure_from_motion
from hsi_sc_nerf.poses.track_adjust import AdjustedTracks, TrackAdjustConfig, adjust_tracks, split_half_error_deg
from hsi_sc_nerf.poses.turntable_from_angles import adjusted_from_angles
from hsi_sc_nerf.poses.turntable_from_poses import turntable_from_poses
from hsi_sc_nerf.poses.visible_markers import marker_corners, side_lengths

LARGEST_SPLIT_HALF_DEG = 0.3
"""Halves of the points that differ by more than this deserve a warning: the target of poses without markers."""
MOST_CONTRADICTING = 1 / 3
"""Of COLMAP's poses; where more contradict one machine, it is not known which are right."""
LOWEST_POINTS_PERCENTILE = 1.0
"""Without a marker on the disc the origin is at the height of the lowest points of what turns."""

PSEUDO_RGB = "pseudo-RGB"
"""Name of a frame's pseudo-RGB picture in gray."""

Images = Sequence[UInt8[np.ndarray, "h w"]]
"""One picture a frame, or ``SessionPictures``."""


@dataclass(frozen=True)
class FeatureConfig:
    """Settings of poses from features."""

    picture: Literal["gray", "pseudo-rgb", "foreground-variance"] = "gray"
    """The picture that features are found in: the mean of the bands in which markers are looked for (gray), the
    pseudo-RGB picture turned gray (pseudo-rgb), or the group of bands that differs most over what turns
    (foreground-variance)."""
    band_nm: float | None = None
    """Find features in the band nearest to this wavelength instead, nm: one in which the object shows patterns."""
    motion: StructureFromMotionConfig = field(default_factory=StructureFromMotionConfig)
    """Features, matching and mapping by COLMAP."""
    adjustment: TrackAdjustConfig = field(default_factory=TrackAdjustConfig)
    """The final bundle adjustment over camera, axis and angles."""


@dataclass(frozen=True)
class Known:
    """What is known of a session beside its images."""

    marker_dictionary: str | None = None
    marker_side_m: float | None = None
    container_diameter_m: float | None = None
    container_height_m: float | None = None
    camera_distance_m: float | None = None
    """Of the camera from the turntable's axis: the scale where no marker gives it."""
    nominal_step_deg: float | None = None
    direction: Literal["ccw", "cw"] | None = None


def poses_by_colmap(images: Images, names: Sequence[str], known: Known, config: FeatureConfig) -> TurntablePoses:
    """Poses from features alone: free poses by COLMAP, one machine through them, and its bundle adjustment.

    Raises:
        InputError: too little texture, or poses that do not turn about one axis.
    """
    pictures = SessionPictures.of(images)
    free = structure_from_motion(pictures.named(pictures.features), names, config.motion)
    fit = turntable_from_poses(free.world_to_camera)
    if fit.contradicts.sum() > MOST_CONTRADICTING * free.used.sum():
        raise InputError(
            f"{int(fit.contradicts.sum())} of the {int(free.used.sum())} poses that COLMAP found contradict one "
            "turntable; take images of more pixels, show markers, or give the angles"
        )
    start = fit.tracked(free.places, free.focal_px, free.centre_px)
    adjusted = adjust_tracks(start, free.tracks, config.adjustment)
    # Frames that COLMAP lost, or got wrong, come back by one angle each.
    adjusted = adjust_tracks(with_late_frames(adjusted.turntable, free.tracks), free.tracks, config.adjustment)
    return in_object_frame(adjusted, images, names, known, config, "colmap")


def poses_by_angles(
    images: Images,
    names: Sequence[str],
    angles_deg: Float[np.ndarray, "n"],
    known: Known,
    config: FeatureConfig,
    free_angles: bool = False,
) -> TurntablePoses:
    """Poses from angles that are known: features give the camera before the axis, and nothing else.

    Args:
        images: one gray image a frame.
        names: the frames' names.
        angles_deg: of each frame, relative to the first; positive counter-clockwise where the direction is known.
        known: what else is known.
        config: settings.
        free_angles: let the given angles be a start only, from which features adjust each frame's.

    Raises:
        InputError: too little texture, or features that contradict the angles.
    """
    pictures = SessionPictures.of(images)
    tracks = matched_tracks(pictures.named(pictures.features), names, config.motion)
    height, width = images[0].shape
    adjustment = replace(config.adjustment, free_angles=free_angles)
    direction_known = known.direction is not None
    adjusted = adjusted_from_angles(tracks, angles_deg, (width, height), adjustment, direction_known=direction_known)
    return in_object_frame(adjusted, images, names, known, replace(config, adjustment=adjustment), "angles")


def group_of_most_variance(pictures: SessionPictures, background: StaticBackgroundConfig | None = None) -> str:
    """Name of the group of bands whose brightness differs most over the pixels that show what turns.

    The variance is taken over these pixels within a frame, and its mean over the frames; the broad mean where nothing
    turns.
    """
    moving = moving_pixels(pictures.named(GRAY), background)
    if not moving.any():
        return GRAY
    groups = [name for name in (GRAY, *BAND_GROUPS_NM) if name in pictures.frames[0].pictures]
    variance = {name: np.mean([image[moving].var() for image in pictures.named(name)]) for name in groups}
    return max(variance, key=variance.__getitem__)


def in_object_frame(
    adjusted: AdjustedTracks,
    images: Images,
    names: Sequence[str],
    known: Known,
    config: FeatureConfig,
    method: Literal["colmap", "angles"],
) -> TurntablePoses:
    """The machine in metres, with the disc at z = 0 and the first frame's camera over the x axis."""
    machine, n = adjusted.turntable, len(names)
    height, width = images[0].shape
    centre = machine.centre_px
    intrinsics = PinholeIntrinsics(width, height, machine.focal_px, machine.focal_px, *centre)
    rows = np.full((2, n), np.nan)
    angles_deg = np.rad2deg(np.unwrap(machine.angles_rad))
    rows[0, machine.frames], rows[1, machine.frames] = angles_deg - angles_deg[0], adjusted.frame_errors_px()
    # The object frame is the object as it stands in the first frame.
    turn = rotation_about_z(float(angles_deg[0]))
    poses = np.full((n, 4, 4), np.nan)
    poses[machine.frames] = turn @ machine.camera_to_world()
    places = machine.places @ turn[:3, :3].T

    corners, dictionary, per_frame = _markers(images, known, poses, intrinsics)
    markers = np.array(sorted(corners), dtype=int)
    flat = lie_on_disc(np.array([corners[m] for m in markers.tolist()]).reshape(-1, 4, 3))
    disc = tuple(markers[flat].tolist())
    floor = float(np.percentile(places[:, 2], LOWEST_POINTS_PERCENTILE))
    if disc:
        floor = float(np.median([corners[m][:, 2].mean() for m in disc]))
    scale, metres = scale_by_markers(corners, floor, known)
    poses[:, 2, 3] -= floor
    poses[:, :3, 3] *= metres
    used = np.isfinite(rows[0])
    return TurntablePoses(
        names=tuple(names),
        intrinsics=intrinsics,
        distortion=(*machine.radial, 0.0, 0.0),
        camera_to_world=poses,
        angles_deg=rows[0],
        reprojection_error_px=rows[1],
        used=used,
        marker_corners_m={m: (c - [0.0, 0.0, floor]) * metres for m, c in corners.items()},
        dropped={names[int(i)]: "it shares too few features with other frames" for i in np.flatnonzero(~used)},
        dictionary=dictionary,
        markers_per_frame=per_frame,
        overall_error_px=adjusted.overall_error_px,
        blur_px=0.0,
        disc_markers=disc,
        disc_tilt_deg=None,
        loop_closure_deg=track_loop_closure_deg(adjusted),
        nominal_step_deg=known.nominal_step_deg,
        nominal_direction=known.direction,
        warnings=tuple(_warnings(adjusted, config, scale, known, bool(disc))),
        method=method,
        metric=scale is not None or known.camera_distance_m is not None,
        scale=scale,
    )


def _markers(
    images: Images, known: Known, poses: Float[np.ndarray, "n 4 4"], intrinsics: PinholeIntrinsics
) -> tuple[dict[int, Float[np.ndarray, "4 3"]], str | None, tuple[int, ...]]:
    """Markers that are seen all the same: their corners, their dictionary, and their number in each frame."""
    dictionary = known.marker_dictionary or find_dictionary(images)
    if dictionary is None:
        return {}, None, (0,) * len(images)
    seen = usable(observe(images, dictionary, progress=False).observations)[0]
    corners = marker_corners(seen, poses, intrinsics)
    return corners, dictionary if corners else None, tuple(np.bincount(seen.frame, minlength=len(images)).tolist())


def scale_by_markers(
    corners: dict[int, Float[np.ndarray, "4 3"]], floor: float, known: Known
) -> tuple[Scale | None, float]:
    """Where the scale comes from, and how many metres the unit of length is; ``floor`` is the disc's height."""
    nothing = None, known.camera_distance_m or 1.0
    if not corners:
        return nothing
    sides = side_lengths(corners)
    typical = float(np.median(list(sides.values())))
    relative = {m: side / typical for m, side in sides.items()}
    spread = float(np.std(list(relative.values()))) if len(sides) > 1 else 0.0
    faces = np.stack(list(corners.values()))
    # Corners go round from the upper left one, so this points out of the face.
    normals = np.cross(faces[:, 3] - faces[:, 0], faces[:, 1] - faces[:, 0])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)

    def diameter(height: float | None) -> float | None:
        return container_diameter(normals, faces.mean(axis=1), typical, floor, height)

    source: Literal["markers", "container"]
    if known.marker_side_m is not None:
        source, metres = "markers", known.marker_side_m / typical
    elif known.container_diameter_m is not None and (wide := diameter(None)) is not None:
        source, metres = "container", known.container_diameter_m / wide
    else:
        return nothing
    measured = diameter(None if known.container_height_m is None else known.container_height_m / metres)
    scale = Scale(
        source=source,
        marker_side_m=typical * metres,
        uncertainty=spread / np.sqrt(len(sides)),
        marker_sides=relative,
        marker_side_sigmas=dict.fromkeys(sides, spread),
        container_diameter_m=known.container_diameter_m,
        measured_container_diameter_m=None if measured is None else measured * metres,
    )
    return scale, metres


def _warnings(
    adjusted: AdjustedTracks, config: FeatureConfig, scale: Scale | None, known: Known, disc_is_known: bool
) -> list[str]:
    warnings = []
    error_deg = split_half_error_deg(adjusted, config.adjustment)
    if error_deg is None:
        warnings.append("too few features to tell how far the poses can be trusted")
    elif error_deg > LARGEST_SPLIT_HALF_DEG:
        warnings.append(
            f"poses from one half of the features and from the other differ by {error_deg:.1f} degrees; show markers "
            "or an object with more texture"
        )
    if scale is None and known.camera_distance_m is None:
        warnings.append(
            "nothing gives the scale: lengths are in units of the camera's distance from the axis; show markers and "
            "give marker_side_m, or give camera_distance_m in session.json"
        )
    if not disc_is_known:
        warnings.append("no marker lies on the disc: the origin is at the height of the lowest features")
    return warnings
