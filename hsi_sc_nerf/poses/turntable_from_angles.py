"""The camera before a turntable whose angles are known, from points seen in several frames alone.

The unknowns are the camera's rotation and its focal length, four numbers, for the distance is the unit of length. A
point seen in two frames gives one equation for them, for its two rays meet.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL, closest_point_to_rays, look_at
from hsi_sc_nerf.poses.turntable import PointTurntable, Tracks, project, rotations_about_z

# Starts of the search: the camera's elevation, and its focal length in image widths.
_ELEVATIONS_DEG = (5.0, 25.0, 50.0)
_FOCAL_FACTORS = (1.0, 1.8, 3.5)
# A long lens hardly differs from an infinitely long one: each start keeps near its own focal length, by this in
# logarithms.
_FOCAL_REACH = 0.35
# Pairs of rays that are looked at, and the turn between them.
_MOST_PAIRS = 2000
_PAIR_TURN_DEG = (8.0, 90.0)
# Errors well above this hardly count (Cauchy): many raw matches are wrong.
_LOSS_PX = 0.3
# Of a wrong camera's points about half lie behind it.
_IN_FRONT_FRACTION = 0.75


def turntable_from_angles(
    tracks: Tracks,
    frames: Int[np.ndarray, "f"],
    angles_rad: Float[np.ndarray, "f"],
    size_px: tuple[int, int],
    *,
    direction_known: bool = True,
) -> PointTurntable:
    """The camera for which the rays of each point meet, and these points: a start for ``adjust_tracks``.

    The axis is taken up in the image, to within 90 degrees, and the principal point in the image's middle.

    Args:
        tracks: points seen in frames.
        frames: the tracks' frames with known angles, ascending.
        angles_rad: their angles, counter-clockwise seen from above.
        size_px: width and height of the images.
        direction_known: otherwise the angles' sign is the one that fits the tracks better.

    Raises:
        InputError: the tracks do not determine the camera, or contradict the angles.
    """
    width, height = size_px
    centre = (width / 2, height / 2)
    rows = _pairs(tracks, frames, angles_rad)
    focals = [factor * width for factor in _FOCAL_FACTORS]
    reach = np.array([np.inf, np.inf, np.inf, _FOCAL_REACH])
    best, best_cost = None, np.inf
    for sign, elevation_deg, focal in product((1.0,) if direction_known else (1.0, -1.0), _ELEVATIONS_DEG, focals):
        angles = sign * angles_rad
        elevation = np.deg2rad(elevation_deg)
        camera = look_at(np.array([np.cos(elevation), 0.0, np.sin(elevation)]), np.zeros(3)) @ OPENCV_TO_OPENGL
        base = camera[:3, :3].T
        turns = np.stack([rotations_about_z(-angles[np.searchsorted(frames, tracks.frame[r])]) for r in rows])
        rays = np.stack([tracks.pixels[r] - centre for r in rows])

        def error_px(x, turns=turns, rays=rays, base=base, focal=focal):
            return _sampson_error_px(
                Rotation.from_rotvec(x[:3]).as_matrix() @ base, focal * np.exp(x[3]), turns, rays
            )

        found = least_squares(
            error_px, np.zeros(4), bounds=(-reach, reach), x_scale="jac", loss="cauchy", f_scale=_LOSS_PX, max_nfev=60
        )
        rotation = Rotation.from_rotvec(found.x[:3]).as_matrix() @ base
        if found.cost >= best_cost or rotation[1, 2] > 0.0:
            continue
        turntable = PointTurntable(
            focal_px=float(focal * np.exp(found.x[3])),
            centre_px=centre,
            camera_rotation=rotation,
            frames=frames,
            angles_rad=angles,
            points=np.zeros(0, int),
            points_3d=np.zeros((0, 3)),
        )
        turntable, fraction = _with_points(turntable, tracks)
        if fraction >= _IN_FRONT_FRACTION:
            best, best_cost = turntable, found.cost
    if best is None:
        raise InputError(
            "the features do not fit the turntable's known angles; check the nominal step and the direction, or "
            "take markers"
        )
    return best


def _pairs(tracks, frames, angles_rad):
    """Rows of the tracks, paired: a point's sightings a fair turn apart, evenly taken from all."""
    known = np.flatnonzero(np.isin(tracks.frame, frames))
    order = known[np.lexsort((tracks.frame[known], tracks.point[known]))]
    angle = angles_rad[np.searchsorted(frames, tracks.frame[order])]
    first, second = [], []
    for apart in range(1, len(frames)):
        same = tracks.point[order[apart:]] == tracks.point[order[:-apart]]
        if not same.any():
            break
        turn = np.rad2deg(np.abs(angle[apart:] - angle[:-apart]))
        take = same & (turn >= _PAIR_TURN_DEG[0]) & (turn <= _PAIR_TURN_DEG[1])
        first.append(order[:-apart][take])
        second.append(order[apart:][take])
    pairs = np.stack([np.concatenate(first), np.concatenate(second)]) if first else np.zeros((2, 0), int)
    if pairs.shape[1] < 8:
        raise InputError("too few points of the object are seen in frames that lie apart; give it more texture")
    return pairs[:, np.linspace(0, pairs.shape[1] - 1, min(_MOST_PAIRS, pairs.shape[1])).astype(int)]


def _sampson_error_px(rotation, focal_px, turns, pixels):
    """Distance by which the two rays of each pair miss each other, in pixels (Sampson's approximation).

    Rays of directions r, r' from origins c, c' meet if (c' - c) . (r x r') = 0; its gradient by the pixels makes it a
    distance in the image (R. Hartley and A. Zisserman, "Multiple view geometry", section 11.4.3).
    """
    before = np.concatenate([pixels / focal_px, np.ones((*pixels.shape[:2], 1))], axis=-1)
    rays = np.einsum("knij,knj->kni", turns, before @ rotation)
    apart = turns[1, :, :, 0] - turns[0, :, :, 0]
    normals = np.cross(rays[::-1], apart)
    miss = (rays[0] * normals[0]).sum(-1)
    gradient = np.einsum("knji,knj->kni", turns, normals) @ rotation.T
    return miss / (np.linalg.norm(gradient[..., :2], axis=-1) ** 2).sum(0) ** 0.5 * focal_px


def _with_points(turntable, tracks):
    """The turntable with every point triangulated, less those behind the camera.

    Also returns the fraction of observations before the camera.
    """
    tracks = tracks.select(np.isin(tracks.frame, turntable.frames))
    points, point = np.unique(tracks.point, return_inverse=True)
    frame = np.searchsorted(turntable.frames, tracks.frame)
    to_object = rotations_about_z(-turntable.angles_rad)[frame]
    normalised = (tracks.pixels - turntable.centre_px) / turntable.focal_px
    in_room = np.column_stack([normalised, np.ones(len(normalised))]) @ turntable.camera_rotation
    directions = np.einsum("nij,nj->ni", to_object, in_room)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    # A point seen once, or along parallel rays, stays near the axis.
    points_3d, _ = closest_point_to_rays(to_object[:, :, 0], directions, point, regularisation=1e-9)
    behind = project(turntable, frame, points_3d[point]).in_camera[:, 2] <= 0.0
    wrong = np.isin(np.arange(len(points)), point[behind])
    return replace(turntable, points=points[~wrong], points_3d=points_3d[~wrong]), 1.0 - float(behind.mean())
