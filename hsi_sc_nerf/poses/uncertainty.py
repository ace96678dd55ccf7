"""Standard deviations of poses in the object frame, by the covariance of the whole adjustment.

The covariance counts errors that no residual shows: smooth displacements of the markers' corners, which another
camera explains.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.poses.bundle_adjustment import Adjusted, Problem
from hsi_sc_nerf.poses.model_selection import LOSS_SIGMAS
from hsi_sc_nerf.poses.object_frame import lowest_landmarks
from hsi_sc_nerf.poses.residuals import MarkerResiduals, PointResiduals
from hsi_sc_nerf.poses.result import Uncertainty
from hsi_sc_nerf.poses.turntable import MarkerObservations

_FIELD_PX = 0.007
"""Standard deviation of each field's amplitude: print, lens and pixels are that far from the model's."""


def pose_uncertainty(adjusted: Adjusted, covariance: Float[np.ndarray, "p p"], metres: float = 1.0) -> Uncertainty:
    """Uncertainty of camera, angles and poses; the length that gives the scale is taken for exact.

    Args:
        adjusted: the turntable.
        covariance: of its parameters (``Adjusted.covariance``).
        metres: length of its unit.
    """
    layout, turntable = adjusted.problem.layout, adjusted.turntable
    sigmas = np.sqrt(covariance.diagonal())
    distance = float(sigmas[4]) if 4 in layout.camera else 0.0
    # A small rotation of the camera, and of the object about the axis, in the camera's axes.
    turn = np.zeros((len(turntable.frames), 3, len(covariance) + 1))
    turn[:, :, layout.camera[1:4]] = np.eye(3)
    turn[np.arange(len(turn)), :, layout.angle] += turntable.camera_rotation[:, 2]
    turn = turn[..., :-1]
    variance = np.einsum("fip,pq,fiq->f", turn, covariance, turn)
    # The camera over the disc: its distance from the axis, its height, and its way along the circle from the first
    # frame's. And the size of what turns.
    height, size = _landmark_gradients(adjusted)
    place = np.stack([np.zeros(len(covariance)), -height])
    if 4 in layout.camera:
        place[0, layout.camera[4]] = turntable.distance
    angles = np.append(covariance.diagonal(), 0.0)[layout.angle]
    along = turntable.distance**2 * float(angles.max())
    return Uncertainty(
        focal=float(sigmas[0]),
        distance=distance,
        size=float(np.sqrt(size @ covariance @ size)),
        angle_deg=adjusted.angle_sigmas_deg(covariance),
        rotation_deg=float(np.rad2deg(np.sqrt(variance.max()))),
        position_m=metres * float(np.sqrt(np.trace(place @ covariance @ place.T) + along)),
    )


def _landmark_gradients(adjusted: Adjusted) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """Derivatives of the disc's height, and of the log of the landmarks' distances from the axis (RMS).

    By camera, angles and the rest, with all landmarks following. Markers count where there are any.
    """
    turntable = adjusted.turntable
    equations = adjusted.problem.normal_equations(turntable)
    # The markers' residuals come last, where there are any.
    response, residuals = equations.landmark_responses()[-1], adjusted.problem.residuals[-1]
    if isinstance(residuals, PointResiduals):
        shifts, places = response, turntable.points_3d
    else:
        shifts, places = response[:, 3:6], turntable.marker_poses[:, :3, 3]
    weight = places[:, :2] / (places[:, :2] ** 2).sum()
    size = np.einsum("lk,lkp->p", weight, shifts[:, :2])
    return shifts[lowest_landmarks(turntable), 2].mean(axis=0), size


def with_hidden_errors(adjusted: Adjusted, markers: MarkerObservations) -> Adjusted:
    """The same turntable with a covariance that counts smooth displacements over the image (``smooth_fields``).

    Residuals hardly show them, for another camera explains most of them.
    """
    hidden = _FIELD_PX * smooth_fields(markers.corners_px.reshape(-1, 2))
    corners = MarkerResiduals(adjusted.turntable, markers, LOSS_SIGMAS, hidden=hidden)
    problem = Problem(adjusted.turntable, *adjusted.problem.residuals[:-1], corners, free=adjusted.problem.free)
    return replace(adjusted, problem=problem)


def smooth_fields(pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 k"]:
    """Polynomials of the place up to the third degree along x and along y, each with a root mean square of 1 px."""
    place = pixels - np.median(pixels, axis=0)
    x, y = (place / np.abs(place).max()).T
    shapes = np.stack([x**i * y ** (n - i) for n in (1, 2, 3) for i in range(n + 1)], axis=-1)
    shapes /= np.sqrt((shapes**2).mean(axis=0))
    nothing = np.zeros_like(shapes)
    return np.stack([np.concatenate(pair, axis=-1) for pair in ((shapes, nothing), (nothing, shapes))], axis=1)
