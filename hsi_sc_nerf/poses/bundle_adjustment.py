"""Bundle adjustment of a turntable and its landmarks (markers or points): Levenberg-Marquardt with a robust loss.

Only what a turntable has is adjusted: one camera, one axis, one angle per frame, the landmarks, and if they are free
radial lens distortion and small motions of a wobbling table. The Schur complement eliminates the landmarks from the
normal equations: B. Triggs et al., "Bundle adjustment - a modern synthesis" (2000), sections 4.3 and 6.1.

Symbols: n observations with g residuals of r numbers each, l landmarks of d parameters, p other parameters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.turntable import Jacobian, Turntable

_MOST_STEPS = 100
_FIRST_DAMPING, _DAMPING_FACTOR = 1e-4, 8.0
_DAMPING_RANGE = (1e-12, 1e8)

T = TypeVar("T", bound=Turntable)


@dataclass(frozen=True)
class FreeParameters:
    """Which parameters are adjusted."""

    camera: bool = True
    """Focal length, rotation, and for markers the distance. The first frame's angle is held with a free camera."""
    radial_terms: int = 0
    """Number of coefficients of radial distortion: 0, 1 (k1) or 2 (k1, k2)."""
    angles: bool = True
    motion_sigmas: tuple[float, float] | None = None
    """Standard deviations of the table's tilts (rad) and shifts over the frames, a prior on them; infinite for none.
    None: the motions are held."""
    landmarks: bool = True
    marker_sides: bool = False
    """The log of each marker's side."""


@dataclass(frozen=True)
class ParameterLayout:
    """Columns of the parameters: camera, radial terms, angles, motions; behind these p come the landmarks."""

    motion_size: int
    """p, the number of parameters without the landmarks'."""
    camera: Int[np.ndarray, "c"]
    """Log focal length, rotation (3), and for markers the log distance."""
    radial: Int[np.ndarray, "r"]
    angle: Int[np.ndarray, "f"]
    """Held angles have the column p, which is dropped."""
    motion: Int[np.ndarray, "f 5"]
    landmark: Int[np.ndarray, "l d"]

    @property
    def size(self) -> int:
        """Number of all parameters."""
        return self.motion_size + self.landmark.size

    @staticmethod
    def of(
        free: FreeParameters, frames: int, landmarks: int, camera_size: int, landmark_size: int
    ) -> ParameterLayout:
        """The columns for a number of frames and landmarks."""
        camera = camera_size if free.camera else 0
        radial = camera + free.radial_terms
        held = frames if not free.angles else int(free.camera)
        angle = radial + frames - held
        size = angle + (5 * frames if free.motion_sigmas else 0)
        return ParameterLayout(
            motion_size=size,
            camera=np.arange(camera),
            radial=np.arange(camera, radial),
            angle=np.concatenate([np.full(held, size), np.arange(radial, angle)]),
            motion=np.arange(angle, size).reshape(-1, 5),
            landmark=size + np.arange(landmarks * landmark_size).reshape(landmarks, landmark_size),
        )


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton equations of camera and motion, of the landmarks, and the coupling of both."""

    motion: Float[np.ndarray, "p p"]
    motion_gradient: Float[np.ndarray, "p"]
    landmark: Float[np.ndarray, "l d d"]
    landmark_gradient: Float[np.ndarray, "l d"]
    coupling: Float[np.ndarray, "l d p"]

    def solve(self, damping: float) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "l d"]]:
        """The damped step of both kinds of parameters.

        Raises:
            LinAlgError: the damped equations are singular.
        """
        diagonal = np.einsum("lii->li", self.landmark)
        floor = 1e-12 * (1.0 + diagonal.max(axis=0, initial=0.0))
        inverse = np.linalg.inv(self.landmark + (damping * diagonal + floor)[:, :, None] * np.eye(diagonal.shape[1]))
        through = inverse @ self.coupling
        p = len(self.motion)
        reduced = self.motion - self.coupling.reshape(-1, p).T @ through.reshape(-1, p)
        right = self.motion_gradient - through.reshape(-1, p).T @ self.landmark_gradient.ravel()
        reduced[np.diag_indices(p)] += damping * np.maximum(self.motion.diagonal(), 1e-12)
        step = -cho_solve(cho_factor(reduced), right)
        return step, -np.einsum("lij,lj->li", inverse, self.landmark_gradient) - through @ step

    def dense(self) -> tuple[Float[np.ndarray, "p+l*d p+l*d"], Float[np.ndarray, "p+l*d"]]:
        """Normal matrix and gradient of all parameters, in the order of ``ParameterLayout``."""
        coupling = self.coupling.reshape(-1, len(self.motion))
        normal = np.block([[self.motion, coupling.T], [coupling, block_diag(*self.landmark)]])
        return normal, np.concatenate([self.motion_gradient, self.landmark_gradient.ravel()])


class Problem(ABC, Generic[T]):
    """Residuals of a turntable, their derivatives and robust normal equations.

    The loss of a residual of length r is soft L1, rho = 2 s^2 (sqrt(1 + r^2 / s^2) - 1) with the scale s: r^2 where
    it is small, 2 s r where it is large.
    """

    def __init__(
        self,
        layout: ParameterLayout,
        frame: Int[np.ndarray, "n"],
        landmark: Int[np.ndarray, "n"],
        free: FreeParameters,
        loss_scale: float,
    ) -> None:
        self.layout, self.free, self.loss_scale = layout, free, loss_scale
        self.frame, self.landmark = frame, landmark
        sigmas = free.motion_sigmas
        self.motion_sigmas = None if sigmas is None else np.repeat(sigmas, (2, 3))

    @abstractmethod
    def residuals(self, turntable: T) -> Float[np.ndarray, "n g r"]:
        """Projections less observations, in pixels or in standard deviations."""

    @abstractmethod
    def jacobian(self, turntable: T) -> tuple[Jacobian, Float[np.ndarray, "n g*r d"]]:
        """Derivatives of the residuals by camera and motion, and by the parameters of the row's own landmark."""

    @abstractmethod
    def with_landmark_step(self, turntable: T, step: Float[np.ndarray, "l d"]) -> T:
        """The turntable with its landmarks moved."""

    def cost(self, turntable: T) -> float:
        """Sum of the losses of the residuals, and of the motions in units of their standard deviations."""
        return float(self.losses(turntable).sum()) + float(self._loss(self.scaled_motions(turntable)).sum())

    def losses(self, turntable: T) -> Float[np.ndarray, "n"]:
        """The loss of each observation."""
        return self._loss(np.linalg.norm(self.residuals(turntable), axis=-1)).sum(axis=-1)

    def scaled_motions(self, turntable: T) -> Float[np.ndarray, "f 5"]:
        """The table's tilts and shifts in units of their standard deviations."""
        if self.motion_sigmas is None:
            return np.zeros((0, 5))
        return turntable.tilts_and_shifts() / self.motion_sigmas

    def motion_jacobian(self, jacobian: Jacobian) -> tuple[Int[np.ndarray, "n k"], Float[np.ndarray, "n g*r k"]]:
        """The columns that a row depends on, and its derivatives by them."""
        c, n = self.layout, len(self.frame)
        shared = np.concatenate([c.camera, c.radial])
        columns = [np.broadcast_to(shared, (n, len(shared)))]
        values = [jacobian.camera[..., : len(c.camera)], jacobian.radial[..., : len(c.radial)]]
        if self.free.angles:
            columns.append(c.angle[self.frame][:, None])
            values.append(jacobian.angle)
        if jacobian.motion is not None and self.motion_sigmas is not None:
            columns.append(c.motion[self.frame])
            values.append(jacobian.motion)
        return np.concatenate(columns, axis=1), np.concatenate(values, axis=2)

    def normal_equations(self, turntable: T) -> NormalEquations:
        """The normal equations with each residual weighted by its loss: 1 / sqrt(1 + r^2 / s^2)."""
        residual = self.residuals(turntable)
        jacobian, by_landmark = self.jacobian(turntable)
        columns, values = self.motion_jacobian(jacobian)
        weight = np.broadcast_to(self._weight(np.linalg.norm(residual, axis=-1))[..., None], residual.shape)
        residual, weight = residual.reshape(len(values), -1, 1), weight.reshape(len(values), -1, 1)
        weighted = np.swapaxes(weight * values, 1, 2)
        width, (size, d) = self.layout.motion_size + 1, self.layout.landmark.shape
        cell = columns[:, :, None] * width + columns[:, None, :]
        motion = np.bincount(cell.ravel(), (weighted @ values).ravel(), width**2).reshape(width, width)
        gradient = np.bincount(columns.ravel(), (weighted @ residual).ravel(), width)
        weighted_landmark = np.swapaxes(weight * by_landmark, 1, 2)
        pair = (self.landmark[:, None] * width + columns).ravel()
        products = weighted_landmark @ values
        coupling = [np.bincount(pair, products[:, k].ravel(), size * width) for k in range(d)]
        if self.motion_sigmas is not None:
            at, motions = self.layout.motion, self.scaled_motions(turntable)
            weight = self._weight(motions)
            motion[at, at] += weight / self.motion_sigmas**2
            gradient[at] += weight * motions / self.motion_sigmas
        return NormalEquations(
            motion=motion[:-1, :-1],
            motion_gradient=gradient[:-1],
            landmark=_summed(weighted_landmark @ by_landmark, self.landmark, size),
            landmark_gradient=_summed((weighted_landmark @ residual)[..., 0], self.landmark, size),
            coupling=np.array(coupling).reshape(d, size, width).swapaxes(0, 1)[..., :-1],
        )

    def moved(self, turntable: T, step: Float[np.ndarray, "p"], landmark_step: Float[np.ndarray, "l d"]) -> T:
        """The turntable after a step of the parameters."""
        c = self.layout
        camera = np.zeros(5)
        camera[: len(c.camera)] = step[c.camera]
        radial = np.array(turntable.radial)
        radial[: len(c.radial)] += step[c.radial]
        focal_factor, distance_factor = np.exp(np.clip(camera[[0, 4]], -1.0, 1.0))
        moved = replace(
            turntable,
            focal_px=turntable.focal_px * float(focal_factor),
            camera_rotation=Rotation.from_rotvec(camera[1:4]).as_matrix() @ turntable.camera_rotation,
            distance=turntable.distance * float(distance_factor),
            angles_rad=turntable.angles_rad + np.append(step, 0.0)[c.angle],
            radial=(float(radial[0]), float(radial[1])),
        )
        if self.motion_sigmas is not None:
            motion = turntable.tilts_and_shifts() + step[c.motion]
            moved = replace(moved, tilts_rad=motion[:, :2], shifts=motion[:, 2:])
        return self.with_landmark_step(moved, landmark_step) if c.landmark.size else moved

    def minimise(self, turntable: T, smallest_gain: float = 1e-9) -> T:
        """Levenberg-Marquardt.

        Args:
            turntable: the start.
            smallest_gain: stop where a step lowers the cost by a smaller fraction.

        Raises:
            InputError: points of the start lie behind the camera.
        """
        if self.motion_sigmas is not None:
            motion = turntable.tilts_and_shifts()
            turntable = replace(turntable, tilts_rad=motion[:, :2], shifts=motion[:, 2:])
        cost, damping = self.cost(turntable), _FIRST_DAMPING
        if not np.isfinite(cost):
            raise InputError(
                "the points of the object do not lie before the camera; the poses to start from are wrong"
            )
        for _ in range(_MOST_STEPS):
            equations, lower = self.normal_equations(turntable), np.inf
            while not lower < cost:
                try:
                    candidate = self.moved(turntable, *equations.solve(damping))
                    lower = self.cost(candidate)
                except (LinAlgError, ValueError):
                    lower = np.inf
                if lower < cost:
                    break
                damping *= _DAMPING_FACTOR
                if damping > _DAMPING_RANGE[1]:
                    return turntable
            gain, turntable, cost = cost - lower, candidate, lower
            damping = max(damping / _DAMPING_FACTOR, _DAMPING_RANGE[0])
            if gain < smallest_gain * cost:
                break
        return turntable

    def _loss(self, r: np.ndarray) -> np.ndarray:
        return 2.0 * self.loss_scale**2 * (np.sqrt(1.0 + (r / self.loss_scale) ** 2) - 1.0)

    def _weight(self, r: np.ndarray) -> np.ndarray:
        return 1.0 / np.sqrt(1.0 + (r / self.loss_scale) ** 2)


def loop_closure_deg(problem: Problem[T], turntable: T) -> float | None:
    """Sum of the steps between neighbouring frames, and from the last to the first, less those of the turntable.

    Each step is measured by the landmarks that its two frames share alone, so that errors add up as in any chain; the
    adjusted angles close by construction. None where two neighbours share no landmark.
    """
    jacobian, _ = problem.jacobian(turntable)
    residual = problem.residuals(turntable).reshape(len(problem.frame), -1)
    # The turn that each observation alone suggests, and the inverse of that angle's variance.
    information = (jacobian.angle**2).sum((1, 2))
    own_rad = -(jacobian.angle[..., 0] * residual).sum(-1) / np.maximum(information, 1e-12)
    total = 0.0
    rows = [np.flatnonzero(problem.frame == f) for f in range(len(turntable.frames))]
    for here, there in zip(rows, [*rows[1:], rows[0]], strict=True):
        _, i, j = np.intersect1d(problem.landmark[here], problem.landmark[there], return_indices=True)
        before, after = here[i], there[j]
        # Variances of the two ends add.
        weight = (
            information[before] * information[after] / np.maximum(information[before] + information[after], 1e-12)
        )
        if weight.sum() <= 0.0:
            return None
        total += float((weight * (own_rad[after] - own_rad[before])).sum() / weight.sum())
    return float(np.rad2deg(total))


def _summed(values, index, size):
    """Sums of the values (n, ...) of equal index."""
    columns = values.reshape(len(values), int(np.prod(values.shape[1:]))).T
    sums = [np.bincount(index, c, size) for c in columns]
    return np.array(sums).reshape(len(columns), size).T.reshape(size, *values.shape[1:])
