"""Bundle adjustment of a turntable and points of the object, with rejection of outliers, and frames found later.

Features alone give no scale: the unit of length is the distance between camera and axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL, closest_point_to_rays, unit_vectors
from hsi_sc_nerf.poses.bundle_adjustment import Adjusted, FreeParameters, Problem
from hsi_sc_nerf.poses.model_selection import LOSS_SIGMAS
from hsi_sc_nerf.poses.posed_session import with_hidden_errors
from hsi_sc_nerf.poses.residuals import MarkerResiduals, PointResiduals, loop_closure_deg
from hsi_sc_nerf.poses.turntable import FEWEST_FRAMES, MarkerObservations, Tracks, Turntable, project
from hsi_sc_nerf.poses.turntable_from_poses import reversed_in_depth

# Residuals well above this count by their length, not its square, pixels. Small, because features that are no point
# of the object, such as an outline or the shadow side of a bump, creep over it slowly.
_LOSS_PX = 0.1
# Far from the solution, a small loss scale would keep what fits by chance.
_FIRST_LOSS_PX = 1.0
_SMALLEST_GAIN = 1e-6
# Outliers are farther than this many standard deviations, measured on the residuals, and than this, pixels.
_OUTLIER_SIGMAS = 4.0
_LEAST_OUTLIER_PX = 0.3
_OUTLIER_ROUNDS = 4
# Of a turntable and its reversal in depth, one is wrong if it fits worse by this factor before outliers are rejected.
_CLEARLY_WORSE = 2.0
# The median length of a two-dimensional normal residual, in standard deviations of one coordinate.
_RAYLEIGH_MEDIAN = 1.1774
_LEAST_MARKER_OUTLIER_PX = 0.5
# Together with markers, features are weighted as if their residuals were larger by this factor, because displacements
# that vary smoothly over the image do not average out.
_BESIDE_MARKERS = 10.0
_LEAST_SIGMA_PX = 0.03
# A marker whose rays are nearly parallel is not placed.
_LEAST_EIGENVALUE = 1e-3
# Each is about ten times as exact as the one before, for a distortion that moves the image's edge by 5 %.
_ROUNDS_OF_DISTORTION = 10
# Points seen in fewer frames, and frames that show fewer points, are left out.
_FEWEST_VIEWS = 3
_FEWEST_POINTS = 8
# The search for a lost frame's angle: its step; a point supports an angle if it is seen this near to its projection;
# and the fraction of points that must support it.
_SEARCH_STEP_DEG = 1.0
_NEAR_PX = 2.0
_NEAR_FRACTION = 0.5


@dataclass(frozen=True)
class AdjustedTracks:
    """The adjusted turntable, and how well it explains the tracks."""

    turntable: Turntable
    tracks: Tracks
    """The rows that were used."""
    outliers: Bool[np.ndarray, "n"]
    """Rows of the given tracks that were rejected: they do not fit, or too little is left of their point or frame."""

    @property
    def misfit_px(self) -> float:
        """Mean distance of the given rows from their projections; at most 1 px each, as which outliers count."""
        distances = self.turntable.errors_px(self.tracks)
        return float((np.minimum(distances, 1.0).sum() + self.outliers.sum()) / len(self.outliers))

    def loop_closure_deg(self) -> float | None:
        """What is left of a full turn after adding up the steps between neighbouring frames."""
        return loop_closure_deg(PointResiduals(self.turntable, self.tracks, _LOSS_PX), self.turntable)


def adjust_tracks(start: Turntable, tracks: Tracks, *, free_angles: bool = True) -> AdjustedTracks:
    """Adjust camera, angles and points to the tracks, reject outliers, and adjust again.

    Args:
        start: where to start. Tracks of frames or points that it lacks count as outliers.

    Raises:
        InputError: too few tracks fit to determine an axis.
    """
    return _refined(_roughly_adjusted(start, tracks, free_angles), tracks, free_angles)


def adjust_either_depth(start: Turntable, tracks: Tracks) -> AdjustedTracks:
    """``adjust_tracks`` from a start and from its reversal in depth: the one that fits the tracks better.

    Raises:
        InputError: too few tracks fit either.
    """
    rough: list[AdjustedTracks] = []
    found: list[AdjustedTracks] = []
    refused = None
    for turned in (start, reversed_in_depth(start)):
        try:
            rough.append(_roughly_adjusted(turned, tracks))
        except InputError as error:
            refused = refused or error
    best_px = min((candidate.misfit_px for candidate in rough), default=0.0)
    for candidate in rough:
        try:
            if candidate.misfit_px < _CLEARLY_WORSE * best_px:
                found.append(_refined(candidate, tracks))
        except InputError as error:
            refused = refused or error
    if refused is not None and not found:
        raise refused
    return min(found, key=lambda adjusted: adjusted.misfit_px)


def _roughly_adjusted(start: Turntable, tracks: Tracks, free_angles: bool = True) -> AdjustedTracks:
    good = _enough(tracks, start.knows(tracks))
    kept = tracks.select(good)
    return AdjustedTracks(_adjusted(start, kept, _FIRST_LOSS_PX, free_angles), kept, ~good)


def _refined(rough: AdjustedTracks, tracks: Tracks, free_angles: bool = True) -> AdjustedTracks:
    turntable, good = rough.turntable, ~rough.outliers
    for last in [False] * _OUTLIER_ROUNDS + [True]:
        kept = tracks.select(good)
        turntable = _adjusted(turntable, kept, _LOSS_PX, free_angles)
        size_px = turntable.errors_px(kept)
        outlier = size_px > max(_OUTLIER_SIGMAS * float(np.median(size_px)) / _RAYLEIGH_MEDIAN, _LEAST_OUTLIER_PX)
        if last or not outlier.any():
            break
        fits = good.copy()
        fits[np.flatnonzero(good)[outlier]] = False
        good = _enough(tracks, fits)
    return AdjustedTracks(turntable, kept, ~good)


def _adjusted(turntable: Turntable, kept: Tracks, loss_px: float, free_angles: bool) -> Turntable:
    turntable = turntable.restricted(kept)
    free = FreeParameters(distance=False, angles=free_angles)
    return Problem(PointResiduals(turntable, kept, loss_px), free=free).minimise(turntable, _SMALLEST_GAIN)


def adjust_together(
    found: AdjustedTracks, markers: MarkerObservations | None, free: FreeParameters
) -> tuple[Adjusted, MarkerObservations | None]:
    """Adjust tracks, the visible markers, and prior knowledge together, with a realistic covariance.

    Args:
        found: the turntable adjusted to the tracks alone.
        markers: seen in its frames; their side is in any unit.
        free: whether angles are adjusted, and prior knowledge.

    Returns:
        The turntable, with markers if they determine their poses; and the markers that it was adjusted to.
    """
    start = found.turntable
    sigma_px = max(float(np.median(start.errors_px(found.tracks))) / _RAYLEIGH_MEDIAN, _LEAST_SIGMA_PX)
    if markers is not None:
        start = with_markers(start, markers)
        markers = markers.select(start.knows(markers))
    alone = markers is None or not len(markers)
    sigma_px *= 1.0 if alone else _BESIDE_MARKERS
    points = partial(PointResiduals, tracks=found.tracks, loss_scale=_LOSS_PX / sigma_px, sigma_px=sigma_px)
    if markers is None or alone:
        problem = Problem(points(start), free=replace(free, distance=False))
        return with_hidden_errors(Adjusted(problem.minimise(start, _SMALLEST_GAIN), problem)), None
    for last in (False, True):
        problem = Problem(points(start), MarkerResiduals(start, markers, LOSS_SIGMAS), free=free)
        start = problem.minimise(start, _SMALLEST_GAIN)
        error_px = np.linalg.norm(start.reproject(markers) - markers.corners_px, axis=-1).max(axis=1)
        fits = error_px < max(_LEAST_MARKER_OUTLIER_PX, _OUTLIER_SIGMAS * float(np.median(error_px)))
        if last or fits.all():
            break
        markers = markers.select(fits)
        start = start.restricted(found.tracks, markers)
    return with_hidden_errors(Adjusted(start, problem)), markers


def with_lost_frames(turntable: Turntable, tracks: Tracks) -> Turntable:
    """Add the frames that structure from motion lost or got wrong, at the angle that suits their points.

    All angles are tried, for a turntable may have stopped or jumped; a frame on whose points no angle agrees stays
    lost. ``adjust_tracks`` refines the angles.
    """
    known = np.isin(tracks.point, turntable.points)
    frames, angles = turntable.frames, turntable.angles_rad
    for frame in np.setdiff1d(tracks.frame[known], turntable.frames):
        angle = _search_angle(turntable, tracks.select(known & (tracks.frame == frame)))
        if angle is not None:
            at = int(np.searchsorted(frames, frame))
            frames, angles = np.insert(frames, at, frame), np.insert(angles, at, angle)
    return replace(turntable, frames=frames, angles_rad=angles[0] + np.unwrap(angles - angles[0]))


def with_markers(turntable: Turntable, seen: MarkerObservations) -> Turntable:
    """The turntable with the markers that its rays determine, in its unit of length, all of one side."""
    seen = seen.select(np.isin(seen.frame, turntable.frames))
    markers, marker, views = np.unique(seen.marker, return_inverse=True, return_counts=True)
    poses = turntable.camera_to_world()[np.searchsorted(turntable.frames, seen.frame)] @ OPENCV_TO_OPENGL
    in_camera = np.insert(_without_distortion(turntable, seen.corners_px), 2, 1.0, axis=-1)
    directions = unit_vectors(in_camera) @ np.swapaxes(poses[:, :3, :3], 1, 2)
    corners, eigenvalue = closest_point_to_rays(poses[:, None, :3, 3], directions, 4 * marker[:, None] + np.arange(4))
    placed = eigenvalue.reshape(-1, 4).min(axis=1) > _LEAST_EIGENVALUE * views
    faces = corners.reshape(-1, 4, 3)[placed]
    right, up = faces[:, 1] + faces[:, 2] - faces[:, 0] - faces[:, 3], faces[:, 0] - faces[:, 3]
    normal = np.cross(right, up)
    marker_poses = np.tile(np.eye(4), (len(faces), 1, 1))
    axes = np.stack([right, np.cross(normal, right), normal], axis=-1)
    marker_poses[:, :3, :3] = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    marker_poses[:, :3, 3] = faces.mean(axis=1)
    sides = np.linalg.norm(faces - np.roll(faces, 1, axis=1), axis=-1)
    side = float(np.median(sides)) if len(faces) else 1.0
    return replace(turntable, side=side, markers=markers[placed], marker_poses=marker_poses)


def _without_distortion(turntable: Turntable, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Directions (x, y, 1) that appear at the pixels, by fixed-point iteration."""
    k1, k2 = turntable.radial
    distorted = xy = (pixels - turntable.centre_px) / turntable.focal_px
    for _ in range(_ROUNDS_OF_DISTORTION):
        r2 = (xy**2).sum(axis=-1, keepdims=True)
        xy = distorted / (1.0 + r2 * (k1 + k2 * r2))
    return xy


def _search_angle(turntable: Turntable, seen: Tracks) -> float | None:
    """The angle (rad) at which the points of one frame are nearest to their projections; None without agreement."""
    if len(seen) < _FEWEST_POINTS:
        return None
    points_3d = turntable.points_3d[np.searchsorted(turntable.points, seen.point)]

    def distances_px(angles_rad):
        at_angles = replace(turntable, angles_rad=np.atleast_1d(angles_rad))
        tries = len(at_angles.angles_rad)
        frame = np.repeat(np.arange(tries), len(points_3d))
        pixels = project(at_angles, frame, np.tile(points_3d, (tries, 1))).pixels
        return np.linalg.norm(pixels.reshape(tries, -1, 2) - seen.pixels, axis=-1)

    def cost(angles_rad, largest_px):
        return np.minimum(distances_px(angles_rad), largest_px).mean(axis=1)

    grid = np.deg2rad(np.arange(0.0, 360.0, _SEARCH_STEP_DEG))
    # A step of the grid moves a point by several pixels.
    rough = grid[np.argmin(cost(grid, 10.0 * _NEAR_PX))]
    step = np.deg2rad(_SEARCH_STEP_DEG)
    fine = rough + step * np.linspace(-1.0, 1.0, 41)
    angle = float(fine[np.argmin(cost(fine, _NEAR_PX))])
    near = float((distances_px(angle)[0] < _NEAR_PX).mean())
    return angle if near >= _NEAR_FRACTION else None


def _enough(tracks: Tracks, good: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """The good rows of points that are seen in enough frames, in frames that show enough points."""
    while True:
        views = np.bincount(tracks.point[good], minlength=tracks.point.max(initial=0) + 1)
        good = good & (views[tracks.point] >= _FEWEST_VIEWS)
        seen = np.bincount(tracks.frame[good], minlength=tracks.frame.max(initial=0) + 1)
        enough = good & (seen[tracks.frame] >= _FEWEST_POINTS)
        if (enough == good).all():
            break
        good = enough
    if len(np.unique(tracks.frame[good])) < FEWEST_FRAMES:
        raise InputError(
            "too few points of the object are seen in enough frames to fix the turntable's axis; take smaller steps, "
            "give the object more texture, or take markers"
        )
    return good
