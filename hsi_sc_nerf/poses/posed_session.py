"""The result of an adjustment: poses of a session's frames in the object frame, in metres, with their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.poses.bundle_adjustment import Adjusted
from hsi_sc_nerf.poses.container_outline import ContainerOutline
from hsi_sc_nerf.poses.object_frame import (
    apparent_sides,
    container_diameter,
    disc_height,
    disc_tilt_deg,
    lie_on_disc,
    scale_of,
    to_object_frame,
)
from hsi_sc_nerf.poses.result import Scale, ScaleSource, TurntablePoses
from hsi_sc_nerf.poses.turntable import MarkerObservations, Turntable
from hsi_sc_nerf.poses.uncertainty import pose_uncertainty


def in_object_frame(
    adjusted: Adjusted,
    markers: MarkerObservations | None,
    names: Sequence[str],
    size_px: tuple[int, int],
    info: SessionInfo,
    outline: ContainerOutline | None = None,
    **specific: Any,
) -> TurntablePoses:
    """The adjusted turntable in the object frame and in metres, frame by frame.

    Args:
        adjusted: in any unit of length.
        markers: that it was adjusted to.
        names: of the session's frames.
        size_px: width and height of the images.
        info: what is known of the session.
        outline: of the container in the same unit, which gives the disc's height.
        specific: what the method itself knows for ``TurntablePoses``.
    """
    source, metres = scale_of(adjusted.turntable, info, outline)
    turntable, n = adjusted.turntable.resized(metres), len(names)
    to_object = to_object_frame(turntable, disc_height(turntable) if outline is None else metres * outline.foot)
    corners = turntable.corners() @ to_object[:3, :3].T + to_object[:3, 3]
    on_disc, tilts = lie_on_disc(turntable.corners()), turntable.tilts_rad
    uncertainty = pose_uncertainty(adjusted, adjusted.covariance(), metres, outline)
    return TurntablePoses(
        names=tuple(names),
        intrinsics=PinholeIntrinsics(*size_px, turntable.focal_px, turntable.focal_px, *turntable.centre_px),
        distortion=(*turntable.radial, 0.0, 0.0),
        camera_to_world=turntable.over_session(to_object @ turntable.camera_to_world(), n),
        angles_deg=turntable.over_session(turntable.relative_angles_deg(), n),
        used=np.isin(np.arange(n), turntable.frames),
        marker_corners_m={int(m): c for m, c in zip(turntable.markers, corners, strict=True)},
        disc_markers=tuple(turntable.markers[on_disc].tolist()),
        disc_by_container=outline is not None,
        disc_tilt_deg=disc_tilt_deg(turntable),
        model="turntable" if tilts is None else "free poses",
        wobble_deg=None if tilts is None else float(np.rad2deg(np.sqrt((tilts**2).sum(-1).mean()))),
        evidence=dict(adjusted.evidence),
        metric=source is not None,
        scale=None if source is None else _scale(adjusted, turntable, markers, uncertainty.size, source, info),
        uncertainty=replace(uncertainty, angle_deg=turntable.over_session(uncertainty.angle_deg, n)),
        **specific,
    )


def _scale(
    adjusted: Adjusted,
    turntable: Turntable,
    markers: MarkerObservations | None,
    size: float,
    source: ScaleSource,
    info: SessionInfo,
) -> Scale:
    variance = size**2
    ids, sides, sigmas = turntable.markers.tolist(), np.ones(len(turntable.markers)), np.zeros(len(turntable.markers))
    if markers is not None and len(ids) > 1:
        sides, sigmas = apparent_sides(adjusted.turntable, markers)
        variance += float(np.var(sides, ddof=1)) / len(ids)
    return Scale(
        source=source,
        marker_side_m=turntable.side if ids else None,
        uncertainty=float(np.sqrt(variance)),
        marker_sides=dict(zip(ids, sides.tolist(), strict=True)),
        marker_side_sigmas=dict(zip(ids, (sigmas * np.sqrt(adjusted.variance)).tolist(), strict=True)),
        container_diameter_m=info.container_diameter_m,
        measured_container_diameter_m=container_diameter(turntable, info.container_height_m),
    )
