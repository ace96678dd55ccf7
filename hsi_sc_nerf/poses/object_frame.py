"""The object frame and its scale: origin on the disc, x towards the first frame's camera, z along the axis, metres.

Markers determine the disc. The scale comes from the markers' side, or from the container that carries markers.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, closest_point_to_rays, pixel_rays, rotation_about_z
from hsi_sc_nerf.poses.marker_adjustment import MarkerProblem
from hsi_sc_nerf.poses.result import Scale
from hsi_sc_nerf.poses.turntable import MarkerObservations, MarkerTurntable, Turntable

# A marker lies on the disc if it faces up to this cosine and its centre is this near the lowest such marker's,
# in marker sides.
_FACES_UP_COSINE = 0.97
_COPLANAR_SIDES = 0.2
# A marker stands upright if its normal leaves the horizontal by less than this sine, about 12 degrees.
_UPRIGHT_SINE = 0.2
# A marker belongs to the container if its plane is this near the circle through all of them, in marker sides.
_ON_CONTAINER_SIDES = 0.15
_FEWEST_TO_FIND_THE_CENTRE = 3
# A marker seen in fewer frames, or along rays that are nearly parallel, is not triangulated.
_FEWEST_VIEWS = 2
_LEAST_EIGENVALUE = 1e-3


def to_object_frame(turntable: Turntable, disc: float) -> Float[np.ndarray, "4 4"]:
    """From the object's axes at the angle 0 to the object frame: a turn about z and a shift along it.

    Args:
        turntable: adjusted.
        disc: height of the disc in the turntable frame, in the turntable's unit of length.
    """
    camera = turntable.camera_positions()[0]
    to_object = rotation_about_z(-float(np.rad2deg(np.arctan2(camera[1], camera[0]))))
    to_object[2, 3] = -disc
    return to_object


def lie_on_disc(corners: Float[np.ndarray, "m 4 3"]) -> Bool[np.ndarray, "m"]:
    """Which markers lie on the disc: the lowest group that faces up along z, the axis, and shares one height.

    Args:
        corners: of each marker, in any unit, clockwise seen from its front.
    """
    right, down = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    normal = np.cross(down, right)
    up = normal[:, 2] > _FACES_UP_COSINE * np.linalg.norm(normal, axis=-1)
    if not up.any():
        return up
    height = corners[..., 2].mean(axis=1)
    side = np.linalg.norm(right, axis=-1).mean()
    return up & (height < height[up].min() + _COPLANAR_SIDES * side)


def disc_height_m(turntable: MarkerTurntable) -> float:
    """Height of the disc in the turntable frame; without markers on it that of the lowest marker corner."""
    corners = turntable.corners()
    flat = lie_on_disc(corners)
    return float(np.median(corners[flat, :, 2].mean(-1)) if flat.any() else corners[..., 2].min())


def disc_tilt_deg(turntable: MarkerTurntable) -> float | None:
    """Angle between the axis and the normal of the plane through the disc's markers; None below three markers."""
    corners = turntable.corners()
    flat = lie_on_disc(corners)
    if flat.sum() < 3:
        return None
    points = corners[flat].reshape(-1, 3)
    normal = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]
    return float(np.rad2deg(np.arctan2(np.hypot(normal[0], normal[1]), abs(normal[2]))))


def container_diameter(
    normals: Float[np.ndarray, "m 3"],
    centres: Float[np.ndarray, "m 3"],
    side: float,
    disc: float,
    container_height: float | None,
) -> float | None:
    """Diameter of the upright cylinder whose wall the markers around the container touch; any unit of length.

    The container need not stand on the axis: three or more markers determine its centre. Fewer are taken to stand
    around the axis. None where no upright marker faces outwards, or their planes touch no common circle.

    Args:
        normals: of the markers, unit vectors out of their faces; z is the axis.
        centres: of the markers.
        side: the markers' side.
        disc: height of the disc.
        container_height: markers whose centre is above this height over the disc are not on the container.
    """
    upright = (np.abs(normals[:, 2]) < _UPRIGHT_SINE) & ((normals[:, :2] * centres[:, :2]).sum(-1) > 0)
    if container_height is not None:
        upright &= centres[:, 2] - disc < container_height
    normals = normals[upright, :2] / np.linalg.norm(normals[upright, :2], axis=-1, keepdims=True)
    distance = (normals * centres[upright, :2]).sum(-1)
    if len(distance) == 0:
        return None
    # n.p = n.centre + radius
    design = np.column_stack([normals, np.ones(len(normals))])
    if len(distance) < _FEWEST_TO_FIND_THE_CENTRE or np.linalg.cond(design) > 20.0:
        design[:, :2] = 0.0
    solution = np.linalg.lstsq(design, distance, rcond=None)[0]
    if np.abs(design @ solution - distance).max() > _ON_CONTAINER_SIDES * side or solution[2] <= 0.0:
        return None
    return 2.0 * float(solution[2])


def length_sigma(turntable: MarkerTurntable, problem: MarkerProblem, covariance: Float[np.ndarray, "p p"]) -> float:
    """Standard deviation, as a fraction, of lengths on the turntable: of the markers' distance from the axis (RMS).

    The markers' side is taken for exact; the corners are not.
    """
    centres = turntable.marker_poses[:, :2, 3]
    gradient = np.zeros(len(covariance))
    gradient[problem.layout.landmark[:, 3:5]] = centres / (centres**2).sum()
    return float(np.sqrt(gradient @ covariance @ gradient))


def apparent_sides(
    turntable: MarkerTurntable, problem: MarkerProblem
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Each marker's side over the mean of all, if each had its own, and standard deviations (for unit variance).

    One Gauss-Newton step from the adjusted turntable with the logs of the sides as further parameters of mean 0.
    """
    free = replace(problem.free, marker_sides=True)
    with_sides = MarkerProblem(turntable, problem.observations, problem.loss_scale, free)
    normal, gradient = with_sides.normal_equations(turntable).dense()
    sides = with_sides.layout.landmark[:, 6]
    normal[np.ix_(sides, sides)] += normal.diagonal().max() / len(sides)
    inverse = np.linalg.inv(normal)
    return np.exp(-(inverse @ gradient)[sides]), np.sqrt(inverse.diagonal()[sides])


def triangulate_markers(
    observations: MarkerObservations, camera_to_world: Float[np.ndarray, "n 4 4"], intrinsics: PinholeIntrinsics
) -> dict[int, Float[np.ndarray, "4 3"]]:
    """Corners of markers by the rays of all frames, in the poses' unit of length.

    Args:
        observations: of markers that turn with the object; their frames are rows of ``camera_to_world``.
        camera_to_world: nan where a frame has no pose.
        intrinsics: of the camera; lens distortion is ignored.
    """
    posed = np.isfinite(camera_to_world).all(axis=(1, 2))
    corners = {}
    for marker in np.unique(observations.marker).tolist():
        rows = np.flatnonzero((observations.marker == marker) & posed[observations.frame])
        if len(rows) < _FEWEST_VIEWS:
            continue
        rays = [
            pixel_rays(intrinsics, camera_to_world[observations.frame[r]], observations.corners_px[r]) for r in rows
        ]
        origins, directions = (np.stack(part) for part in zip(*rays, strict=True))
        corner = np.tile(np.arange(4), (len(rows), 1))
        points, eigenvalue = closest_point_to_rays(np.repeat(origins[:, None], 4, axis=1), directions, corner)
        if eigenvalue.min() > _LEAST_EIGENVALUE * len(rows):
            corners[marker] = points
    return corners


def scale_by_markers(
    corners: dict[int, Float[np.ndarray, "4 3"]], disc: float, info: SessionInfo
) -> tuple[Scale | None, float]:
    """The scale of poses from features, by markers in the same frames.

    Args:
        corners: of each marker, in the poses' unit of length.
        disc: height of the disc in that unit.
        info: the markers' side, the container's size, or the camera's distance.

    Returns:
        The scale, None where markers do not give it; and the length of the unit in metres, 1 if it is not known.
    """
    nothing = None, info.camera_distance_m or 1.0
    if not corners:
        return nothing
    sides = {m: float(np.linalg.norm(c - np.roll(c, 1, axis=0), axis=-1).mean()) for m, c in corners.items()}
    typical = float(np.median(list(sides.values())))
    relative = {m: side / typical for m, side in sides.items()}
    spread = float(np.std(list(relative.values()))) if len(sides) > 1 else 0.0
    faces = np.stack(list(corners.values()))
    # Corners go round clockwise from the upper left one, so this points out of the face.
    normals = np.cross(faces[:, 3] - faces[:, 0], faces[:, 1] - faces[:, 0])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)

    def diameter(height: float | None) -> float | None:
        return container_diameter(normals, faces.mean(axis=1), typical, disc, height)

    source: Literal["markers", "container"]
    if info.marker_side_m is not None:
        source, metres = "markers", info.marker_side_m / typical
    elif info.container_diameter_m is not None and (diameter_in_units := diameter(None)) is not None:
        source, metres = "container", info.container_diameter_m / diameter_in_units
    else:
        return nothing
    measured = diameter(None if info.container_height_m is None else info.container_height_m / metres)
    scale = Scale(
        source=source,
        marker_side_m=typical * metres,
        uncertainty=spread / np.sqrt(len(sides)),
        marker_sides=relative,
        marker_side_sigmas=dict.fromkeys(sides, spread),
        container_diameter_m=info.container_diameter_m,
        measured_container_diameter_m=None if measured is None else measured * metres,
    )
    return scale, metres
