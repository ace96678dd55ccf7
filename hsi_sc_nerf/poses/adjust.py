"""Bundle adjustment over exactly what the machine has: a fixed camera, one axis, an angle a frame, square markers.

Where the residuals call for it (``choose``), radial lens distortion and small motions of the table are found as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.poses.initialise import Observations, Turntable
from hsi_sc_nerf.poses.projection import corner_slopes, project_corners

_STEPS = 100
_SMALLEST_GAIN = 1e-9
_LARGEST_DAMPING = 1e8
_CAMERA, _MARKER, _MOTION = 5, 6, 5


@dataclass(frozen=True)
class Unknowns:
    """What the adjustment finds beside the camera, the angles and the marker layout."""

    radial_terms: int = 0
    """How many coefficients of radial lens distortion: none, k1, or k1 and k2; the others stay as they are."""
    motion_spread: tuple[float, float] | None = None
    """Standard deviations of the table's tilts (rad) and shifts (m) over the frames; None where it keeps still."""


@dataclass(frozen=True)
class Columns:
    """Where the unknowns lie in the vector of all of them.

    In order: camera (5), radial terms, an angle a frame but the first, a marker's pose (6), a frame's motion (5).
    """

    size: int
    """How many unknowns there are; ``angle`` of the first frame points to this place, behind them all."""
    radial: Int[np.ndarray, "r"]
    angle: Int[np.ndarray, "f"]
    marker: Int[np.ndarray, "m 6"]
    motion: Int[np.ndarray, "f 5"]

    @staticmethod
    def of(turntable: Turntable, unknowns: Unknowns) -> Columns:
        """The layout of a turntable's unknowns."""
        frames, markers = len(turntable.frames), len(turntable.markers)
        angle = _CAMERA + unknowns.radial_terms
        marker = angle + frames - 1
        motion = marker + _MARKER * markers
        size = motion + (_MOTION * frames if unknowns.motion_spread else 0)
        return Columns(
            size=size,
            radial=np.arange(_CAMERA, angle),
            angle=np.concatenate([[size], np.arange(angle, marker)]),
            marker=np.arange(marker, motion).reshape(markers, _MARKER),
            motion=np.arange(motion, size).reshape(-1, _MOTION),
        )


def adjust(
    start: Turntable,
    observations: Observations,
    centre_px: tuple[float, float],
    side_m: float,
    weights: Float[np.ndarray, "n 8 8"],
    loss_scale: float,
    unknowns: Unknowns | None = None,
) -> Turntable:
    """Least squares of weighted reprojection residuals with a soft L1 loss.

    Args:
        start: where to start; its ``frames`` and ``markers`` must cover the observations.
        observations: marker corners.
        centre_px: the principal point, fixed.
        side_m: the markers' side, fixed: it gives the scale.
        weights: an observation's residual (x0, y0, x1, ...) is multiplied by this before the loss, for example by
            ``whitening`` of its covariance.
        loss_scale: weighted residuals well above this count by their size, not its square.
        unknowns: what is found beside camera, angles and layout; nothing by default.
    """
    problem = Problem(start, observations, centre_px, side_m, weights, unknowns or Unknowns())
    return _levenberg_marquardt(problem, start, loss_scale)


def reproject(
    turntable: Turntable, observations: Observations, centre_px: tuple[float, float], side_m: float
) -> Float[np.ndarray, "n 4 2"]:
    """Where the turntable puts the corners of each observation, in pixels."""
    frame, marker = _rows(turntable, observations)
    return project_corners(turntable, frame, marker, centre_px, side_m).pixels


def angle_slopes(
    turntable: Turntable, observations: Observations, centre_px: tuple[float, float], side_m: float
) -> Float[np.ndarray, "n 8"]:
    """How each observation's corners (x0, y0, x1, ...) move with its frame's angle, px / rad."""
    frame, marker = _rows(turntable, observations)
    projection = project_corners(turntable, frame, marker, centre_px, side_m)
    return corner_slopes(turntable, frame, projection, centre_px).angle


def loss(residual: np.ndarray, scale: float) -> float:
    """Sum of the soft L1 loss rho(r^2) = 2 s^2 (sqrt(1 + r^2 / s^2) - 1): r^2 where small, 2 s |r| where large."""
    return 2.0 * scale**2 * float(np.sum(np.sqrt(1.0 + (residual / scale) ** 2) - 1.0))


def whitening(covariance: Float[np.ndarray, "n 8 8"]) -> Float[np.ndarray, "n 8 8"]:
    """Matrices that turn residuals of these covariances into independent ones of unit variance."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)


class Problem:
    """Weighted residuals and normal equations of all observations at once."""

    def __init__(
        self,
        start: Turntable,
        observations: Observations,
        centre_px: tuple[float, float],
        side_m: float,
        weights: Float[np.ndarray, "n 8 8"],
        unknowns: Unknowns,
    ) -> None:
        self.columns = Columns.of(start, unknowns)
        self.frame, self.marker = _rows(start, observations)
        self.observed, self.weights = observations.corners_px, weights
        self.centre_px, self.side_m = centre_px, side_m
        spread = unknowns.motion_spread
        self.motion_scale = None if spread is None else np.array([spread[0]] * 2 + [spread[1]] * 3)

    def residuals(self, turntable: Turntable) -> Float[np.ndarray, "n 8"]:
        """Weighted distances of the projected corners from the observed ones."""
        pixels = project_corners(turntable, self.frame, self.marker, self.centre_px, self.side_m).pixels
        return np.einsum("nij,nj->ni", self.weights, (pixels - self.observed).reshape(-1, 8))

    def motions(self, turntable: Turntable) -> Float[np.ndarray, "f 5"]:
        """The table's tilts and shifts in units of their spread: with the residuals they are made small."""
        if self.motion_scale is None:
            return np.zeros((0, _MOTION))
        tilts = np.zeros((len(turntable.frames), 2)) if turntable.tilts_rad is None else turntable.tilts_rad
        shifts = np.zeros((len(turntable.frames), 3)) if turntable.shifts_m is None else turntable.shifts_m
        return np.concatenate([tilts, shifts], axis=-1) / self.motion_scale

    def rows(self, turntable: Turntable) -> tuple[Int[np.ndarray, "n k"], Float[np.ndarray, "n 8 k"]]:
        """The unknowns that an observation depends on, and the derivatives of its weighted residuals by them."""
        projection = project_corners(turntable, self.frame, self.marker, self.centre_px, self.side_m)
        slopes = corner_slopes(turntable, self.frame, projection, self.centre_px)
        c, n = self.columns, len(self.frame)
        shared = np.broadcast_to(np.concatenate([np.arange(_CAMERA), c.radial]), (n, _CAMERA + len(c.radial)))
        columns = [shared, c.angle[self.frame][:, None], c.marker[self.marker]]
        values = [slopes.camera, slopes.radial[..., : len(c.radial)], slopes.angle[..., None], slopes.marker]
        if self.motion_scale is not None:
            columns.append(c.motion[self.frame])
            values.append(slopes.motion)
        return np.concatenate(columns, axis=1), self.weights @ np.concatenate(values, axis=2)

    def side_slopes(self, turntable: Turntable) -> Float[np.ndarray, "n 8"]:
        """Derivatives of the weighted residuals by the log of the marker's side."""
        projection = project_corners(turntable, self.frame, self.marker, self.centre_px, self.side_m)
        return np.einsum(
            "nij,nj->ni", self.weights, corner_slopes(turntable, self.frame, projection, self.centre_px).size
        )

    def normal_equations(
        self, turntable: Turntable, loss_scale: float
    ) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p"]]:
        """Normal matrix and gradient, each residual weighted by the loss's slope there."""
        # The last column is that of the first frame's angle, which is no unknown.
        normal, gradient = self.assemble(turntable, *self.rows(turntable), self.columns.size + 1, loss_scale)
        return normal[:-1, :-1], gradient[:-1]

    def assemble(
        self,
        turntable: Turntable,
        columns: Int[np.ndarray, "n k"],
        values: Float[np.ndarray, "n 8 k"],
        size: int,
        loss_scale: float,
    ) -> tuple[Float[np.ndarray, "size size"], Float[np.ndarray, "size"]]:
        """Normal matrix and gradient from ``rows``.

        An observation knows some twenty of several hundred unknowns: only their products are made.
        """
        residual = self.residuals(turntable)
        weighted = values / np.sqrt(1.0 + (residual / loss_scale) ** 2)[..., None]
        place = columns[:, :, None] * size + columns[:, None, :]
        products = np.swapaxes(weighted, 1, 2) @ values
        normal = np.bincount(place.ravel(), products.ravel(), size**2).reshape(size, size)
        gradient = np.bincount(columns.ravel(), np.einsum("nik,ni->nk", weighted, residual).ravel(), size)
        if self.motion_scale is not None:
            at = self.columns.motion
            motions = self.motions(turntable)
            weight = 1.0 / np.sqrt(1.0 + (motions / loss_scale) ** 2)
            normal[at, at] += weight / self.motion_scale**2
            gradient[at] += weight * motions / self.motion_scale
        return normal, gradient

    def moved(self, turntable: Turntable, step: Float[np.ndarray, "p"]) -> Turntable:
        """The turntable after a step of the unknowns."""
        c = self.columns
        poses = turntable.marker_poses.copy()
        by_marker = step[c.marker]
        poses[:, :3, :3] = Rotation.from_rotvec(by_marker[:, :3]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += by_marker[:, 3:]
        radial = list(turntable.radial)
        for power, at in enumerate(c.radial):
            radial[power] += float(step[at])
        moved = replace(
            turntable,
            focal_px=turntable.focal_px * float(np.exp(np.clip(step[0], -1.0, 1.0))),
            camera_rotation=Rotation.from_rotvec(step[1:4]).as_matrix() @ turntable.camera_rotation,
            distance_m=turntable.distance_m * float(np.exp(np.clip(step[4], -1.0, 1.0))),
            angles_rad=turntable.angles_rad + np.append(step, 0.0)[c.angle],
            marker_poses=poses,
            radial=(radial[0], radial[1]),
        )
        if self.motion_scale is None:
            return moved
        motions = self.motions(turntable) * self.motion_scale + step[c.motion]
        return replace(moved, tilts_rad=motions[:, :2], shifts_m=motions[:, 2:])

    def cost(self, turntable: Turntable, loss_scale: float) -> float:
        """What the adjustment makes small."""
        return loss(self.residuals(turntable), loss_scale) + loss(self.motions(turntable), loss_scale)


def _rows(turntable, observations):
    return (
        np.searchsorted(turntable.frames, observations.frame),
        np.searchsorted(turntable.markers, observations.marker),
    )


def _levenberg_marquardt(problem, turntable, loss_scale):
    """A few hundred unknowns against thousands of residuals: the normal matrix is small, and its factor cheap."""
    cost, damping = problem.cost(turntable, loss_scale), 1e-3
    for _ in range(_STEPS):
        normal, gradient = problem.normal_equations(turntable, loss_scale)
        scale = np.maximum(np.diag(normal), 1e-12)
        while True:
            try:
                step = -cho_solve(cho_factor(normal + np.diag(damping * scale)), gradient)
            except LinAlgError:
                damping *= 10
                continue
            there = problem.moved(turntable, step)
            lower = problem.cost(there, loss_scale)
            if lower < cost or damping > _LARGEST_DAMPING:
                break
            damping *= 5
        gain = cost - lower
        if not gain > 0:
            break
        turntable, cost, damping = there, lower, max(damping / 10, 1e-12)
        if gain < _SMALLEST_GAIN * cost:
            break
    return turntable
