"""Bundle adjustment of points on the object over exactly what the machine has: camera, one axis, an angle a frame.

The unit of length is the distance between camera and axis: features alone do not tell a scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.tracks import TrackedTurntable, Tracks, project, reproject

FEWEST_FRAMES = 3
_STEPS = 60
_SMALLEST_GAIN = 1e-6
_LARGEST_DAMPING = 1e8
_OUTLIER_ROUNDS = 4
# Far from the solution a small loss scale holds on to what fits by chance.
_FIRST_LOSS_PX = 1.0
# The median length of a two-dimensional normal residual, in standard deviations of one coordinate.
_RAYLEIGH_MEDIAN = 1.1774


@dataclass(frozen=True)
class TrackAdjustConfig:
    """What the adjustment may change, and what it takes for an outlier."""

    free_angles: bool = True
    """Find the frames' angles; otherwise they stay as given, and the camera alone is found."""
    free_focal: bool = True
    """Find the focal length; otherwise it stays as given (a calibrated camera)."""
    free_principal_point: bool = False
    """Find the principal point too. One axis hardly tells it from the camera's direction: only for many points."""
    radial_terms: int = 0
    """How many coefficients of radial lens distortion are found: 0, 1 (k1) or 2 (k1, k2). An object in the middle of
    the image hardly tells them from the focal length: only for points that reach the image's borders."""
    loss_px: float = 0.1
    """Residuals well above this count by their size, not its square (soft L1), pixels. Small, for what is no point of
    the object, such as an outline or the shadow side of a bump, creeps over it and does so by little."""
    outlier_sigmas: float = 4.0
    """Observations beyond this many standard deviations are thrown out; these are measured on the residuals."""
    least_outlier_px: float = 0.3
    """What is nearer than this is no outlier, pixels."""
    fewest_views: int = 3
    """A point that is seen in fewer frames is left out."""
    fewest_points: int = 8
    """A frame that shows fewer points is left out."""


@dataclass(frozen=True)
class AdjustedTracks:
    """The adjusted machine, and how well it explains the tracks.

    ``outliers`` are rows of the given tracks that were thrown out: they do not fit, or too little is left of their
    point or frame. ``residual_px`` belongs to ``tracks``, the rest.
    """

    turntable: TrackedTurntable
    tracks: Tracks
    outliers: Bool[np.ndarray, "n"]
    residual_px: Float[np.ndarray, "m 2"]
    focal_sigma: float | None
    """Standard deviation of the focal length, as a share of it, from the residuals; None where it was given."""

    @property
    def overall_error_px(self) -> float:
        """Root mean square of the reprojection error."""
        return float(np.sqrt((self.residual_px**2).sum(-1).mean()))

    def frame_errors_px(self) -> Float[np.ndarray, "f"]:
        """Root mean square of the reprojection error in each of the turntable's frames."""
        row = np.searchsorted(self.turntable.frames, self.tracks.frame)
        squared = (self.residual_px**2).sum(-1)
        return np.sqrt(np.bincount(row, squared) / np.bincount(row))


def adjust_tracks(start: TrackedTurntable, tracks: Tracks, config: TrackAdjustConfig | None = None) -> AdjustedTracks:
    """Least squares of reprojection errors with a soft L1 loss; what does not fit is thrown out, and adjusted again.

    Args:
        start: where to start. Tracks of frames or points that it lacks count as outliers.
        tracks: points seen in frames.
        config: what is free and what is an outlier.

    Raises:
        InputError: what fits is too little to fix an axis.
    """
    config = config or TrackAdjustConfig()
    good = _enough(tracks, np.isin(tracks.frame, start.frames) & np.isin(tracks.point, start.points), config)
    kept = tracks.select(good)
    turntable, _ = _adjust(start.restricted(kept), kept, replace(config, loss_px=max(config.loss_px, _FIRST_LOSS_PX)))
    for _ in range(_OUTLIER_ROUNDS):
        kept = tracks.select(good)
        turntable, _ = _adjust(turntable.restricted(kept), kept, config)
        residual = reproject(turntable, kept) - kept.pixels
        size = np.linalg.norm(residual, axis=-1)
        far = size > max(config.outlier_sigmas * float(np.median(size)) / _RAYLEIGH_MEDIAN, config.least_outlier_px)
        if not far.any():
            break
        fits = good.copy()
        fits[np.flatnonzero(good)[far]] = False
        good = _enough(tracks, fits, config)
    kept = tracks.select(good)
    turntable, sigma = _adjust(turntable.restricted(kept), kept, config)
    return AdjustedTracks(turntable, kept, ~good, reproject(turntable, kept) - kept.pixels, sigma)


def split_half_error_deg(found: AdjustedTracks, config: TrackAdjustConfig | None = None) -> float | None:
    """How far the poses can be trusted: half the largest rotation between those from two halves of the points.

    Least squares takes residuals for chance; what creeps over a bumpy or shiny object errs in company, and the halves
    show it. None where half of the points cannot fix the machine.
    """
    halves = []
    for half in (0, 1):
        try:
            tracks = found.tracks.select(found.tracks.point % 2 == half)
            halves.append(adjust_tracks(found.turntable, tracks, config).turntable)
        except InputError:
            return None
    both = np.intersect1d(halves[0].frames, halves[1].frames)
    one, other = (h.camera_to_world()[np.isin(h.frames, both), :3, :3] for h in halves)
    return float(np.rad2deg(Rotation.from_matrix(one @ np.swapaxes(other, 1, 2)).magnitude().max()) / 2.0)


def _enough(tracks, good, config):
    """Of the good rows those of points in enough frames and of frames with enough points."""
    good = good.copy()
    while True:
        views = np.bincount(tracks.point[good], minlength=tracks.point.max(initial=0) + 1)
        good &= views[tracks.point] >= config.fewest_views
        seen = np.bincount(tracks.frame[good], minlength=tracks.frame.max(initial=0) + 1)
        enough = good & (seen[tracks.frame] >= config.fewest_points)
        if (enough == good).all():
            break
        good = enough
    if len(np.unique(tracks.frame[good])) < FEWEST_FRAMES:
        raise InputError(
            "too few points of the object are seen in enough frames to fix the turntable's axis; take smaller steps, "
            "give the object more texture, or take markers"
        )
    return good


def _slopes(turntable, frame, point, config):
    """Derivatives of the pixels by the shared numbers (n, 2, s), the frame's angle (n, 2), the point (n, 2, 3)."""
    pixels, in_room, in_camera, flat, turn = project(turntable, frame, point)
    k1, k2 = turntable.radial
    squared = (flat**2).sum(-1)[:, None, None]
    by_flat = turntable.focal_px * (
        (1.0 + squared * (k1 + k2 * squared)) * np.eye(2)
        + (2.0 * k1 + 4.0 * k2 * squared) * flat[:, :, None] * flat[:, None, :]
    )
    depth = in_camera[:, 2, None, None]
    by_point = by_flat @ np.concatenate([np.tile(np.eye(2), (len(flat), 1, 1)), -flat[:, :, None]], axis=-1) / depth
    shared = [np.cross(in_camera[:, None, :], by_point)]  # by a small turn w of the camera: w x point
    if config.free_focal:
        shared.append((pixels - turntable.centre_px)[:, :, None])
    for power in range(1, 1 + config.radial_terms):
        shared.append(turntable.focal_px * flat[:, :, None] * squared**power)
    if config.free_principal_point:
        shared.append(np.tile(np.eye(2), (len(flat), 1, 1)))
    sideways = np.stack([-in_room[:, 1], in_room[:, 0], np.zeros(len(flat))], axis=-1)
    by_angle = np.einsum("nij,nj->ni", by_point, sideways @ turntable.camera_rotation.T)
    return np.concatenate(shared, axis=-1), by_angle, by_point @ turntable.camera_rotation @ turn


def _moved(turntable, step, places_step, config):
    """The turntable after a step of the unknowns, in the order of ``_slopes``."""
    rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ turntable.camera_rotation
    focal, radial, centre, at = turntable.focal_px, list(turntable.radial), turntable.centre_px, 3
    if config.free_focal:
        focal, at = focal * float(np.exp(np.clip(step[at], -1.0, 1.0))), at + 1
    for power in range(config.radial_terms):
        radial[power] += float(step[at])
        at += 1
    if config.free_principal_point:
        centre, at = (centre[0] + float(step[at]), centre[1] + float(step[at + 1])), at + 2
    angles = turntable.angles_rad
    if config.free_angles:
        angles = angles + np.concatenate([[0.0], step[at:]])
    return replace(
        turntable,
        focal_px=focal,
        radial=(radial[0], radial[1]),
        centre_px=centre,
        camera_rotation=rotation,
        angles_rad=angles,
        places=turntable.places + places_step,
    )


def _adjust(turntable, tracks, config):
    """Levenberg-Marquardt with the points eliminated (Schur complement): about 70 unknowns are left to solve for.

    B. Triggs et al., "Bundle adjustment - a modern synthesis" (2000), sections 4.3 and 6.1. The loss is
    rho(r^2) = 2 s^2 (sqrt(1 + r^2 / s^2) - 1) of each residual's length r, by reweighting.
    """
    frame, point = turntable.rows(tracks)
    scale2 = config.loss_px**2

    def measure(machine):
        pixels, _, in_camera, _, _ = project(machine, frame, point)
        if (in_camera[:, 2] <= 1e-3).any() or not np.isfinite(pixels).all():
            return np.inf, pixels
        residual = pixels - tracks.pixels
        return 2.0 * scale2 * float((np.sqrt(1.0 + (residual**2).sum(-1) / scale2) - 1.0).sum()), residual

    cost, residual = measure(turntable)
    if not np.isfinite(cost):
        raise InputError("the points of the object do not lie before the camera; the poses to start from are wrong")
    damping, reduced, weight = 1e-4, None, None
    for _ in range(_STEPS):
        weight = 1.0 / np.sqrt(1.0 + (residual**2).sum(-1) / scale2)
        system = _normal_equations(turntable, frame, point, residual, np.sqrt(weight), config)
        while damping < _LARGEST_DAMPING:
            step, places_step, reduced = _solve(system, damping)
            candidate = None if step is None else _moved(turntable, step, places_step, config)
            lower, there = (np.inf, None) if candidate is None else measure(candidate)
            if lower < cost:
                break
            damping *= 8.0
        else:
            break
        gain, turntable, cost, residual, damping = cost - lower, candidate, lower, there, max(damping / 8.0, 1e-10)
        if gain < _SMALLEST_GAIN * cost:
            break
    return turntable, _focal_sigma(reduced, residual, weight, config)


def _normal_equations(turntable, frame, point, residual, root_weight, config):
    """Normal matrix and gradient of the machine, blocks of the points, how both couple, and the points' gradient.

    A row knows the shared numbers, its own frame's angle and its own point: nothing else is multiplied.
    """
    shared, by_angle, by_point = _slopes(turntable, frame, point, config)
    shared, by_point = shared * root_weight[:, None, None], by_point * root_weight[:, None, None]
    by_angle, residual = by_angle * root_weight[:, None], residual * root_weight[:, None]
    s, points = shared.shape[2], len(turntable.points)
    transposed = np.swapaxes(by_point, 1, 2)
    blocks = _summed(transposed @ by_point, point, points)
    point_gradient = _summed((transposed @ residual[:, :, None])[..., 0], point, points)
    own = _summed(transposed @ shared, point, points)
    flat = shared.reshape(-1, s)
    if not config.free_angles:
        return flat.T @ flat, flat.T @ residual.ravel(), blocks, own, point_gradient
    frames = len(turntable.frames)
    normal = np.zeros((s + frames, s + frames))
    normal[:s, :s] = flat.T @ flat
    normal[s:, :s] = _summed((by_angle[:, None] @ shared)[:, 0], frame, frames)
    normal[:s, s:] = normal[s:, :s].T
    normal[np.arange(s, s + frames), np.arange(s, s + frames)] = _summed((by_angle**2).sum(-1), frame, frames)
    gradient = np.concatenate([flat.T @ residual.ravel(), _summed((by_angle * residual).sum(-1), frame, frames)])
    by_pair = _summed((transposed @ by_angle[:, :, None])[..., 0], point * frames + frame, points * frames)
    coupling = np.concatenate([own, np.swapaxes(by_pair.reshape(points, frames, 3), 1, 2)], axis=2)
    # The first frame's angle is no unknown.
    rest = np.delete(np.arange(s + frames), s)
    return normal[np.ix_(rest, rest)], gradient[rest], blocks, coupling[:, :, rest], point_gradient


def _summed(values, index, size):
    """Sums of the values (n, ...) of equal index."""
    columns = values.reshape(len(values), -1).T
    return np.stack([np.bincount(index, c, size) for c in columns], axis=-1).reshape(size, *values.shape[1:])


def _solve(system, damping):
    """The damped step of the machine's numbers and of the points, and the reduced normal matrix; None if singular."""
    normal, gradient, blocks, coupling, point_gradient = system
    diagonal = np.einsum("pii->pi", blocks)
    damped = blocks + (damping * diagonal + 1e-12 * (1.0 + diagonal.max()))[:, :, None] * np.eye(3)
    inverse = np.linalg.inv(damped)
    through = inverse @ coupling
    size = coupling.shape[2]
    reduced = normal - coupling.reshape(-1, size).T @ through.reshape(-1, size)
    right = gradient - through.reshape(-1, size).T @ point_gradient.ravel()
    try:
        step = -cho_solve(cho_factor(reduced + damping * np.diag(np.diag(normal))), right)
    except (LinAlgError, ValueError):
        return None, None, None
    places_step = -np.einsum("pij,pj->pi", inverse, point_gradient) - through @ step
    return step, places_step, reduced


def _focal_sigma(reduced, residual, weight, config):
    if reduced is None or not config.free_focal:
        return None
    variance = float((weight * (residual**2).sum(-1)).sum()) / max(residual.size - len(reduced), 1)
    try:
        return float(np.sqrt(variance * cho_solve(cho_factor(reduced), np.eye(len(reduced))[3])[3]))
    except LinAlgError:
        return None
