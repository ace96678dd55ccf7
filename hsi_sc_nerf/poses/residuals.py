"""Residuals of a turntable's landmarks, markers or points, and their derivatives.

Symbols: n observations with g residuals of r numbers each, of l landmarks with d parameters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from typing_extensions import Self

from hsi_sc_nerf.geometry.camera import cross_matrix
from hsi_sc_nerf.poses.turntable import Jacobian, MarkerObservations, Tracks, Turntable, projection_jacobian


class Residuals(ABC):
    """Projections less observations, in standard deviations.

    The loss of a residual of length r is soft L1, rho = 2 s^2 (sqrt(1 + r^2 / s^2) - 1) with the scale s: r^2 where
    it is small, 2 s r where it is large.
    """

    shape: tuple[int, int]
    """Number of residuals of an observation, and number of values of each: g, r."""
    nearest: float
    """A residual is infinite if its point is nearer to the camera's plane than this, in distances of the camera."""
    hidden: Float[np.ndarray, "m 2 k"] | None = None
    """Displacements of the pixels, px, that count in the covariance alone."""

    def __init__(self, turntable: Turntable, seen: MarkerObservations | Tracks, loss_scale: float, d: int) -> None:
        """Args:
        turntable: one that has the frames and landmarks of the observations.
        seen: observations.
        loss_scale: residuals well above this count by their size, not its square.
        d: number of parameters of a landmark; 0 where landmarks are held.
        """
        self.frames, (self.frame, self.landmark) = len(turntable.frames), turntable.rows(seen)
        self.seen, self.loss_scale, self.d = seen, loss_scale, d
        self.pixels = (seen.pixels if isinstance(seen, Tracks) else seen.corners_px).reshape(-1, 2)
        self.size = len(turntable.points if isinstance(seen, Tracks) else turntable.markers)
        self.numbers = self.pixels.size

    def values(self, turntable: Turntable) -> Float[np.ndarray, "n g r"]:
        """Projections less observations, in standard deviations."""
        projection = turntable.project(self.seen)
        behind = projection.in_camera[:, 2:] <= self.nearest * turntable.distance
        difference = np.where(behind, np.inf, projection.pixels - self.pixels)
        return self.scaled(difference[..., None]).reshape(len(self.seen), *self.shape)

    def jacobian(self, turntable: Turntable) -> tuple[Jacobian, Float[np.ndarray, "n g*r d"]]:
        """Derivatives by camera and motion, and by the parameters of the row's own landmark."""
        projection = turntable.project(self.seen)
        frame = np.repeat(self.frame, len(self.pixels) // len(self.frame))
        pixel = replace(projection_jacobian(turntable, frame, projection), hidden=self.hidden)
        return pixel.mapped(self.scaled), self.scaled(self.by_landmark(turntable, pixel.point))

    @abstractmethod
    def scaled(self, pixels: Float[np.ndarray, "m 2 k"]) -> Float[np.ndarray, "n g*r k"]:
        """Displacements of the pixels in standard deviations."""

    def by_landmark(self, turntable: Turntable, by_point: Float[np.ndarray, "m 2 3"]) -> Float[np.ndarray, "m 2 d"]:
        """Derivatives of the pixels by the landmark's parameters: of a point its coordinates."""
        return by_point

    @abstractmethod
    def moved(self, turntable: Turntable, step: Float[np.ndarray, "l d"]) -> Turntable:
        """The turntable with its landmarks moved."""

    def with_hidden(self, hidden: Float[np.ndarray, "m 2 k"]) -> Self:
        """The same residuals with displacements that are not adjusted but count in the covariance."""
        other = copy(self)
        other.hidden = hidden
        return other

    def losses(self, turntable: Turntable) -> Float[np.ndarray, "n"]:
        """The loss of each observation."""
        r = np.linalg.norm(self.values(turntable), axis=-1)
        return (2.0 * self.loss_scale**2 * (np.sqrt(1.0 + (r / self.loss_scale) ** 2) - 1.0)).sum(axis=-1)

    def weights(self, residual: Float[np.ndarray, "n g r"]) -> Float[np.ndarray, "n g r"]:
        """Weight of each number by the loss of its residual: 1 / sqrt(1 + r^2 / s^2)."""
        r = np.linalg.norm(residual, axis=-1, keepdims=True)
        return np.broadcast_to(1.0 / np.sqrt(1.0 + (r / self.loss_scale) ** 2), residual.shape)


class MarkerResiduals(Residuals):
    """Corners of markers, whitened. Each number has its own loss."""

    shape, nearest = (8, 1), -np.inf

    def __init__(
        self,
        turntable: Turntable,
        observations: MarkerObservations,
        loss_scale: float,
        weights: Float[np.ndarray, "n 8 8"] | None = None,
        *,
        free: bool = True,
        free_sides: bool = False,
    ) -> None:
        """Args:
        turntable: as ``Residuals``.
        observations: marker corners.
        loss_scale: as ``Residuals``.
        weights: multiply the residuals (x0, y0, x1, ...) of an observation; by default they whiten its covariance.
        free: whether the markers' poses are adjusted.
        free_sides: whether the log of each marker's side is adjusted.
        """
        super().__init__(turntable, observations, loss_scale, 6 * free + free_sides)
        self.free, self.free_sides = free, free_sides
        self.whitening = whitening(observations.covariance_px2) if weights is None else weights

    def scaled(self, pixels: Float[np.ndarray, "4*n 2 k"]) -> Float[np.ndarray, "n 8 k"]:
        """Displacements, whitened."""
        return self.whitening @ pixels.reshape(len(self.frame), 8, pixels.shape[-1])

    def by_landmark(self, turntable: Turntable, by_point: Float[np.ndarray, "m 2 3"]) -> Float[np.ndarray, "m 2 d"]:
        """Derivatives by a small rotation of the marker in the object's axes, its shift, and the log of its side."""
        offset = turntable.corner_offsets()[self.landmark].reshape(-1, 3)
        parts = [by_point @ -cross_matrix(offset), by_point] * self.free
        parts += [by_point @ offset[:, :, None]] * self.free_sides
        return np.concatenate([np.zeros((len(offset), 2, 0)), *parts], axis=-1)

    def moved(self, turntable: Turntable, step: Float[np.ndarray, "m d"]) -> Turntable:
        """The turntable with its markers turned and shifted."""
        poses = turntable.marker_poses.copy()
        poses[:, :3, :3] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += step[:, 3:6]
        return replace(turntable, marker_poses=poses)


class PointResiduals(Residuals):
    """Points of the object, over their standard deviation. The loss is that of a residual's length."""

    shape, nearest = (1, 2), 1e-3

    def __init__(self, turntable: Turntable, tracks: Tracks, loss_scale: float, sigma_px: float = 1.0) -> None:
        super().__init__(turntable, tracks, loss_scale, 3)
        self.sigma_px = sigma_px

    def scaled(self, pixels: Float[np.ndarray, "n 2 k"]) -> Float[np.ndarray, "n 2 k"]:
        """Displacements over the standard deviation."""
        return pixels / self.sigma_px

    def curvature(self, turntable: Turntable) -> float:
        """Second derivatives of the losses over what ``weights`` takes for them, in the mean of all directions.

        The second derivative is 1 / (1 + r^2 / s^2) of the weight along the residual, and the weight across it.
        """
        weight = self.weights(self.values(turntable))[..., 0]
        return float(np.average((1.0 + weight**2) / 2.0, weights=weight))

    def moved(self, turntable: Turntable, step: Float[np.ndarray, "p 3"]) -> Turntable:
        """The turntable with its points shifted."""
        return replace(turntable, points_3d=turntable.points_3d + step)


def whitening(covariance: Float[np.ndarray, "n 8 8"]) -> Float[np.ndarray, "n 8 8"]:
    """Matrices that turn residuals of these covariances into independent ones of unit variance."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)


def loop_closure_deg(residuals: Residuals, turntable: Turntable) -> float | None:
    """Sum of the steps between neighbouring frames, and from the last to the first, less those of the turntable.

    Each step is measured by the landmarks that its two frames share alone, so that errors add up as in any chain; the
    adjusted angles close by construction. None where two neighbours share no landmark.
    """
    jacobian, _ = residuals.jacobian(turntable)
    residual = residuals.values(turntable).reshape(len(residuals.frame), -1)
    # The turn that each observation alone suggests, and the inverse of that angle's variance.
    information = np.maximum((jacobian.angle**2).sum((1, 2)), 1e-12)
    own_rad = -(jacobian.angle[..., 0] * residual).sum(-1) / information
    total = 0.0
    rows = [np.flatnonzero(residuals.frame == f) for f in range(len(turntable.frames))]
    for here, there in zip(rows, [*rows[1:], rows[0]], strict=True):
        _, i, j = np.intersect1d(residuals.landmark[here], residuals.landmark[there], return_indices=True)
        before, after = here[i], there[j]
        if len(before) == 0:
            return None
        # Variances of the two ends add.
        weight = 1.0 / (1.0 / information[before] + 1.0 / information[after])
        total += float(np.average(own_rad[after] - own_rad[before], weights=weight))
    return float(np.rad2deg(total))
