"""Elements: points that represent parts of a surface, on the object and its support, and which frames see them.

Lengths are metres in the object frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, image_coordinates, unit_vectors
from hsi_sc_nerf.geometry.mesh import Mesh, ray_scene, unoccluded
from hsi_sc_nerf.light.views import SMALLEST, ElementViews

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

SUPPORT_SIDES = 25
"""Triangles of the support along the disc's radius: 4 mm on a turntable, so that each belongs to one element."""
POINTS_EACH = 4
"""Points of the object's surface for each of its elements; a pixel shows several times as many."""
NORMAL_WEIGHT = 2.0
"""A triangle belongs to the nearest element; a right angle between normals counts as this many spacings."""
LARGEST_INCIDENCE_DEG, LARGEST_INCIDENCE_OF_SUPPORT_DEG = 70.0, 80.0
"""More oblique pixels also cover neighbouring parts. Every camera sees the lid obliquely."""

MISPLACED_PX = 0.3
"""Poses, surface and interpolation are uncertain by this fraction of a pixel."""
EDGE_PX = 2.0
"""Pixels this near to an edge of a level surface also cover what is beyond it: interpolation uses four pixels."""
SAME_HEIGHT_M = 1e-4
ROUGHNESS_M = 0.001
"""Light falls on points by means of the normals within this radius. Facets of a trained mesh are rough by 4 to 7
degrees and would get less light from a lamp than the surface does; kernels of an ear are larger."""

Pixels = Callable[[int, Int[np.ndarray, "n"], Int[np.ndarray, "n"]], Float[np.ndarray, "n bands"]]
"""Reflectance of pixels of a frame, given by line and sample; NaN where nothing was measured."""


@dataclass(frozen=True, eq=False)
class Elements:
    """Parts of a surface.

    Attributes:
        positions: a point of each part.
        normals: outward unit normals.
        on_object: which parts belong to the object, not to its support.
        shows_light: which parts the light is fitted to: those of the object, and of the level surface that it stands
            on, which only the object shades. Lower parts of the support are left out: a real container has plates
            and markers on its sides that shade them otherwise.
        occluders: the whole surface, which occludes light and reflects it.
        of_triangle: element that each triangle of the occluders belongs to.
    """

    positions: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    on_object: Bool[np.ndarray, "n"]
    shows_light: Bool[np.ndarray, "n"]
    occluders: Mesh
    of_triangle: Int[np.ndarray, "t"]


def spread_elements(scanned: Mesh, support: Mesh, on_object: int, on_support: int, smoothing_m: float) -> Elements:
    """Elements spread evenly over the object and its support.

    Args:
        scanned: the object's mesh, with or without holes.
        support: the surface under the object (`support_mesh`); may have no triangles.
        on_object: elements of the object.
        on_support: elements of the support.
        smoothing_m: normals of the object are means over this radius: about a pixel, which shows no more.
    """
    points = [sample_surface(scanned.vertices, scanned.triangles, on_object)]
    own = [smooth_normals(scanned, points[0], smoothing_m)]
    of_triangle = [_nearest(scanned, points[0], own[0])]
    if len(support.triangles):
        points.append(sample_surface(support.vertices, support.triangles, on_support))
        middles = cKDTree(support.vertices[support.triangles].mean(axis=1))
        own.append(support.facet_normals()[middles.query(points[1])[1]])
        of_triangle.append(on_object + _nearest(support, points[1], own[1]))
    whole = Mesh(
        np.concatenate([scanned.vertices, support.vertices]),
        np.concatenate([scanned.triangles, support.triangles + len(scanned.vertices)]),
    )
    positions = np.concatenate(points)
    is_object = np.arange(len(positions)) < on_object
    heights = positions[:, 2]
    shows_light = is_object | (heights > heights[~is_object].max(initial=-np.inf) - SAME_HEIGHT_M)
    return Elements(positions, np.concatenate(own), is_object, shows_light, whole, np.concatenate(of_triangle))


def shown_points(
    elements: Elements, radius_m: float, lift_m: float
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"], scipy.sparse.csr_array]:
    """Points of the elements that pixels show: kernels of an ear shade each other and have normals of their own.

    Args:
        elements: elements of the object and its support, which is smooth.
        radius_m: points lie within this of their element.
        lift_m: distance of the origins of lines of sight from the surface.

    Returns:
        Points, outward unit normals without roughness, and each one's weight in each element, seen along its normal.
    """
    count, whole = len(elements.positions), elements.occluders
    scanned = Mesh(whole.vertices, whole.triangles[elements.on_object[elements.of_triangle]])
    points = sample_surface(scanned.vertices, scanned.triangles, POINTS_EACH * int(elements.on_object.sum()))
    facets = ray_scene(scanned.vertices, scanned.triangles).compute_closest_points(points.astype(np.float32))
    normals = unit_vectors(facets["primitive_normals"].numpy().astype(float))
    near = cKDTree(points).query_ball_point(elements.positions, radius_m)
    element = np.repeat(np.arange(count), [len(some) for some in near])
    point = np.concatenate([np.asarray(some, int) for some in near])
    cosine = (normals[point] * elements.normals[element]).sum(axis=1)
    kept = elements.on_object[element] & (cosine > 0.0)
    shape = count, len(points)
    weights = scipy.sparse.csr_array((cosine[kept], (element[kept], point[kept])), shape=shape)
    # A point in a groove is hidden from a viewer along the mean normal of the surrounding elements.
    scene = ray_scene(whole.vertices, whole.triangles)
    visible = unoccluded(scene, points + lift_m * normals, weights.T @ elements.normals)
    weights = weights @ scipy.sparse.diags_array(visible.astype(float))
    # Elements without a point, and those of the support, represent themselves.
    alone = weights.sum(axis=1) <= 0.0
    weights = scipy.sparse.hstack([weights, scipy.sparse.diags_array(alone.astype(float))], format="csr")
    weights.eliminate_zeros()
    used = weights.sum(axis=0) > 0.0
    weights = scipy.sparse.csr_array(scipy.sparse.diags_array(1.0 / weights.sum(axis=1)) @ weights[:, used])
    normals = np.concatenate([smooth_normals(scanned, points, ROUGHNESS_M, normals), elements.normals])
    return np.concatenate([points, elements.positions])[used], normals[used], weights


def smooth_normals(
    mesh: Mesh,
    positions: Float[np.ndarray, "n 3"],
    radius_m: float,
    own: Float[np.ndarray, "n 3"] | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Outward unit normals at points of a mesh: area-weighted means over its vertices within a radius.

    Args:
        mesh: the surface.
        positions: points on it.
        radius_m: of the vertices around each point.
        own: normals of the points' facets; the other side of a leaf is left out. All vertices by default.
    """
    tree, vertices = cKDTree(mesh.vertices), mesh.area_weighted_normals()
    nearest = tree.query(positions)[1]
    sums = vertices[nearest]
    if own is not None:
        sums = np.where((sums * own).sum(axis=1, keepdims=True) > 0.0, sums, own)
    for row, near in enumerate(tree.query_ball_point(positions, radius_m)):
        around = vertices[near]
        if own is not None:
            around = around[around @ own[row] > 0.0]
        if len(around):
            sums[row] = around.sum(axis=0)
    return unit_vectors(sums)


def _nearest(
    mesh: Mesh, positions: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Int[np.ndarray, "t"]:
    """The element that each triangle belongs to: near it, and facing the same way."""
    right_angle_m = NORMAL_WEIGHT * np.sqrt(mesh.area_m2() / len(positions) / 2.0)
    middles = mesh.vertices[mesh.triangles].mean(axis=1)
    tree = cKDTree(np.concatenate([positions, right_angle_m * normals], axis=1))
    return tree.query(np.concatenate([middles, right_angle_m * mesh.facet_normals()], axis=1))[1]


def support_mesh(container_m: tuple[float, float] | None, disc_radius_m: float) -> Mesh:
    """The disc in z = 0, around the container if there is one, and the container's side and lid.

    Args:
        container_m: its diameter and height.
        disc_radius_m: radius of the disc.
    """
    side_m = disc_radius_m / SUPPORT_SIDES
    inner_m = 0.0 if container_m is None else container_m[0] / 2.0
    profiles = [[(disc_radius_m, 0.0), (inner_m, 0.0)]] if disc_radius_m > inner_m else []
    if container_m is not None:
        profiles += [[(inner_m, 0.0), (inner_m, container_m[1])], [(inner_m, container_m[1]), (0.0, container_m[1])]]
    vertices, triangles, count = [], [], 0
    for start, end in np.array(profiles):
        rings = max(1, int(np.ceil(np.linalg.norm(end - start) / side_m)))
        segments = max(8, int(np.ceil(2.0 * np.pi * max(start[0], end[0]) / side_m)))
        radius, height = (start + np.linspace(0.0, 1.0, rings + 1)[:, None] * (end - start)).T
        azimuth = 2.0 * np.pi * np.arange(segments) / segments
        ring = [radius[:, None] * np.cos(azimuth), radius[:, None] * np.sin(azimuth)]
        vertices.append(np.stack([*ring, np.broadcast_to(height[:, None], ring[0].shape)], axis=-1).reshape(-1, 3))
        a = count + (segments * np.arange(rings)[:, None] + np.arange(segments)).ravel()
        b = count + (segments * np.arange(rings)[:, None] + (np.arange(segments) + 1) % segments).ravel()
        triangles += [np.stack([a, b, b + segments], axis=1), np.stack([a, b + segments, a + segments], axis=1)]
        count += len(vertices[-1])
    if not vertices:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    mesh = Mesh(np.concatenate(vertices), np.concatenate(triangles))
    # The lid's and disc's inmost ring may be a point.
    return Mesh(mesh.vertices, mesh.triangles[mesh.triangle_areas_m2() > 0.0])


def observe_elements(
    elements: Elements,
    camera_to_world: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    distortion: tuple[float, float, float, float],
    masks: Bool[np.ndarray, "frames lines samples"],
    pixels: Pixels,
    lift_m: float,
) -> ElementViews:
    """Measurements of the visible elements in the frames, interpolated between four pixels.

    Either all four pixels belong to the object or none does.

    Args:
        elements: on the object and its support.
        camera_to_world: poses, OpenGL axes, metres.
        intrinsics: intrinsics of the camera.
        distortion: k1, k2, p1, p2 (OpenCV).
        masks: pixels of the object.
        pixels: reads reflectance.
        lift_m: distance of the origins of lines of sight from the surface.
    """
    scene = ray_scene(elements.occluders.vertices, elements.occluders.triangles)
    starts = elements.positions + lift_m * elements.normals
    least = np.where(elements.on_object, LARGEST_INCIDENCE_DEG, LARGEST_INCIDENCE_OF_SUPPORT_DEG)
    least = np.cos(np.deg2rad(least))
    found: list[tuple[np.ndarray, ...]] = []
    for frame, pose in enumerate(camera_to_world):
        sight = unit_vectors(pose[:3, 3] - elements.positions)
        in_camera = torch.from_numpy((elements.positions - pose[:3, 3]) @ pose[:3, :3])
        xy, forward = image_coordinates(in_camera, intrinsics, distortion)
        # Pixel centres lie at half numbers.
        corner = np.floor(xy.numpy() - 0.5)
        inside = (corner >= 0.0).all(axis=1) & (corner < [intrinsics.w - 1, intrinsics.h - 1]).all(axis=1)
        seen = np.flatnonzero((np.einsum("nk,nk->n", elements.normals, sight) > least) & inside & forward.numpy())
        seen = seen[unoccluded(scene, starts[seen], sight[seen])]
        sample, line = corner[seen].astype(int).T
        part = xy.numpy()[seen] - 0.5 - corner[seen]
        value, of_object, across, along = 0.0, [], 0.0, 0.0
        for down in (0, 1):
            for right in (0, 1):
                weight_across, weight_along = np.abs(1 - right - part[:, 0]), np.abs(1 - down - part[:, 1])
                pixel = pixels(frame, line + down, sample + right)
                value = value + (weight_across * weight_along)[:, None] * pixel
                across = across + (2 * right - 1) * weight_along * pixel.mean(axis=1)
                along = along + (2 * down - 1) * weight_across * pixel.mean(axis=1)
                of_object.append(masks[frame, line + down, sample + right])
        on = elements.on_object[seen]
        whole = np.where(on, np.all(of_object, axis=0), ~np.any(of_object, axis=0))
        whole &= np.isfinite(np.asarray(value)).all(axis=1)
        value = np.asarray(value)[whole]
        std = MISPLACED_PX * np.hypot(across, along)[whole] / np.maximum(value.mean(axis=1), SMALLEST)
        seen, shows_light = seen[whole], elements.shows_light[seen[whole]]
        level = np.flatnonzero(shows_light & ~elements.on_object[seen])
        shows_light[level] = _shown_alone(scene, elements.positions[seen[level]], pose, intrinsics)
        found.append((seen, np.full(len(value), frame), value, elements.on_object[seen], shows_light, std))
    return ElementViews(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _shown_alone(
    scene: RaycastingScene,
    positions: Float[np.ndarray, "n 3"],
    camera_to_world: Float[np.ndarray, "4 4"],
    intrinsics: PinholeIntrinsics,
) -> Bool[np.ndarray, "n"]:
    """Whether a frame shows points of a level surface with nothing else within `EDGE_PX`."""
    eye, rotation = camera_to_world[:3, 3], camera_to_world[:3, :3]
    sight = (positions - eye) @ rotation
    beside = EDGE_PX * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    beside = np.pad(beside / [intrinsics.fl_x, intrinsics.fl_y], ((0, 0), (0, 1)))
    along = (sight[:, None] / -sight[:, None, 2:] + beside) @ rotation.T
    rays = np.concatenate([np.broadcast_to(eye, along.shape), along], axis=-1).astype(np.float32)
    heights = eye[2] + scene.cast_rays(rays)["t_hit"].numpy() * along[..., 2]
    return (np.abs(heights - positions[:, 2:]) < SAME_HEIGHT_M).all(axis=1)
