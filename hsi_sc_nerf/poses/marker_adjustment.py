"""Bundle adjustment of a turntable and its markers: residuals of the corners, and their derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.geometry.camera import cross_matrix
from hsi_sc_nerf.poses.bundle_adjustment import FreeParameters, ParameterLayout, Problem
from hsi_sc_nerf.poses.turntable import (
    Jacobian,
    MarkerObservations,
    MarkerTurntable,
    project,
    projection_jacobian,
)


class MarkerProblem(Problem[MarkerTurntable]):
    """Corners of markers. Each number of the whitened residuals has its own loss."""

    def __init__(
        self,
        start: MarkerTurntable,
        observations: MarkerObservations,
        loss_scale: float,
        free: FreeParameters | None = None,
        weights: Float[np.ndarray, "n 8 8"] | None = None,
    ) -> None:
        """Args:
        start: a turntable that has the frames and markers of the observations.
        observations: marker corners.
        loss_scale: residuals well above this count by their size, not its square.
        free: parameters to adjust; by default camera, angles and landmarks.
        weights: multiply the residuals (x0, y0, x1, ...) of an observation; by default they whiten its covariance.
        """
        free = free or FreeParameters()
        frame, marker = start.rows(observations)
        marker_size = 6 * free.landmarks + free.marker_sides
        layout = ParameterLayout.of(free, len(start.frames), len(start.markers), 5, marker_size)
        super().__init__(layout, frame, marker, free, loss_scale)
        self.observations = observations
        self.weights = whitening(observations.covariance_px2) if weights is None else weights

    def residuals(self, turntable: MarkerTurntable) -> Float[np.ndarray, "n 8 1"]:
        """Whitened reprojection errors."""
        error = self._project(turntable).pixels.reshape(-1, 8) - self.observations.corners_px.reshape(-1, 8)
        return self.weights @ error[..., None]

    def jacobian(self, turntable: MarkerTurntable) -> tuple[Jacobian, Float[np.ndarray, "n 8 d"]]:
        """By a marker's parameters: a small rotation in the object's axes, a shift (m), and the log of its side."""
        pixel = projection_jacobian(turntable, np.repeat(self.frame, 4), self._project(turntable))
        whole = Jacobian(
            camera=self._whiten(pixel.camera),
            radial=self._whiten(pixel.radial),
            angle=self._whiten(pixel.angle),
            motion=None if pixel.motion is None else self._whiten(pixel.motion),
            point=self._whiten(pixel.point),
        )
        offset = turntable.corner_offsets()[self.landmark].reshape(-1, 3)
        parts = [pixel.point @ -cross_matrix(offset), pixel.point] if self.free.landmarks else []
        if self.free.marker_sides:
            parts.append(pixel.point @ offset[:, :, None])
        by_marker = np.concatenate(parts, axis=-1) if parts else np.zeros((len(offset), 2, 0))
        return whole, self._whiten(by_marker)

    def with_landmark_step(self, turntable: MarkerTurntable, step: Float[np.ndarray, "m d"]) -> MarkerTurntable:
        """The turntable with its markers turned and shifted."""
        poses = turntable.marker_poses.copy()
        poses[:, :3, :3] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += step[:, 3:6]
        return replace(turntable, marker_poses=poses)

    def _project(self, turntable):
        return project(turntable, np.repeat(self.frame, 4), turntable.corners()[self.landmark].reshape(-1, 3))

    def _whiten(self, values: Float[np.ndarray, "4*n 2 k"]) -> Float[np.ndarray, "n 8 k"]:
        return self.weights @ values.reshape(len(self.frame), 8, values.shape[-1])


def whitening(covariance: Float[np.ndarray, "n 8 8"]) -> Float[np.ndarray, "n 8 8"]:
    """Matrices that turn residuals of these covariances into independent ones of unit variance."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)
