"""Fit of a turntable (one axis, one angle per frame, a fixed camera) to free poses of single frames.

With B the camera's rotation in the first frame and u the axis, frame i has

    R_i = B Rot(u, a_i)     and     R_i p + t_i = q   for a point p on the axis,

because the axis is stationary in front of the camera. Both are linear in the unknowns (u, then p and q). The object
is near the axis, so q is known well even if a frame's rotation and position have correlated errors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import closest_point_to_rays, cross_matrix, rotation_about_z, rotation_angle_deg
from hsi_sc_nerf.poses.turntable import FEWEST_FRAMES, Turntable, require_parallax

# A frame contradicts the turntable if a misfit is above this and above this multiple of the median misfit.
_CONTRADICTS_DEG = 3.0
_CONTRADICTS_DISTANCES = 0.02
_CONTRADICTS_MEDIANS = 6.0
# With smaller steps, all poses are the same: the camera is stationary and there is no axis.
_LEAST_TURN_DEG = 2.0
_ROUNDS = 10


def turntable_from_poses(
    world_to_camera: Float[np.ndarray, "n 4 4"],
    points_3d: Float[np.ndarray, "p 3"],
    focal_px: float,
    centre_px: tuple[float, float],
) -> tuple[Turntable, Bool[np.ndarray, "n"]]:
    """The axis, the camera before it and one angle per frame that fit free poses best.

    The axis comes from the frames that most pairs of frames agree with; single wrong poses do no harm. Poses alone
    do not determine which end of an axis is up: it is taken up in the image, to within 90 degrees (`upright`).

    Args:
        world_to_camera: OpenCV axes, any scale; nan where a frame has no pose.
        points_3d: points of the poses' world.

    Returns:
        The turntable with the points, numbered by row, in distances of the camera from the axis; its first frame has
        the angle 0. And the frames whose pose contradicts the others', which it lacks.

    Raises:
        InputError: fewer than three poses, or poses that do not turn about one axis beside the camera.
    """
    posed = np.isfinite(world_to_camera).all(axis=(1, 2))
    if posed.sum() < FEWEST_FRAMES:
        raise InputError(
            f"{int(posed.sum())} posed frame(s) cannot fix a turntable's axis; {FEWEST_FRAMES} or more are needed"
        )
    rotations, shifts = world_to_camera[posed, :3, :3], world_to_camera[posed, :3, 3]
    good = _agreeing(rotations)
    while good.sum() >= FEWEST_FRAMES:
        axis, base, angles = _about_one_axis(rotations, good)
        on_axis, before_camera = _axis_position(rotations, shifts, axis, good)
        distance = float(np.linalg.norm(_perpendicular(base.T @ before_camera, axis)))
        turns = Rotation.from_rotvec(np.outer(angles, axis)).as_matrix()
        misfit_deg = rotation_angle_deg(rotations, base @ turns)
        misfit = np.linalg.norm(rotations @ on_axis + shifts - before_camera, axis=-1) / max(distance, 1e-12)
        wrong = _is_outlier(misfit_deg, good, _CONTRADICTS_DEG) | _is_outlier(misfit, good, _CONTRADICTS_DISTANCES)
        if not wrong[good].any():
            break
        good = good & ~wrong
    if good.sum() < FEWEST_FRAMES or np.ptp(np.unwrap(angles[good])) < np.deg2rad(_LEAST_TURN_DEG):
        raise InputError(
            "the poses that were found do not turn about one axis: the camera seems to be stationary or to move "
            "freely; mask out what does not turn, or take markers"
        )

    if (base @ axis)[1] > 0.0:  # the image's y points down
        axis, angles = -axis, -angles
    camera = -base.T @ before_camera
    if len(points_3d):
        require_parallax(distance, np.linalg.norm(points_3d - on_axis - camera, axis=-1))
    x = _perpendicular(camera, axis) / distance
    at_zero = np.stack([x, np.cross(axis, x), axis])
    first = int(np.flatnonzero(good)[0])
    # The frame's x belongs to the angle 0 of `base`; turn it to the first fitted frame.
    to_turntable = rotation_about_z(np.rad2deg(angles[first]))[:3, :3] @ at_zero
    contradicts = np.zeros(len(posed), bool)
    contradicts[posed] = ~good
    # The axis' point at the camera's height.
    origin = on_axis + (camera @ axis) * axis
    turntable = Turntable(
        focal_px=focal_px,
        centre_px=centre_px,
        camera_rotation=base @ at_zero.T,
        frames=np.flatnonzero(posed)[good],
        angles_rad=np.unwrap(angles[good]) - angles[first],
        points=np.arange(len(points_3d)),
        points_3d=(points_3d - origin) @ to_turntable.T / distance,
    )
    return turntable, contradicts


def upright(turntable: Turntable) -> Turntable:
    """The turntable, turned over if its axis lies in the image and the camera would look up at the points.

    Along the image's horizontal, up in the image says nothing; cameras of turntables look down.

    Args:
        turntable: without markers and motions.
    """
    right, down, _ = np.abs(turntable.camera_rotation[:, 2])
    return turntable if right <= down or looks_up_deg(turntable) <= 0.0 else turntable.turned_over()


def looks_up_deg(turntable: Turntable) -> float:
    """How far the middle of the points is above the camera's horizon."""
    return float(np.rad2deg(np.arctan2(np.median(turntable.points_3d[:, 2]), turntable.distance)))


def reversed_in_depth(turntable: Turntable) -> Turntable:
    """The turntable whose points, axis and turn are mirrored in depth: a camera far away sees the same of it.

    With a long lens, a turn in one direction seen from above looks nearly like a turn in the other direction seen
    from below. Structure from motion with a wrong focal length may find the wrong one of the two.

    Args:
        turntable: without markers and motions.
    """
    middle = np.array([0.0, 0.0, np.median(turntable.points_3d[:, 2])])
    in_camera = turntable.camera_rotation @ (middle - [turntable.distance, 0.0, 0.0])
    mirror = np.diag([-1.0, 1.0, 1.0])
    sight = in_camera / np.linalg.norm(in_camera)
    rotation = (np.eye(3) - 2.0 * np.outer(sight, sight)) @ turntable.camera_rotation @ mirror
    camera = -rotation.T @ in_camera
    turn = rotation_about_z(float(np.rad2deg(np.arctan2(camera[1], camera[0]))))[:3, :3]
    mirrored = replace(
        turntable,
        camera_rotation=rotation @ turn,
        distance=float(np.hypot(camera[0], camera[1])),
        angles_rad=-turntable.angles_rad,
        # The origin is at the camera's height.
        points_3d=(turntable.points_3d - middle) @ mirror @ turn - [0.0, 0.0, camera[2]],
    )
    return mirrored.resized(turntable.distance / mirrored.distance)


def _agreeing(rotations):
    """Frames in line with the axis of the one pair of frames that leaves the smallest median misfit.

    An axis u of the world and its image v in the camera satisfy R_i u = v in every frame.
    """
    i, j = np.triu_indices(len(rotations), 1)
    relative = Rotation.from_matrix(np.swapaxes(rotations[i], -1, -2) @ rotations[j]).as_rotvec()
    size = np.linalg.norm(relative, axis=-1)
    turned = size > np.deg2rad(_LEAST_TURN_DEG)
    if not turned.any():
        return np.zeros(len(rotations), bool)
    axes = relative[turned] / size[turned, None]
    in_camera = np.einsum("pij,pj->pi", rotations[i[turned]], axes)
    pairs = zip(axes, in_camera, strict=True)
    best = min((np.linalg.norm(rotations @ axis - image, axis=-1) for axis, image in pairs), key=np.median)
    return best <= max(np.deg2rad(_CONTRADICTS_DEG), _CONTRADICTS_MEDIANS * float(np.median(best)))


def _about_one_axis(rotations, good):
    """Axis, base rotation and angles with R_i close to base Rot(axis, a_i), by least squares over the good frames."""
    # |R_i u - v| is least where u is what the mean rotation shortens least.
    axis = np.linalg.svd(rotations[good].mean(axis=0))[2][0]
    base = rotations[good][0]
    cross = cross_matrix(axis)
    for _ in range(_ROUNDS):
        relative = base.T @ rotations
        cosine = np.trace(relative, axis1=1, axis2=2) - axis @ relative @ axis
        sine = np.einsum("nij,ij->n", relative, cross)
        angles = np.arctan2(sine, cosine)
        back = Rotation.from_rotvec(-np.outer(angles[good], axis))
        base = (Rotation.from_matrix(rotations[good]) * back).mean().as_matrix()
    return axis, base, angles


def _axis_position(rotations, shifts, axis, good):
    """R_i p + t_i = q: p in the world, at the height of the object, q in the camera.

    Reweighting minimises the sum of the distances, not of their squares, for robustness to single wrong poses.
    """
    rotations, shifts = rotations[good], shifts[good]
    n = len(rotations)
    # Where the viewing directions meet, p is near the object, where the poses determine it best.
    cameras = -np.einsum("nji,nj->ni", rotations, shifts)
    (near_object,), _ = closest_point_to_rays(cameras, rotations[:, 2])
    plane = np.linalg.svd(axis[None])[2][1:].T
    design = np.concatenate([rotations @ plane, -np.tile(np.eye(3), (n, 1, 1))], axis=-1)
    right = -(rotations @ near_object + shifts)
    weight = np.ones(n)
    for _ in range(_ROUNDS):
        weighted = (design * weight[:, None, None]).reshape(3 * n, 5)
        solution = np.linalg.lstsq(weighted, (right * weight[:, None]).ravel(), rcond=None)[0]
        left = np.linalg.norm(design @ solution - right, axis=-1)
        weight = 1.0 / np.sqrt(np.maximum(left, max(1e-3 * float(np.median(left)), 1e-12)))
    return near_object + plane @ solution[:2], solution[2:]


def _is_outlier(misfit, good, least):
    return misfit > max(least, _CONTRADICTS_MEDIANS * float(np.median(misfit[good])))


def _perpendicular(vector, axis):
    return vector - (vector @ axis) * axis
