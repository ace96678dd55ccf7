"""The result of an adjustment: poses of a session's frames in the object frame, in metres, with their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.poses.bundle_adjustment import Adjusted, Problem
from hsi_sc_nerf.poses.container_outline import ContainerOutline, radius_by_camera
from hsi_sc_nerf.poses.object_frame import (
    apparent_sides,
    container_diameter,
    disc_height,
    disc_tilt_deg,
    foot_gives_disc,
    lie_on_disc,
    lowest_landmarks,
    scale_of,
    to_object_frame,
)
from hsi_sc_nerf.poses.residuals import PointResiduals
from hsi_sc_nerf.poses.result import LARGEST_PLAQUE, Scale, ScaleSource, TurntablePoses, Uncertainty
from hsi_sc_nerf.poses.turntable import MarkerObservations, Turntable, project, projection_jacobian

_FIELD_PX = 0.007
"""Standard deviation of each field's amplitude for corners: print, lens and pixels differ from the model by this."""
_FEATURE_FIELD_PX = 0.03
"""Standard deviation of each field's amplitude for features: they drift over a skin as its light and slope change
(docs/validation/poses.md)."""
_DRAWS = 2000
"""Random errors drawn from the covariance: the largest error over all frames has no closed form."""


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
        outline: outline of the container in the same unit, which gives the disc's height where no marker does.
        specific: what the method itself knows for ``TurntablePoses``.
    """
    source, metres = scale_of(adjusted.turntable, info, outline)
    turntable, n = adjusted.turntable.resized(metres), len(names)
    by_foot = foot_gives_disc(adjusted.turntable, outline)
    disc = disc_height(turntable) if outline is None or not by_foot else metres * outline.foot
    to_object = to_object_frame(turntable, disc)
    corners = turntable.corners() @ to_object[:3, :3].T + to_object[:3, 3]
    on_disc, motion = lie_on_disc(turntable.corners()), turntable.motion
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
        disc_by_container=by_foot,
        disc_tilt_deg=disc_tilt_deg(turntable),
        model="turntable" if motion is None else "free poses",
        wobble_deg=None if motion is None else float(np.rad2deg(np.sqrt((motion[:, :2] ** 2).sum(-1).mean()))),
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
    if source == "container":
        # Root mean square of what is evenly spread from none to the largest.
        variance += LARGEST_PLAQUE**2 / 3.0
    return Scale(
        source=source,
        marker_side_m=turntable.side if ids else None,
        uncertainty=float(np.sqrt(variance)),
        marker_sides=dict(zip(ids, sides.tolist(), strict=True)),
        marker_side_sigmas=dict(zip(ids, (sigmas * np.sqrt(adjusted.variance)).tolist(), strict=True)),
        container_diameter_m=info.container_diameter_m,
        measured_container_diameter_m=container_diameter(turntable, info.container_height_m),
    )


def pose_uncertainty(
    adjusted: Adjusted,
    covariance: Float[np.ndarray, "p p"],
    metres: float = 1.0,
    outline: ContainerOutline | None = None,
) -> Uncertainty:
    """Uncertainty of camera, angles and poses; the length that gives the scale is taken for exact.

    Args:
        covariance: covariance of its parameters (``Adjusted.covariance``).
        metres: length of its unit.
        outline: outline of the container, where its radius gives the scale; its foot gives the disc's height where no
            marker does.
    """
    layout, turntable = adjusted.problem.layout, adjusted.turntable
    sigmas = np.sqrt(covariance.diagonal())
    values, axes = np.linalg.eigh(covariance)
    normal = np.random.default_rng(0).normal(size=(_DRAWS, len(values)))
    drawn = normal * np.sqrt(np.maximum(values, 0.0)) @ axes.T
    angles = np.pad(drawn, ((0, 0), (0, 1)))[:, layout.angle]
    # A small rotation of the camera, and of the object about the axis, in the camera's axes.
    camera = np.zeros((_DRAWS, 5))
    camera[:, : len(layout.camera)] = drawn[:, layout.camera]
    turns = camera[:, None, 1:4] + angles[..., None] * turntable.camera_rotation[:, 2]
    # The camera over the disc: its distance from the axis, its height, and its arc along the circle from the first
    # frame's. And the size of the object.
    height, size = _landmark_gradients(adjusted)
    radius, radius_variance, by_foot = np.zeros_like(size), 0.0, foot_gives_disc(turntable, outline)
    if outline is not None:
        if by_foot:
            height = _foot_gradient(adjusted, outline)
        radius_variance = outline.radius_sigma**2
        radius[layout.camera] = radius_by_camera(outline, turntable)[: len(layout.camera)]
    upright_plane = (turntable.distance * camera[:, 4]) ** 2 + (drawn @ height) ** 2
    position = upright_plane[:, None] + (turntable.distance * angles) ** 2
    variance = (metres**2) * position.max(axis=1).mean()
    distance = float(sigmas[4]) ** 2 if 4 in layout.camera else 0.0
    if outline is not None:
        # The container's size is exact, so an error of its radius in the images is one of the camera's distance.
        distance += float(radius @ covariance @ radius) + radius_variance
        reach_sq = turntable.distance**2 + outline.foot**2
        variance += metres**2 * (by_foot * outline.foot_sigma**2 + distance * reach_sq)
    return Uncertainty(
        focal=float(sigmas[0]),
        distance=float(np.sqrt(distance)),
        size=float(np.sqrt((size - radius) @ covariance @ (size - radius) + radius_variance)),
        angle_deg=adjusted.angle_sigmas_deg(covariance),
        rotation_deg=float(np.rad2deg(np.sqrt((turns**2).sum(axis=-1).max(axis=1).mean()))),
        position_m=float(np.sqrt(variance)),
    )


def _foot_gradient(adjusted: Adjusted, outline: ContainerOutline) -> Float[np.ndarray, "p"]:
    """Derivatives of the height at which the container's foot, as it is seen, meets the axis' side of the camera."""
    layout, turntable = adjusted.problem.layout, adjusted.turntable
    rotations, _ = turntable.motions()
    nearest = rotations[0].T @ [outline.radius, 0.0, outline.foot]
    frame = np.zeros(1, int)
    jacobian = projection_jacobian(turntable, frame, project(turntable, frame, nearest[None]))
    gradient = np.zeros(layout.motion_size)
    gradient[layout.camera] = -jacobian.camera[0, 1, : len(layout.camera)] / jacobian.point[0, 1, 2]
    return gradient


def _landmark_gradients(adjusted: Adjusted) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """Derivatives of the disc's height, and of the log of the landmarks' distances from the axis (RMS).

    The derivatives are those by the camera, the angles and the other parameters; all landmarks follow. If there are
    markers, they are the landmarks.
    """
    turntable = adjusted.turntable
    # The markers' residuals come last, where there are any.
    residuals, layout = adjusted.problem.residuals[-1], adjusted.problem.layout
    response = adjusted.problem.normal_equations(turntable).landmark_responses()
    response = response[layout.landmarks[-1] - layout.motion_size]
    if isinstance(residuals, PointResiduals):
        shifts, points_3d = response, turntable.points_3d
    else:
        shifts, points_3d = response[:, 3:6], turntable.marker_poses[:, :3, 3]
    weight = points_3d[:, :2] / (points_3d[:, :2] ** 2).sum()
    size = np.einsum("lk,lkp->p", weight, shifts[:, :2])
    return shifts[lowest_landmarks(turntable), 2].mean(axis=0), size


def with_hidden_errors(adjusted: Adjusted) -> Adjusted:
    """The same turntable with a covariance that counts smooth displacements over the image (``smooth_fields``).

    Residuals hardly show such displacements, because another camera explains most of them. The residuals of features
    show some of them, which gives the size of the others.
    """
    turntable, problem = adjusted.turntable, adjusted.problem
    parts = [
        part.with_hidden(
            (_FEATURE_FIELD_PX if isinstance(part, PointResiduals) else _FIELD_PX) * smooth_fields(part.pixels)
        )
        for part in problem.residuals
    ]
    counted = Problem(*parts, free=problem.free)
    larger = [
        part.with_hidden(part.hidden * np.sqrt(max(1.0, _shown_variance(counted, turntable, k))))
        if isinstance(part, PointResiduals) and part.hidden is not None
        else part
        for k, part in enumerate(parts)
    ]
    return replace(adjusted, problem=Problem(*larger, free=problem.free))


def _shown_variance(problem: Problem, turntable: Turntable, kind: int) -> float:
    """Variance of the amplitudes of one kind's hidden errors, by the method of moments.

    At the solution the derivatives of the cost by the amplitudes are V a + noise: V is the amplitudes' information
    after the parameters are eliminated, and the noise is the scatter from point to point.
    """
    equations, hidden = problem.normal_equations(turntable), problem.layout.hidden[kind]
    information, (_, scores) = equations.information(), equations.reduced(kind)
    shown = np.setdiff1d(np.arange(len(information)), np.concatenate(problem.layout.hidden))
    response = np.linalg.pinv(information[np.ix_(shown, shown)], hermitian=True) @ information[np.ix_(shown, hidden)]
    left = information[np.ix_(hidden, hidden)] - information[np.ix_(hidden, shown)] @ response
    scores = scores[:, hidden] - scores[:, shown] @ response
    gradient = scores.sum(axis=0)
    return float((gradient @ gradient - (scores**2).sum()) / (left**2).sum())


def smooth_fields(pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 k"]:
    """Polynomials of the pixel coordinates, up to the third degree, along x and along y, each of 1 px RMS."""
    centred = pixels - np.median(pixels, axis=0)
    x, y = (centred / np.abs(centred).max()).T
    shapes = np.stack([x**i * y ** (n - i) for n in (1, 2, 3) for i in range(n + 1)], axis=-1)
    shapes /= np.sqrt((shapes**2).mean(axis=0))
    nothing = np.zeros_like(shapes)
    return np.stack([np.concatenate(pair, axis=-1) for pair in ((shapes, nothing), (nothing, shapes))], axis=1)
