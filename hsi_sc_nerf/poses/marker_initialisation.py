"""Initialisation of camera, axis, angles and marker layout, from each marker's pose in each frame.

Centres of markers move on circles about one axis. A wrong focal length stretches these circles along the viewing
direction; the right one leaves them round. The two-fold ambiguity of a small square's pose hardly moves its centre.
The layout resolves it: one pose on the object must fit all frames.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Int
from scipy.optimize import minimize_scalar
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.poses.bundle_adjustment import Problem
from hsi_sc_nerf.poses.residuals import MarkerResiduals
from hsi_sc_nerf.poses.turntable import MarkerObservations, Turntable, rotations_about_z, square_corners

# Fields of view over the width that are tried: from a tele lens to a very wide one.
_FOV_RANGE_DEG = (5.0, 90.0)
_FOV_STEPS = 16
_HORIZONTAL_COSINE = 0.95


def initialise(
    observations: MarkerObservations, centre_px: tuple[float, float], width_px: int, side_m: float
) -> Turntable:
    """Initial turntable from linked observations (``linked_rows``) of markers that each are in two or more frames.

    It is adjusted without weights, so that a wrong covariance can do no harm.

    Raises:
        InputError: the corners are not those of markers before a camera.
    """
    fields = np.geomspace(*_FOV_RANGE_DEG, _FOV_STEPS)
    focals = width_px / 2 / np.tan(np.deg2rad(fields) / 2)
    errors = [_Circles(observations, f, centre_px, side_m).error_px for f in focals]
    best = int(np.argmin(errors))
    finer = minimize_scalar(
        lambda log_focal: _Circles(observations, np.exp(log_focal), centre_px, side_m).error_px,
        bounds=np.log([focals[min(best + 1, _FOV_STEPS - 1)], focals[max(best - 1, 0)]]),
        method="bounded",
        options={"xatol": 1e-3},
    )
    start = _Circles(observations, float(np.exp(finer.x)), centre_px, side_m).turntable()
    unweighted = np.tile(np.eye(8), (len(observations), 1, 1))
    return Problem(MarkerResiduals(start, observations, 1.0, unweighted)).minimise(start)


class _Circles:
    """The circles that the markers' centres describe, for one focal length."""

    def __init__(
        self, observations: MarkerObservations, focal_px: float, centre_px: tuple[float, float], side_m: float
    ):
        self.frames, self.f = np.unique(observations.frame, return_inverse=True)
        self.markers, self.m = np.unique(observations.marker, return_inverse=True)
        self.focal_px, self.centre_px, self.side_m = focal_px, centre_px, side_m
        self.corners_px = observations.corners_px - centre_px
        self.square = square_corners(side_m)
        self.rotations, self.centres = _marker_poses(observations.corners_px, focal_px, centre_px, side_m)
        self._fit()
        ratio = focal_px * side_m / self.centres[:, 2]
        scale = np.log(self.predicted[:, 2] / self.centres[:, 2]) * ratio
        depth = np.maximum(self.predicted[:, 2], 1e-6)
        shift = focal_px * (self.predicted[:, :2] / depth[:, None] - self.centres[:, :2] / self.centres[:, 2:])
        self.error_px = float(np.sqrt(np.mean(np.minimum((shift**2).sum(-1) + scale**2, 100.0))))

    def _fit(self):
        counts = np.bincount(self.m)
        means = np.stack([np.bincount(self.m, self.centres[:, k]) / counts for k in range(3)], -1)
        axis = np.linalg.svd(self.centres - means[self.m], full_matrices=False)[2][2]
        # The camera looks down on the turntable: it is above the markers along the axis.
        axis = axis * -np.sign(axis @ means.mean(0))
        x = np.cross(axis, [0.0, 0.0, 1.0])
        x = x / np.linalg.norm(x)
        self.basis = np.stack([x, np.cross(axis, x), axis])
        points = self.centres @ self.basis.T
        # |p|^2 = 2 c.p + (r_m^2 - |c|^2): one centre c for all, one radius a marker.
        design = np.zeros((len(points), 2 + len(self.markers)))
        design[:, :2] = 2 * points[:, :2]
        design[np.arange(len(points)), 2 + self.m] = 1.0
        solution = np.linalg.lstsq(design, (points[:, :2] ** 2).sum(-1), rcond=None)[0]
        self.on_axis = solution[:2]
        radius = np.sqrt(np.maximum(solution[2:] + self.on_axis @ self.on_axis, 1e-12))
        turn = np.exp(1j * np.arctan2(*(points[:, :2] - self.on_axis).T[::-1]))
        of_frame, of_marker = _angles(self.f, self.m, turn)
        self.angles = np.angle(of_frame)
        around = radius[self.m] * of_frame[self.f] * of_marker[self.m]
        height = np.bincount(self.m, points[:, 2]) / counts
        ideal = np.stack([around.real + self.on_axis[0], around.imag + self.on_axis[1], height[self.m]], -1)
        self.predicted = ideal @ self.basis

    def turntable(self) -> Turntable:
        """The circles as a turntable."""
        foot = self.basis[:2].T @ self.on_axis
        distance = np.linalg.norm(foot)
        z = self.basis[2]
        x = -foot / distance
        camera_rotation = np.stack([x, np.cross(z, x), z], -1)
        camera = np.array([distance, 0.0, 0.0])
        angles = self.angles - self.angles[0]
        turn = rotations_about_z(angles)[self.f]
        in_room = self.centres @ camera_rotation + camera
        centres = np.einsum("nji,nj->ni", turn, in_room)
        rotations = np.einsum("nji,kj,nckl->ncil", turn, camera_rotation, self.rotations)
        poses = np.tile(np.eye(4), (len(self.markers), 1, 1))
        for k in range(len(self.markers)):
            rows = self.m == k
            poses[k, :3, 3] = np.median(centres[rows], axis=0)
            candidates = rotations[rows].reshape(-1, 3, 3)
            points = np.einsum("cij,kj->cki", candidates, self.square) + poses[k, :3, 3]
            in_camera = (np.einsum("nij,ckj->cnki", turn[rows], points) - camera) @ camera_rotation.T
            error = self.focal_px * in_camera[..., :2] / in_camera[..., 2:] - self.corners_px[rows]
            # Each frame gives two candidates; the one that fits all frames best is taken.
            size = np.linalg.norm(error, axis=-1).mean(-1)
            poses[k, :3, :3] = candidates[np.argmin(np.median(size, axis=-1))]
        start = Turntable(
            focal_px=self.focal_px,
            centre_px=self.centre_px,
            camera_rotation=camera_rotation,
            distance=float(distance),
            frames=self.frames,
            angles_rad=angles,
            side=self.side_m,
            markers=self.markers,
            marker_poses=poses,
        )
        up = poses[:, 2, 2]
        flat = np.abs(up) > _HORIZONTAL_COSINE
        return start.turned_over() if flat.any() and up[flat].sum() < 0 else start


def linked_rows(frame: Int[np.ndarray, "n"], marker: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Mask of the rows in the largest set of frames that are linked by markers seen in two or more of them."""
    frames, f = np.unique(frame, return_inverse=True)
    markers, m = np.unique(marker, return_inverse=True)
    size = len(frames) + len(markers)
    links = coo_array((np.ones(len(f)), (f, m + len(frames))), shape=(size, size))
    _, label = connected_components(links, directed=False)
    counts = np.bincount(label[: len(frames)])
    return label[f] == np.argmax(counts)


def _marker_poses(corners_px, focal_px, centre_px, side_m):
    """Both poses of each square: rotations (n, 2, 3, 3) and the better one's centre (n, 3), OpenCV camera axes."""
    k = np.array([[focal_px, 0, centre_px[0]], [0, focal_px, centre_px[1]], [0, 0, 1.0]])
    square = square_corners(side_m)
    rotations, centres = [], []
    for corners in corners_px:
        _, turns, shifts, _ = cv2.solvePnPGeneric(square, corners, k, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
        if not (np.isfinite(turns).all() and np.isfinite(shifts).all()):
            # IPPE divides by zero for a square seen exactly from the front.
            _, turns, shifts, _ = cv2.solvePnPGeneric(square, corners, k, None, flags=cv2.SOLVEPNP_ITERATIVE)
        rotations.append(Rotation.from_rotvec(np.array([turns[0].ravel(), turns[-1].ravel()])).as_matrix())
        centres.append(shifts[0].ravel())
    return np.array(rotations), np.array(centres)


def _angles(f, m, turn):
    """Unit complex numbers a_f, b_m with a_f b_m close to ``turn``: along the links first, then averaged."""
    of_frame = np.zeros(f.max() + 1, complex)
    of_marker = np.zeros(m.max() + 1, complex)
    of_frame[np.bincount(f).argmax()] = 1.0
    for _ in range(2 * (len(of_frame) + len(of_marker))):
        known = of_frame[f] != 0
        of_marker = _mean_direction(m[known], turn[known] * of_frame[f[known]].conj(), len(of_marker))
        known = of_marker[m] != 0
        before = of_frame
        of_frame = _mean_direction(f[known], turn[known] * of_marker[m[known]].conj(), len(of_frame))
        if before.all() and np.abs(of_frame - before).max() < 1e-6:
            break
    return of_frame, of_marker


def _mean_direction(index, numbers, size):
    total = np.bincount(index, numbers.real, size) + 1j * np.bincount(index, numbers.imag, size)
    length = np.abs(total)
    return np.where(length > 1e-12, total / np.maximum(length, 1e-12), 0.0)
