"""Bundle adjustment of a turntable and its landmarks (markers, points): Levenberg-Marquardt with a robust loss.

Only what a turntable has is adjusted: one camera, one axis, one angle per frame, the landmarks, and if they are free
radial lens distortion and small motions of a wobbling table. The Schur complement eliminates the landmarks: B. Triggs
et al., "Bundle adjustment - a modern synthesis" (2000), sections 4.3 and 6.1. SciPy's ``least_squares`` has no such
elimination; thousands of points would take it minutes.

Symbols: n observations with g residuals of r numbers each, l landmarks of d parameters, p other parameters, m
parameters and N residual numbers in all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import coo_array, csc_array, csr_array, diags_array, vstack
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.residuals import PointResiduals, Residuals
from hsi_sc_nerf.poses.turntable import Turntable

_MOST_STEPS = 100
_FIRST_DAMPING, _DAMPING_FACTOR = 1e-4, 8.0
_DAMPING_RANGE = (1e-12, 1e8)
# A known focal length is weighted as if its standard deviation were this fraction of the stated one, because that of
# the landmarks may be wrong by more than its covariance (``Adjusted.covariance`` uses the stated one).
_PRIOR_SCALE = 0.03


@dataclass(frozen=True)
class FreeParameters:
    """Which parameters beside the landmarks are adjusted."""

    camera: bool = True
    """Focal length, rotation, distance. The first frame's angle is held with a free camera."""
    distance: bool = True
    """False where no landmark has a known size: the distance is the unit of length."""
    radial_terms: int = 0
    """Number of coefficients of radial distortion: 0, 1 (k1) or 2 (k1, k2)."""
    angles: bool = True
    motion_sigmas: tuple[float, float] | None = None
    """Standard deviations of the table's tilts (rad) and shifts over the frames, a prior on them; infinite for none.
    None: the motions are held."""
    known_focal: tuple[float, float] | None = None
    """Focal length (px) by an earlier session, and its standard deviation as a fraction."""
    known_angles: tuple[Float[np.ndarray, "f"], float] | None = None
    """The frames' angles (rad) by the turntable, and their standard deviation."""


@dataclass(frozen=True)
class ParameterLayout:
    """Columns of the Jacobian: camera, radial terms, angles, motions and hidden errors; then the landmarks'."""

    camera: Int[np.ndarray, "c"]
    """Log focal length, rotation (3), log distance."""
    radial: Int[np.ndarray, "r"]
    angle: Int[np.ndarray, "f"]
    """Held angles have the column -1, which is dropped."""
    motion: Int[np.ndarray, "f 5"]
    hidden: tuple[Int[np.ndarray, "k"], ...]
    motion_size: int
    """p, the number of parameters without the landmarks'."""
    landmarks: tuple[Int[np.ndarray, "l d"], ...]
    """One array for each kind of residuals, as in ``hidden``."""
    size: int
    """m, the number of all parameters."""

    @staticmethod
    def of(free: FreeParameters, residuals: Sequence[Residuals]) -> ParameterLayout:
        """The columns for the residuals' frames, landmarks and hidden errors."""
        end, frames = 0, residuals[0].frames

        def take(*shape: int) -> Int[np.ndarray, "*shape"]:
            nonlocal end
            end += math.prod(shape)
            return np.arange(end - math.prod(shape), end).reshape(shape)

        held = frames if not free.angles else int(free.camera)
        return ParameterLayout(
            camera=take((4 + free.distance) * free.camera),
            radial=take(free.radial_terms),
            angle=np.concatenate([np.full(held, -1), take(frames - held)]),
            motion=take(frames if free.motion_sigmas else 0, 5),
            hidden=tuple(take(0 if part.hidden is None else part.hidden.shape[-1]) for part in residuals),
            motion_size=end,
            landmarks=tuple(take(part.size, part.d) for part in residuals),
            size=end,
        )


class Problem:
    """Residuals of a turntable, their derivatives and robust normal equations."""

    def __init__(self, *residuals: Residuals, free: FreeParameters | None = None) -> None:
        """Args:
        residuals: of each kind of landmarks, made for the same turntable.
        free: parameters to adjust beside the landmarks; by default camera and angles.
        """
        self.residuals, self.free = residuals, free or FreeParameters()
        self.layout = ParameterLayout.of(self.free, residuals)
        self.numbers = sum(part.numbers for part in residuals)

    def cost(self, turntable: Turntable) -> float:
        """Sum of the losses of the residuals and of the squared differences from prior knowledge."""
        residual, _ = self.priors(turntable)
        return sum(float(part.losses(turntable).sum()) for part in self.residuals) + float(residual @ residual)

    def priors(self, turntable: Turntable) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k p+1"]]:
        """Differences from prior knowledge in standard deviations, and their derivatives.

        Known angles are compared relative to their mean, because no frame's angle is known better than another's.
        """
        free, c = self.free, self.layout
        residual, by = [np.zeros(0)], [np.zeros((0, c.motion_size + 1))]

        def add(distances: np.ndarray, columns: np.ndarray, jacobian: np.ndarray) -> None:
            residual.append(distances)
            by.append(np.zeros((len(distances), c.motion_size + 1)))
            np.add.at(by[-1], (np.arange(len(distances))[:, None], columns), jacobian)

        if free.motion_sigmas is not None and turntable.motion is not None:
            sigmas = np.tile(np.repeat(free.motion_sigmas, (2, 3)), len(c.motion))
            add(turntable.motion.ravel() / sigmas, c.motion.reshape(-1, 1), 1.0 / sigmas[:, None])
        if free.known_focal is not None:
            focal_px, sigma = free.known_focal
            sigma *= _PRIOR_SCALE
            add(np.log([turntable.focal_px / focal_px]) / sigma, c.camera[:1], np.array([[1.0 / sigma]]))
        if free.known_angles is not None:
            angles_rad, sigma = free.known_angles
            about_mean = np.eye(len(angles_rad)) - 1.0 / len(angles_rad)
            add(about_mean @ (turntable.angles_rad - angles_rad) / sigma, c.angle, about_mean / sigma)
        return np.concatenate(residual), np.concatenate(by)

    def normal_equations(self, turntable: Turntable) -> NormalEquations:
        """The normal equations with each residual weighted by its loss."""
        jacobians, residuals, width = [], [], self.layout.size + 1
        for part in self.residuals:
            residual, (columns, values) = part.values(turntable), self._derivatives(part, turntable)
            root = np.sqrt(part.weights(residual)).reshape(*values.shape[:2], 1)
            cells = np.broadcast_to(columns[:, None] % width, values.shape)
            starts = np.arange(values.shape[0] * values.shape[1] + 1) * values.shape[2]
            jacobians.append(csr_array(((root * values).ravel(), cells.ravel(), starts), (len(starts) - 1, width)))
            residuals.append(root.ravel() * residual.ravel())
        prior, by = self.priors(turntable)
        jacobians.append(csr_array(np.pad(by[:, :-1], ((0, 0), (0, width - by.shape[1] + 1)))))
        jacobian = vstack(jacobians, format="csr")[:, :-1]
        return NormalEquations(jacobian, np.concatenate([*residuals, prior]), self)

    def _derivatives(
        self, part: Residuals, turntable: Turntable
    ) -> tuple[Int[np.ndarray, "n k"], Float[np.ndarray, "n g*r k"]]:
        """The columns that the rows of an observation depend on, and the derivatives by them."""
        (jacobian, by_landmark), c, kind = part.jacobian(turntable), self.layout, self.residuals.index(part)
        pairs = [
            (c.camera, jacobian.camera[..., : len(c.camera)]),
            (c.radial, jacobian.radial[..., : len(c.radial)]),
            (c.landmarks[kind][part.landmark], by_landmark),
        ]
        if self.free.angles:
            pairs.append((c.angle[part.frame][:, None], jacobian.angle))
        if jacobian.motion is not None and c.motion.size:
            pairs.append((c.motion[part.frame], jacobian.motion))
        if jacobian.hidden is not None:
            pairs.append((c.hidden[kind], jacobian.hidden))
        columns = [np.broadcast_to(own, (len(part.frame), own.shape[-1])) for own, _ in pairs]
        return np.concatenate(columns, axis=1), np.concatenate([by for _, by in pairs], axis=2)

    def moved(self, turntable: Turntable, step: Float[np.ndarray, "m"]) -> Turntable:
        """The turntable after a step of the parameters."""
        c = self.layout
        camera, radial = np.zeros(5), np.array(turntable.radial)
        camera[: len(c.camera)] = step[c.camera]
        radial[: len(c.radial)] += step[c.radial]
        focal_factor, distance_factor = np.exp(np.clip(camera[[0, 4]], -1.0, 1.0))
        turntable = replace(
            turntable,
            focal_px=turntable.focal_px * float(focal_factor),
            camera_rotation=Rotation.from_rotvec(camera[1:4]).as_matrix() @ turntable.camera_rotation,
            distance=turntable.distance * float(distance_factor),
            angles_rad=turntable.angles_rad + np.append(step, 0.0)[c.angle],
            radial=(float(radial[0]), float(radial[1])),
        )
        if c.motion.size:
            before = 0.0 if turntable.motion is None else turntable.motion
            turntable = replace(turntable, motion=before + step[c.motion])
        for part, columns in zip(self.residuals, c.landmarks, strict=True):
            turntable = part.moved(turntable, step[columns]) if part.d else turntable
        return turntable

    def minimise(self, turntable: Turntable, smallest_gain: float = 1e-9) -> Turntable:
        """Levenberg-Marquardt.

        Args:
            turntable: the start.
            smallest_gain: stop where a step lowers the cost by a smaller fraction.

        Raises:
            InputError: points of the start lie behind the camera.
        """
        if self.layout.motion.size and turntable.motion is None:
            turntable = replace(turntable, motion=np.zeros((len(turntable.frames), 5)))
        cost, damping = self.cost(turntable), _FIRST_DAMPING
        if not np.isfinite(cost):
            raise InputError("first poses put points behind the camera; take smaller steps, or show more markers")
        for _ in range(_MOST_STEPS):
            equations = self.normal_equations(turntable)
            while True:
                with suppress(LinAlgError, RuntimeError, ValueError):
                    candidate = self.moved(turntable, equations.solve(damping))
                    lower = self.cost(candidate)
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


class NormalEquations:
    """Gauss-Newton equations of all parameters. Landmarks are not coupled: their part is block-diagonal."""

    def __init__(self, jacobian: csr_array, residual: Float[np.ndarray, "N"], problem: Problem) -> None:
        """Args:
        jacobian: by the m parameters, rows weighted; those of each kind of residuals, then those of the priors.
        residual: rows weighted in the same way.
        problem: that is linearised.
        """
        self.jacobian, self.residual, self.problem = jacobian, residual, problem
        self.gradient, normal = jacobian.T @ residual, csc_array(jacobian.T @ jacobian)
        p = self.p = problem.layout.motion_size
        self.motion, self.coupling = normal[:p, :p].toarray(), normal[p:, :p].toarray()
        self.landmarks = normal[p:, p:]

    def solve(self, damping: float) -> Float[np.ndarray, "m"]:
        """The damped step.

        Raises:
            LinAlgError, RuntimeError: the damped equations are singular.
        """
        right = np.column_stack([self.coupling, self.gradient[self.p :]])
        through, alone = np.split(self._by_landmarks(right, damping), [self.p], axis=1)
        normal = self.motion - self.coupling.T @ through
        normal[np.diag_indices(self.p)] += damping * np.maximum(self.motion.diagonal(), 1e-12)
        step = -cho_solve(cho_factor(normal), self.gradient[: self.p] - through.T @ self.gradient[self.p :])
        return np.concatenate([step, -alone[:, 0] - through @ step])

    def information(self) -> Float[np.ndarray, "p p"]:
        """The inverse covariance of camera and motion for residuals of unit variance, the landmarks being unknown."""
        return self.motion + self.coupling.T @ self.landmark_responses()

    def reduced(self, kind: int) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "l p"]]:
        """One kind's part of ``information``, and the contribution of each of its landmarks to the gradient by camera
        and motion after the landmark is eliminated. The contributions sum to 0 for an adjusted turntable."""
        columns, part = self.problem.layout.landmarks[kind] - self.p, self.problem.residuals[kind]
        first = sum(other.numbers for other in self.problem.residuals[:kind])
        motion, residual = (a[first : first + part.numbers] for a in (self.jacobian[:, : self.p], self.residual))
        response = self.landmark_responses()[columns]
        row = np.repeat(part.landmark, part.numbers // len(part.landmark)), np.arange(part.numbers)
        scores = coo_array((residual, row), shape=(part.size, part.numbers)) @ motion
        return (
            (motion.T @ motion).toarray() + np.einsum("ldp,ldq->pq", self.coupling[columns], response),
            scores.toarray() + np.einsum("ldp,ld->lp", response, self.gradient[self.p :][columns]),
        )

    def landmark_responses(self) -> Float[np.ndarray, "m-p p"]:
        """Derivatives of the best-fitting landmarks by camera and motion."""
        return -self._by_landmarks(self.coupling)

    def _by_landmarks(self, right: Float[np.ndarray, "m-p k"], damping: float = 0.0) -> Float[np.ndarray, "m-p k"]:
        """The right sides times the inverse of the landmarks' damped blocks."""
        if len(right) == 0:
            return right
        diagonal = self.landmarks.diagonal()
        floor = 1e-12 * (1.0 + diagonal.max())
        return splu(csc_array(self.landmarks + diags_array(damping * diagonal + floor))).solve(right)


@dataclass(frozen=True)
class Adjusted:
    """An adjusted turntable and the problem that it solves."""

    turntable: Turntable
    problem: Problem
    displaced_frames: Mapping[int, float] = field(default_factory=dict)
    """Frames that were left out because they fit the turntable only with a motion of their own, and the root mean
    square distance of their corners from the turntable's at the best angle, px."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """Evidence for lens_distortion and for wobble: -log10 of the p-value of an F-test."""

    @cached_property
    def cost(self) -> float:
        """Cost of the problem at the turntable."""
        return self.problem.cost(self.turntable)

    @property
    def degrees_of_freedom(self) -> int:
        """Number of residuals less parameters, at least 1."""
        return max(1, self.problem.numbers - self.problem.layout.size)

    @property
    def variance(self) -> float:
        """Variance of the residuals, at least 1, its value if the observations' covariances are right."""
        return max(1.0, self.cost / self.degrees_of_freedom)

    def covariance(self) -> Float[np.ndarray, "p p"]:
        """Covariance of camera, lens, angles and motions, in the order of ``ParameterLayout``.

        Errors of one point in neighbouring frames are correlated, so the observations of a point form a cluster, and
        the covariance comes from the scatter between clusters (the cluster-robust estimate of K.-Y. Liang and
        S. L. Zeger, 1986; A. C. Cameron and D. L. Miller, "A practitioner's guide to cluster-robust inference",
        2015). Hidden errors, of unit variance, are not adjusted; their effect on the parameters is added.
        """
        equations = self.problem.normal_equations(self.turntable)
        information, hidden = equations.information(), np.concatenate(self.problem.layout.hidden)
        scatter = self.variance * information
        for kind, part in enumerate(self.problem.residuals):
            if isinstance(part, PointResiduals):
                own, scores = equations.reduced(kind)
                scatter += scores.T @ scores - self.variance * own
                information += (part.curvature(self.turntable) - 1.0) * own
        if self.problem.free.known_focal is not None:
            sigma = self.problem.free.known_focal[1]
            scatter[0, 0] += 1.0 / (_PRIOR_SCALE**2 * sigma) ** 2 - self.variance / (_PRIOR_SCALE * sigma) ** 2
        shown = np.setdiff1d(np.arange(len(information)), hidden)
        inverse = np.linalg.pinv(information[np.ix_(shown, shown)], hermitian=True)
        response = inverse @ information[np.ix_(shown, hidden)]
        covariance = np.zeros_like(information)
        covariance[np.ix_(shown, shown)] = inverse @ scatter[np.ix_(shown, shown)] @ inverse + response @ response.T
        return covariance

    def angle_sigmas_deg(self, covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "f"]:
        """Standard deviations of the frames' angles relative to the mean of all, degrees."""
        angles = np.pad(covariance, ((0, 1), (0, 1)))[np.ix_(self.problem.layout.angle, self.problem.layout.angle)]
        variance = angles.diagonal() - 2.0 * angles.mean(axis=0) + angles.mean()
        return np.rad2deg(np.sqrt(np.maximum(variance, 0.0)))
