"""Bundle adjustment over exactly what the machine has: a fixed camera, one axis, an angle a frame, square markers."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.poses.initialise import Observations, Turntable, square_corners

_STEPS = 100
_SMALLEST_GAIN = 1e-9

# Parameters: log focal, camera rotation vector, log distance, then angles (but the first), then 6 a marker.
_CAMERA = 5


def adjust(
    start: Turntable,
    observations: Observations,
    centre_px: tuple[float, float],
    side_m: float,
    weights: Float[np.ndarray, "n 8 8"],
    loss_scale: float,
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
    """
    problem = _Problem(start, observations, centre_px, side_m, weights)
    return problem.unpack(_levenberg_marquardt(problem, problem.pack(start), loss_scale))


def reproject(
    turntable: Turntable, observations: Observations, centre_px: tuple[float, float], side_m: float
) -> Float[np.ndarray, "n 4 2"]:
    """Where the turntable puts the corners of each observation, in pixels."""
    problem = _Problem(turntable, observations, centre_px, side_m, None)
    return problem.project(problem.pack(turntable))[0]


def angle_slopes(
    turntable: Turntable, observations: Observations, centre_px: tuple[float, float], side_m: float
) -> Float[np.ndarray, "n 8"]:
    """How each observation's corners (x0, y0, x1, ...) move with its frame's angle, px / rad."""
    problem = _Problem(turntable, observations, centre_px, side_m, None)
    return problem.slopes(problem.pack(turntable))[1]


def whitening(covariance: Float[np.ndarray, "n 8 8"]) -> Float[np.ndarray, "n 8 8"]:
    """Matrices that turn residuals of these covariances into independent ones of unit variance."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)


class _Problem:
    """Projection and derivatives of all observations at once, with parameters packed in one vector."""

    def __init__(self, start, observations, centre_px, side_m, weights):
        self.frames, self.markers = start.frames, start.markers
        self.f = np.searchsorted(start.frames, observations.frame)
        self.m = np.searchsorted(start.markers, observations.marker)
        self.observed = observations.corners_px
        self.centre = np.asarray(centre_px)
        self.square = square_corners(side_m)
        self.weights = weights

    def pack(self, turntable):
        rotations = Rotation.from_matrix(turntable.marker_poses[:, :3, :3]).as_rotvec()
        markers = np.concatenate([rotations, turntable.marker_poses[:, :3, 3]], -1)
        camera = Rotation.from_matrix(turntable.camera_rotation).as_rotvec()
        return np.concatenate(
            [
                [np.log(turntable.focal_px), *camera, np.log(turntable.distance_m)],
                turntable.angles_rad[1:] - turntable.angles_rad[0],
                markers.ravel(),
            ]
        )

    def unpack(self, x):
        n = len(self.frames) - 1
        markers = x[_CAMERA + n :].reshape(-1, 6)
        poses = np.tile(np.eye(4), (len(markers), 1, 1))
        poses[:, :3, :3] = Rotation.from_rotvec(markers[:, :3]).as_matrix()
        poses[:, :3, 3] = markers[:, 3:]
        return Turntable(
            float(np.exp(x[0])),
            Rotation.from_rotvec(x[1:4]).as_matrix(),
            float(np.exp(x[4])),
            self.frames,
            np.concatenate([[0.0], x[_CAMERA : _CAMERA + n]]),
            self.markers,
            poses,
        )

    def project(self, x):
        t = self.unpack(x)
        on_object = np.einsum("mij,kj->mki", t.marker_poses[:, :3, :3], self.square)
        points = (on_object + t.marker_poses[:, None, :3, 3])[self.m]
        turn = Rotation.from_rotvec(np.outer(t.angles_rad, [0.0, 0.0, 1.0])).as_matrix()[self.f]
        in_room = np.einsum("nij,nkj->nki", turn, points)
        in_camera = (in_room - [t.distance_m, 0.0, 0.0]) @ t.camera_rotation.T
        pixels = t.focal_px * in_camera[..., :2] / in_camera[..., 2:] + self.centre
        return pixels, (t, on_object[self.m], turn, in_room, in_camera)

    def residuals(self, x):
        residual = (self.project(x)[0] - self.observed).reshape(-1, 8)
        return np.einsum("nij,nj->ni", self.weights, residual).ravel()

    def slopes(self, x):
        """Derivatives of the corners (n, 8, ...) by the camera (5), the frame's angle, and the marker's pose (6)."""
        pixels, (t, on_object, turn, in_room, in_camera) = self.project(x)
        z = in_camera[..., 2]
        by_point = np.zeros((*z.shape, 2, 3))
        by_point[..., 0, 0] = by_point[..., 1, 1] = t.focal_px / z
        by_point[..., :2, 2] = -t.focal_px * in_camera[..., :2] / z[..., None] ** 2
        to_camera = t.camera_rotation
        camera = np.concatenate(
            [
                (pixels - self.centre)[..., None],
                by_point @ -_cross_matrix(in_camera) @ _left_jacobian(x[None, 1:4])[0],
                (by_point @ (-to_camera[:, 0] * t.distance_m))[..., None],
            ],
            -1,
        )
        sideways = np.stack([-in_room[..., 1], in_room[..., 0], np.zeros_like(z)], -1)
        angle = np.einsum("nkij,nkj->nki", by_point, sideways @ to_camera.T)
        to_pixels = by_point @ (to_camera @ turn)[:, None]
        turns = _left_jacobian(x[_CAMERA + len(self.frames) - 1 :].reshape(-1, 6)[:, :3])[self.m]
        marker = np.concatenate([to_pixels @ -_cross_matrix(on_object) @ turns[:, None], to_pixels], -1)
        n = len(z)
        return camera.reshape(n, 8, _CAMERA), angle.reshape(n, 8), marker.reshape(n, 8, 6)

    def jacobian(self, x):
        camera, angle, marker = self.slopes(x)
        n, frames = len(camera), len(self.frames)
        # The first angle is no parameter: its column is made and left out.
        full = np.zeros((n, 8, _CAMERA + frames + 6 * len(self.markers)))
        row = np.arange(n)
        full[:, :, :_CAMERA] = self.weights @ camera
        full[row, :, _CAMERA + self.f] = (self.weights @ angle[..., None])[..., 0]
        columns = _CAMERA + frames + 6 * self.m[:, None] + np.arange(6)
        full[row[:, None], :, columns] = np.swapaxes(self.weights @ marker, 1, 2)
        return np.delete(full.reshape(n * 8, -1), _CAMERA, axis=1)


def _cross_matrix(v):
    """Matrices [v]x with [v]x w = v x w."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 2, 1], matrix[..., 0, 2], matrix[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return matrix - np.swapaxes(matrix, -1, -2)


def _left_jacobian(rotvec):
    """d(exp(w) s) = -[exp(w) s]x J(w) dw: the left Jacobian of SO(3)."""
    angle = np.linalg.norm(rotvec, axis=-1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    cross = _cross_matrix(rotvec)
    return np.eye(3) + a * cross + b * (cross @ cross)


def _levenberg_marquardt(problem, x, loss_scale):
    """Minimise sum(rho(r^2)), rho(z) = 2 s^2 (sqrt(1 + z / s^2) - 1), by reweighted normal equations.

    A few hundred unknowns against thousands of residuals: the normal matrix is small, and its Cholesky factor far
    cheaper than the singular values of the Jacobian that ``scipy.optimize.least_squares`` takes.
    """

    def cost_of(residual):
        return 2 * loss_scale**2 * float(np.sum(np.sqrt(1 + (residual / loss_scale) ** 2) - 1))

    residual = problem.residuals(x)
    cost, damping = cost_of(residual), 1e-3
    for _ in range(_STEPS):
        weight = 1.0 / np.sqrt(1 + (residual / loss_scale) ** 2)
        jacobian = problem.jacobian(x)
        weighted = jacobian * weight[:, None]
        normal, gradient = weighted.T @ jacobian, weighted.T @ residual
        scale = np.maximum(np.diag(normal), 1e-12)
        while True:
            try:
                step = -cho_solve(cho_factor(normal + np.diag(damping * scale)), gradient)
            except LinAlgError:
                damping *= 10
                continue
            there = problem.residuals(x + step)
            lower = cost_of(there)
            if lower < cost or damping > 1e8:
                break
            damping *= 5
        gain = cost - lower
        if not gain > 0:
            break
        x, residual, cost, damping = x + step, there, lower, max(damping / 10, 1e-12)
        if gain < _SMALLEST_GAIN * cost:
            break
    return x
