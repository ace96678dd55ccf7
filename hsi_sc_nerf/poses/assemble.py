"""From the adjusted machine to the poses in the object frame, with all that tells how good they are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, rotation_about_z
from hsi_sc_nerf.poses import frame as object_frame
from hsi_sc_nerf.poses.adjust import Problem, reproject
from hsi_sc_nerf.poses.choose import LOSS_SIGMAS, Adjusted
from hsi_sc_nerf.poses.initialise import Observations, Rejected
from hsi_sc_nerf.poses.result import Outlier, TurntablePoses, Uncertainty
from hsi_sc_nerf.poses.scale import Scale, apparent_sides, container_diameter, length_sigma, resized


@dataclass(frozen=True)
class Session:
    """What is known of a session beside its images, and what was found on the way."""

    names: tuple[str, ...]
    size_px: tuple[int, int]
    dictionary: str
    marker_side_m: float | None
    nominal_step_deg: float | None
    direction: Literal["ccw", "cw"] | None
    container_diameter_m: float | None
    container_height_m: float | None
    blur_px: float
    warnings: tuple[str, ...]


def poses_of(
    adjusted: Adjusted, observations: Observations, rejected: Sequence[Rejected], session: Session
) -> TurntablePoses:
    """The adjusted machine in the object frame, frame by frame.

    Raises:
        InputError: the container is to give the scale, but carries no markers around its side.
    """
    adjusted, measured_m = _scaled(adjusted, observations, session)
    turntable, problem, n = adjusted.turntable, adjusted.problem, len(session.names)
    side_m, centre_px = problem.side_m, problem.centre_px
    covariance = adjusted.covariance()
    residual = reproject(turntable, observations, centre_px, side_m) - observations.corners_px
    squared = (residual**2).sum(-1).mean(-1)
    rows = np.full((3, n), np.nan)
    rows[0, turntable.frames] = np.rad2deg(np.unwrap(turntable.angles_rad))
    rows[1, turntable.frames] = adjusted.angle_sigmas_deg(covariance)
    rows[2] = [
        np.sqrt(squared[rows_of].mean()) if rows_of.any() else np.nan for rows_of in _by_frame(observations, n)
    ]
    disc_m = object_frame.disc_height_m(turntable, side_m)
    poses = np.full((n, 4, 4), np.nan)
    poses[turntable.frames] = object_frame.camera_to_world(turntable, disc_m)
    to_object = rotation_about_z(-object_frame.first_azimuth_deg(turntable))[:3, :3]
    corners = (object_frame.layout(turntable, side_m) - [0.0, 0.0, disc_m]) @ to_object.T
    flat = object_frame.on_disc(turntable, side_m)
    warnings = session.warnings
    if not flat.any():
        warnings += ("no marker lies on the disc: the origin is at the height of the lowest marker corner",)
    tilts = turntable.tilts_rad
    sigmas = np.sqrt(np.diag(covariance))
    used = np.zeros(n, bool)
    used[turntable.frames] = True
    return TurntablePoses(
        names=session.names,
        intrinsics=PinholeIntrinsics(*session.size_px, turntable.focal_px, turntable.focal_px, *centre_px),
        distortion=(*turntable.radial, 0.0, 0.0),
        camera_to_world=poses,
        angles_deg=rows[0],
        reprojection_error_px=rows[2],
        used=used,
        marker_corners_m={int(m): c for m, c in zip(turntable.markers, corners, strict=True)},
        dropped=_dropped(session.names, used, rejected),
        dictionary=session.dictionary,
        markers_per_frame=tuple(np.bincount(observations.frame, minlength=n).tolist()),
        overall_error_px=float(np.sqrt(squared.mean())),
        blur_px=session.blur_px,
        disc_markers=tuple(turntable.markers[flat].tolist()),
        disc_tilt_deg=object_frame.disc_tilt_deg(turntable, side_m),
        loop_closure_deg=object_frame.loop_closure_deg(
            turntable, observations, residual, problem.weights, centre_px, side_m
        ),
        nominal_step_deg=session.nominal_step_deg,
        nominal_direction=session.direction,
        warnings=warnings,
        model="turntable" if tilts is None else "free poses",
        wobble_deg=None if tilts is None else float(np.rad2deg(np.sqrt((tilts**2).sum(-1).mean()))),
        outliers=tuple(Outlier(session.names[r.frame], r.marker, r.error_px, r.why) for r in rejected),
        scale=_scale(adjusted, covariance, measured_m, session),
        uncertainty=Uncertainty(float(sigmas[0]), float(sigmas[4]), rows[1]),
    )


def _scaled(adjusted, observations, session):
    """The machine in metres, and the container's diameter by the markers."""
    turntable, side_m = adjusted.turntable, adjusted.problem.side_m
    disc_m = object_frame.disc_height_m(turntable, side_m)
    poses = turntable.marker_poses
    measured_m = container_diameter(poses[:, :3, 2], poses[:, :3, 3], side_m, disc_m, session.container_height_m)
    if session.marker_side_m is not None:
        return adjusted, measured_m
    if measured_m is None:
        raise InputError(
            "no marker stands upright around the container, so that its diameter gives no scale; give marker_side_m, "
            "the side of the markers' black square in metres"
        )
    factor = session.container_diameter_m / measured_m
    unknowns = adjusted.unknowns
    if unknowns.motion_spread is not None:
        unknowns = replace(unknowns, motion_spread=(unknowns.motion_spread[0], unknowns.motion_spread[1] * factor))
    turntable = resized(turntable, factor)
    problem = adjusted.problem
    problem = Problem(turntable, observations, problem.centre_px, side_m * factor, problem.weights, unknowns)
    return Adjusted(turntable, unknowns, problem, adjusted.cost), session.container_diameter_m


def _scale(adjusted, covariance, measured_m, session):
    turntable, problem = adjusted.turntable, adjusted.problem
    uncertainty = length_sigma(turntable, problem, covariance)
    sides, sigmas = np.zeros(0), np.zeros(0)
    if len(turntable.markers) > 1:
        sides, sigmas = apparent_sides(turntable, problem, LOSS_SIGMAS)
        sigmas = sigmas * np.sqrt(adjusted.variance)
        uncertainty = float(np.hypot(uncertainty, np.std(sides, ddof=1) / np.sqrt(len(sides))))
    markers = turntable.markers.tolist()
    return Scale(
        source="container" if session.marker_side_m is None else "markers",
        marker_side_m=problem.side_m,
        uncertainty=uncertainty,
        marker_sides=dict(zip(markers, sides.tolist(), strict=False)),
        marker_side_sigmas=dict(zip(markers, sigmas.tolist(), strict=False)),
        container_diameter_m=session.container_diameter_m,
        measured_container_diameter_m=measured_m,
    )


def _by_frame(observations, n):
    return (observations.frame == f for f in range(n))


def _dropped(names, used, rejected):
    """Why each unused frame is left out: no marker, or what is wrong with most of its markers."""
    reasons: dict[int, Counter[str]] = {}
    for r in rejected:
        reasons.setdefault(r.frame, Counter())[r.why] += 1
    dropped = {}
    for f in np.flatnonzero(~used).tolist():
        why = reasons.get(f)
        dropped[names[f]] = f"its markers do not count: {why.most_common(1)[0][0]}" if why else "no marker was found"
    return dropped
