"""Bundle adjustment of a turntable and its landmarks (markers, points): Levenberg-Marquardt with a robust loss.

Only what a turntable has is adjusted: one camera, one axis, one angle per frame, the landmarks, and if they are free
radial lens distortion and small motions of a wobbling table. The landmarks are eliminated (``normal_equations``):
B. Triggs et al., "Bundle adjustment - a modern synthesis" (2000), section 4.3. SciPy's ``least_squares`` has no such
elimination; thousands of points would take it minutes.

Symbols: n sightings with g residuals of r numbers each, l landmarks of d parameters, p other parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.normal_equations import LandmarkEquations, NormalEquations
from hsi_sc_nerf.poses.residuals import PointResiduals, Residuals
from hsi_sc_nerf.poses.turntable import Jacobian, Turntable

_MOST_STEPS = 100
_FIRST_DAMPING, _DAMPING_FACTOR = 1e-4, 8.0
_DAMPING_RANGE = (1e-12, 1e8)
# A known focal length weighs as if its standard deviation were this fraction of what it is, for that of the landmarks
# may be wrong by more than they tell (``Adjusted.covariance`` counts what it is).
_HELD = 0.03


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
    """Columns of camera, radial terms, angles, motions and hidden errors; behind these p come the landmarks."""

    motion_size: int
    """p, the number of parameters without the landmarks'."""
    camera: Int[np.ndarray, "c"]
    """Log focal length, rotation (3), log distance."""
    radial: Int[np.ndarray, "r"]
    angle: Int[np.ndarray, "f"]
    """Held angles have the column p, which is dropped."""
    motion: Int[np.ndarray, "f 5"]
    hidden: tuple[Int[np.ndarray, "k"], ...]
    landmarks: tuple[Int[np.ndarray, "l d"], ...]
    """Of each kind of residuals, and so are the hidden errors."""

    @property
    def size(self) -> int:
        """Number of all parameters."""
        return self.motion_size + sum(columns.size for columns in self.landmarks)

    @staticmethod
    def of(free: FreeParameters, frames: int, residuals: Sequence[Residuals]) -> ParameterLayout:
        """The columns for a number of frames, and the landmarks and hidden errors of the residuals."""
        camera = (4 + free.distance) * free.camera
        radial = camera + free.radial_terms
        held = frames if not free.angles else int(free.camera)
        angle = radial + frames - held
        motion = angle + (5 * frames if free.motion_sigmas else 0)
        hidden_sizes = [0 if part.hidden is None else part.hidden.shape[-1] for part in residuals]
        size = end = motion + sum(hidden_sizes)
        landmarks = []
        for part in residuals:
            landmarks.append(end + np.arange(part.size * part.d).reshape(part.size, part.d))
            end += part.size * part.d
        return ParameterLayout(
            motion_size=size,
            camera=np.arange(camera),
            radial=np.arange(camera, radial),
            angle=np.concatenate([np.full(held, size), np.arange(radial, angle)]),
            motion=np.arange(angle, motion).reshape(-1, 5),
            hidden=tuple(np.split(np.arange(motion, size), np.cumsum(hidden_sizes)[:-1])),
            landmarks=tuple(landmarks),
        )


class Problem:
    """Residuals of a turntable, their derivatives and robust normal equations."""

    def __init__(self, start: Turntable, *residuals: Residuals, free: FreeParameters | None = None) -> None:
        """Args:
        start: the turntable that the residuals were made for.
        residuals: of each kind of landmarks.
        free: parameters to adjust beside the landmarks; by default camera and angles.
        """
        self.residuals, self.free = residuals, free or FreeParameters()
        self.layout = ParameterLayout.of(self.free, len(start.frames), residuals)
        self.numbers = sum(part.numbers for part in residuals)

    def cost(self, turntable: Turntable) -> float:
        """Sum of the losses of the residuals, and of the squares of what contradicts prior knowledge."""
        away, _ = self.priors(turntable)
        return sum(float(part.losses(turntable).sum()) for part in self.residuals) + float(away @ away)

    def priors(self, turntable: Turntable) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k p+1"]]:
        """Distances from what is known before in standard deviations, and their derivatives.

        The angle of no frame is known better than another's, that of the first one neither: known angles count
        relative to the mean of all.
        """
        free, c = self.free, self.layout
        away, by = [np.zeros(0)], [np.zeros((0, c.motion_size + 1))]

        def add(distances: np.ndarray, columns: np.ndarray, jacobian: np.ndarray) -> None:
            away.append(distances)
            by.append(np.zeros((len(distances), c.motion_size + 1)))
            np.add.at(by[-1], (np.arange(len(distances))[:, None], columns), jacobian)

        if free.motion_sigmas is not None and turntable.motion is not None:
            sigmas = np.tile(np.repeat(free.motion_sigmas, (2, 3)), len(c.motion))
            add(turntable.motion.ravel() / sigmas, c.motion.reshape(-1, 1), 1.0 / sigmas[:, None])
        if free.known_focal is not None:
            focal_px, sigma = free.known_focal
            sigma *= _HELD
            add(np.log([turntable.focal_px / focal_px]) / sigma, c.camera[:1], np.array([[1.0 / sigma]]))
        if free.known_angles is not None:
            angles_rad, sigma = free.known_angles
            about_mean = np.eye(len(angles_rad)) - 1.0 / len(angles_rad)
            add(about_mean @ (turntable.angles_rad - angles_rad) / sigma, c.angle, about_mean / sigma)
        return np.concatenate(away), np.concatenate(by)

    def motion_jacobian(
        self, part: Residuals, jacobian: Jacobian
    ) -> tuple[Int[np.ndarray, "n k"], Float[np.ndarray, "n g*r k"]]:
        """The columns that a row depends on, and its derivatives by them."""
        c, n = self.layout, len(part.frame)
        shared = np.concatenate([c.camera, c.radial])
        columns = [np.broadcast_to(shared, (n, len(shared)))]
        values = [jacobian.camera[..., : len(c.camera)], jacobian.radial[..., : len(c.radial)]]
        if self.free.angles:
            columns.append(c.angle[part.frame][:, None])
            values.append(jacobian.angle)
        if jacobian.motion is not None and c.motion.size:
            columns.append(c.motion[part.frame])
            values.append(jacobian.motion)
        if jacobian.hidden is not None:
            hidden = c.hidden[self.residuals.index(part)]
            columns.append(np.broadcast_to(hidden, (n, len(hidden))))
            values.append(jacobian.hidden)
        return np.concatenate(columns, axis=1), np.concatenate(values, axis=2)

    def normal_equations(self, turntable: Turntable) -> NormalEquations:
        """The normal equations with each residual weighted by its loss."""
        width = self.layout.motion_size + 1
        motion, gradient, landmarks = np.zeros((width, width)), np.zeros(width), []
        for part in self.residuals:
            residual = part.values(turntable)
            jacobian, by_landmark = part.jacobian(turntable)
            columns, values = self.motion_jacobian(part, jacobian)
            weight, residual = (a.reshape(len(values), -1, 1) for a in (part.weights(residual), residual))
            weighted = np.swapaxes(weight * values, 1, 2)
            cell = columns[:, :, None] * width + columns[:, None, :]
            own = np.bincount(cell.ravel(), (weighted @ values).ravel(), width**2).reshape(width, width)
            weighted_landmark = np.swapaxes(weight * by_landmark, 1, 2)
            pair = (part.landmark[:, None] * width + columns).ravel()
            products = weighted_landmark @ values
            coupling = [np.bincount(pair, products[:, k].ravel(), part.size * width) for k in range(part.d)]
            scores = np.bincount(pair, (weighted @ residual).ravel(), part.size * width).reshape(part.size, width)
            motion += own
            gradient += scores.sum(axis=0)
            landmarks.append(
                LandmarkEquations(
                    normal=_summed(weighted_landmark @ by_landmark, part.landmark, part.size),
                    gradient=_summed((weighted_landmark @ residual)[..., 0], part.landmark, part.size),
                    coupling=np.array(coupling).reshape(part.d, part.size, width).swapaxes(0, 1)[..., :-1],
                    motion=own[:-1, :-1],
                    motion_gradient=scores[:, :-1],
                )
            )
        away, by = self.priors(turntable)
        motion += by.T @ by
        gradient += by.T @ away
        return NormalEquations(motion[:-1, :-1], gradient[:-1], tuple(landmarks))

    def moved(
        self, turntable: Turntable, step: Float[np.ndarray, "p"], landmark_steps: Sequence[Float[np.ndarray, "l d"]]
    ) -> Turntable:
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
        for part, landmark_step in zip(self.residuals, landmark_steps, strict=True):
            turntable = part.moved(turntable, landmark_step) if part.d else turntable
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


@dataclass(frozen=True)
class Adjusted:
    """An adjusted turntable and the problem that it solves."""

    turntable: Turntable
    problem: Problem
    displaced_frames: Mapping[int, float] = field(default_factory=dict)
    """Frames that were left out because they fit the turntable only with a motion of their own, and the root mean
    square distance of their corners from the turntable's at the best angle, px."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """How strongly the sightings call for lens_distortion and for wobble: -log10 of the probability that chance alone
    lowers the squares as much."""

    @cached_property
    def cost(self) -> float:
        """Of the problem at the turntable."""
        return self.problem.cost(self.turntable)

    @property
    def degrees_of_freedom(self) -> int:
        """Number of residuals less parameters, at least 1."""
        return max(1, self.problem.numbers - self.problem.layout.size)

    @property
    def variance(self) -> float:
        """Of the residuals: 1 if the sightings' covariances are right; at least that."""
        return max(1.0, self.cost / self.degrees_of_freedom)

    def covariance(self) -> Float[np.ndarray, "p p"]:
        """Of camera, lens, angles and motions, in the order of ``ParameterLayout``.

        Errors of one point in neighbouring frames are alike. Its sightings count together, by how much the points
        contradict each other (the cluster-robust estimate of K.-Y. Liang and S. L. Zeger, 1986; A. C. Cameron and
        D. L. Miller, "A practitioner's guide to cluster-robust inference", 2015). Hidden errors, of unit variance,
        were not adjusted: they add what they do to the parameters.
        """
        equations = self.problem.normal_equations(self.turntable)
        information, hidden = equations.information(), np.concatenate(self.problem.layout.hidden)
        scatter = self.variance * information
        for part, (own, scores) in zip(self.problem.residuals, equations.reduced(), strict=True):
            if isinstance(part, PointResiduals):
                scatter += scores.T @ scores - self.variance * own
                information += (part.curvature(self.turntable) - 1.0) * own
        if self.problem.free.known_focal is not None:
            sigma = self.problem.free.known_focal[1]
            scatter[0, 0] += 1.0 / (_HELD**2 * sigma) ** 2 - self.variance / (_HELD * sigma) ** 2
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


def _summed(values, index, size):
    """Sums of the values (n, ...) of equal index."""
    columns = values.reshape(len(values), int(np.prod(values.shape[1:]))).T
    sums = [np.bincount(index, c, size) for c in columns]
    return np.array(sums).reshape(len(columns), size).T.reshape(size, *values.shape[1:])
