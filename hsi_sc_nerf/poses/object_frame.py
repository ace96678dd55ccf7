"""The object frame and its scale: origin on the disc, x towards the first frame's camera, z along the axis, metres.

Markers determine the disc. The scale comes from the markers' side, from the container that carries markers, from its
outline, or from the camera's distance.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.geometry.camera import rotation_about_z, unit_vectors
from hsi_sc_nerf.poses.bundle_adjustment import FreeParameters, Problem
from hsi_sc_nerf.poses.container_outline import ContainerOutline
from hsi_sc_nerf.poses.model_selection import LOSS_SIGMAS
from hsi_sc_nerf.poses.residuals import MarkerResiduals
from hsi_sc_nerf.poses.result import ScaleSource
from hsi_sc_nerf.poses.turntable import MarkerObservations, Turntable

# A marker lies on the disc if it faces up to this cosine and its centre is this near the lowest marker's, in marker
# sides.
_FACES_UP_COSINE = 0.97
_COPLANAR_SIDES = 0.2
# A marker stands upright if its normal leaves the horizontal by less than this sine, about 12 degrees.
_UPRIGHT_SINE = 0.2
# A marker belongs to the container if its plane is this near the circle through all of them, in marker sides.
_ON_CONTAINER_SIDES = 0.15
_FEWEST_TO_FIND_THE_CENTRE = 3
# Without any marker the origin is at the height of the lowest points.
_LOWEST_POINTS_PERCENTILE = 1.0


def to_object_frame(turntable: Turntable, disc: float) -> Float[np.ndarray, "4 4"]:
    """From the object's axes at the angle 0 to the object frame: a turn about z and a shift along it.

    Args:
        disc: height of the disc in the turntable frame, in the turntable's unit of length.
    """
    camera = turntable.camera_positions()[0]
    to_object = rotation_about_z(-float(np.rad2deg(np.arctan2(camera[1], camera[0]))))
    to_object[2, 3] = -disc
    return to_object


def lie_on_disc(corners: Float[np.ndarray, "m 4 3"]) -> Bool[np.ndarray, "m"]:
    """Which markers lie on the disc: the lowest of all, where they face up along z, the axis, and share one height.

    What faces up above others, as on the container's lid, does not lie on the disc.

    Args:
        corners: corners of each marker, in any unit, clockwise seen from its front.
    """
    right, down = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    normal = np.cross(down, right)
    up = normal[:, 2] > _FACES_UP_COSINE * np.linalg.norm(normal, axis=-1)
    if not up.any():
        return up
    height = corners[..., 2].mean(axis=1)
    side = np.linalg.norm(right, axis=-1).mean()
    return up & (height < height.min() + _COPLANAR_SIDES * side)


def disc_height(turntable: Turntable) -> float:
    """Height of the disc in the turntable frame; without markers on it that of the lowest marker corner, or, without
    any marker, of the lowest points."""
    corners = turntable.corners()
    flat = lie_on_disc(corners)
    if flat.any():
        return float(np.median(corners[flat, :, 2].mean(-1)))
    if len(corners):
        return float(corners[..., 2].min())
    return float(np.percentile(turntable.points_3d[:, 2], _LOWEST_POINTS_PERCENTILE))


def foot_gives_disc(turntable: Turntable, outline: ContainerOutline | None) -> bool:
    """Whether the disc's height is that of the container's foot, which is known to about a pixel.

    Markers on the disc tell it better. Those that lie nearer to the container's lid than to its foot are on the lid.
    """
    if outline is None:
        return False
    near = abs(disc_height(turntable) - outline.foot) < 0.5 * outline.height
    return not (lie_on_disc(turntable.corners()).any() and near)


def lowest_landmarks(turntable: Turntable) -> Bool[np.ndarray, "l"]:
    """Which markers, or without any which points, the disc's height rests on."""
    if len(turntable.markers) == 0:
        return turntable.points_3d[:, 2] <= np.percentile(turntable.points_3d[:, 2], _LOWEST_POINTS_PERCENTILE)
    flat, lowest = lie_on_disc(turntable.corners()), turntable.corners()[..., 2].min(axis=1)
    return flat if flat.any() else lowest == lowest.min()


def disc_tilt_deg(turntable: Turntable) -> float | None:
    """Angle between the axis and the normal of the plane through the disc's markers; None below three markers."""
    corners = turntable.corners()
    flat = lie_on_disc(corners)
    if flat.sum() < 3:
        return None
    points = corners[flat].reshape(-1, 3)
    normal = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]
    return float(np.rad2deg(np.arctan2(np.hypot(normal[0], normal[1]), abs(normal[2]))))


def container_diameter(turntable: Turntable, container_height: float | None) -> float | None:
    """Diameter of the upright cylinder whose wall the markers around the container touch, in the turntable's unit.

    The container need not stand on the axis: three or more markers determine its centre. Fewer are taken to stand
    around the axis. None where no upright marker faces outwards, or their planes touch no common circle.

    Args:
        container_height: markers whose centre is above this height over the disc are not on the container.
    """
    normals, centres = turntable.marker_poses[:, :3, 2], turntable.marker_poses[:, :3, 3]
    upright = (np.abs(normals[:, 2]) < _UPRIGHT_SINE) & ((normals[:, :2] * centres[:, :2]).sum(-1) > 0)
    if container_height is not None:
        upright &= centres[:, 2] - disc_height(turntable) < container_height
    normals = unit_vectors(normals[upright, :2])
    distance = (normals * centres[upright, :2]).sum(-1)
    if len(distance) == 0:
        return None
    # n.p = n.centre + radius
    design = np.column_stack([normals, np.ones(len(normals))])
    if len(distance) < _FEWEST_TO_FIND_THE_CENTRE or np.linalg.cond(design) > 20.0:
        design[:, :2] = 0.0
    solution = np.linalg.lstsq(design, distance, rcond=None)[0]
    if np.abs(design @ solution - distance).max() > _ON_CONTAINER_SIDES * turntable.side or solution[2] <= 0.0:
        return None
    return 2.0 * float(solution[2])


def apparent_sides(
    turntable: Turntable, seen: MarkerObservations
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Each marker's side over the mean of all, if each had its own, and standard deviations (for unit variance).

    One Gauss-Newton step from the adjusted turntable, with camera and angles held.
    """
    residuals = MarkerResiduals(turntable, seen, LOSS_SIGMAS, free_sides=True)
    held = FreeParameters(camera=False, angles=False)
    problem = Problem(residuals, free=held)
    equations, sides = problem.normal_equations(turntable), problem.layout.landmarks[0][:, 6]
    inverse = np.linalg.pinv(equations.landmarks.toarray(), hermitian=True)
    logs = -(inverse @ equations.gradient)[sides]
    return np.exp(logs - logs.mean()), np.sqrt(inverse.diagonal()[sides])


def scale_of(
    turntable: Turntable, info: SessionInfo, outline: ContainerOutline | None = None
) -> tuple[ScaleSource | None, float]:
    """What gives the scale, None if nothing does; and the length of the turntable's unit in metres, 1 if unknown.

    Args:
        turntable: adjusted.
        info: the markers' side, the container's diameter, the camera's distance.
        outline: outline of the container, without markers.
    """
    if len(turntable.markers):
        if info.marker_side_m is not None:
            return "markers", info.marker_side_m / turntable.side
        diameter = container_diameter(turntable, None)
        if info.container_diameter_m is not None and diameter is not None:
            return "container", info.container_diameter_m / diameter
    if info.container_diameter_m is not None and outline is not None:
        return "outline", info.container_diameter_m / (2.0 * outline.radius)
    if info.camera_distance_m is not None:
        return "distance", info.camera_distance_m / turntable.distance
    return None, 1.0
