"""How the brightness of points on the object changes from view to view and from place to place, before any training.

The points lie on the visual hull of the masks and are looked up in the frames.

A change with the direction that a point faces in the camera's frame comes from light or gloss that is stationary with
the camera. It is fitted together with the brightness of each frame. Each sector of the object is predicted from the
other sectors. So neither noise contributes nor the object's texture, which wrong poses and an inexact hull shift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, project, unit_vectors
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.processing.visual_hull import VotedHull

NORMAL_CELLS = 6
"""Cells of the normals' directions to the right and upwards in the camera's frame."""
MOST_CHANGE = 1.0
"""Relative changes are limited to this: larger ones come from pixels of the chamber in a wrong mask."""
ALIKE = 12
"""Number of points with the most similar spectra that the brightness of a point is compared with."""
_RIDGE = 1e-6
_LEAST_RIDGE = 1e-12
COLOURS = 6
"""Neighbouring bins of bands are averaged to this number of colours."""
MAX_POINTS = 2000
MAX_FRAMES = 60
MAX_INCIDENCE_DEG = 60.0
"""Largest angle at which points are looked up: towards the outline, pixels also cover the chamber."""
OUTLINE_PX = 2
"""Pixels within this of the mask's edge are left out."""
SECTORS = 8
"""Sectors of the object about its axis, of which each can be predicted by the others."""
_SMOOTH_VOXELS = 1.5


@dataclass(frozen=True)
class Change:
    """A change (root mean square), and the standard deviation of its estimate."""

    rms: float
    noise: float


def change_with_direction(views: PointViews) -> Change:
    """Change of points' spectra with the direction that they face, relative to their brightness.

    Example:
        >>> seen = point_views(bins, masks, camera_to_worlds, intrinsics, hull)
        >>> change_with_direction(seen).rms
        0.083
    """
    count, colours = len(views.positions_m), views.reflectance.shape[1]
    brightness = mean_by_index(views.reflectance.mean(axis=1), views.point, count)
    scale = np.maximum(brightness, 1e-3)[views.point]
    kinds = [_indicators(facing_cell(views)), _indicators(views.frame)]
    cells = kinds[0].shape[1]
    shared = np.concatenate(kinds, axis=1)
    shared -= mean_by_index(shared, views.point, count)[views.point]
    products = []
    for colour in range(colours):
        response = views.reflectance[:, colour] / scale
        response -= mean_by_index(response, views.point, count)[views.point]
        response = response.clip(-MOST_CHANGE, MOST_CHANGE)
        products.append([_products(shared[rows], response[rows]) for rows in _rows_of(views.sector[views.point])])
    return _predicted(products, cells)


def change_with_height(views: PointViews) -> Change:
    """Relative change of brightness with height and slope among points of similar spectra.

    It is caused by light from the chamber's walls, by the lid's shade, or by a material whose brightness varies with
    height while its spectrum's shape does not.
    """
    count = len(views.positions_m)
    spectra = mean_by_index(views.reflectance, views.point, count)
    seen = np.unique(views.point)
    spectra = np.maximum(spectra[seen], 1e-4)
    brightness, alike = np.log(spectra.mean(axis=1)), like_spectra(spectra)
    of_points = views.positions_m[seen, 2], views.normals[seen, 2]
    height, slope = (np.searchsorted(np.quantile(values, [1 / 3, 2 / 3]), values) for values in of_points)
    causes = _indicators(3 * height + slope)
    causes = causes - causes[alike].mean(axis=1)
    response = brightness - brightness[alike].mean(axis=1)
    rows = _rows_of(views.sector[seen])
    return _predicted([[_products(causes[part], response[part]) for part in rows]], causes.shape[1])


def like_spectra(spectra: Float[np.ndarray, "n bands"]) -> Int[np.ndarray, "n alike"]:
    """Rows of the `ALIKE` spectra most similar in shape to each spectrum, and its own row."""
    shapes = unit_vectors(spectra)
    return cKDTree(shapes).query(shapes, min(ALIKE + 1, len(shapes)))[1]


def facing_cell(views: PointViews) -> Int[np.ndarray, "n"]:
    """Cell of the normal's direction in the camera's frame."""
    cell = ((views.normal[:, :2] + 1.0) / 2.0 * NORMAL_CELLS).astype(int).clip(0, NORMAL_CELLS - 1)
    return cell[:, 0] * NORMAL_CELLS + cell[:, 1]


def change_of(variances: Sequence[float], sizes: Sequence[int]) -> Change:
    """The change from several independent estimates of its mean square; negative estimates are noise."""
    error = float(np.std(variances, ddof=1) / np.sqrt(len(variances)))
    rms = float(np.sqrt(max(np.average(variances, weights=sizes), 0.0)))
    return Change(rms, float(np.sqrt(error)) if rms**2 <= error else error / (2.0 * rms))


def mean_by_index(values: Float[np.ndarray, "n *k"], index: Int[np.ndarray, "n"], count: int) -> np.ndarray:
    """Mean of the rows of each index; 0 without any."""
    total = np.zeros((count, *values.shape[1:]))
    np.add.at(total, index, values)
    number = np.maximum(np.bincount(index, minlength=count), 1)
    return total / number.reshape(-1, *[1] * (values.ndim - 1))


def _indicators(kind: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n kinds"]:
    return (kind[:, None] == np.unique(kind)).astype(float)


def _rows_of(sector: Int[np.ndarray, "n"]) -> list[np.ndarray]:
    return [np.flatnonzero(sector == number) for number in np.unique(sector)]


def _products(
    causes: Float[np.ndarray, "n k"], response: Float[np.ndarray, "n"]
) -> tuple[np.ndarray, np.ndarray, int]:
    return causes.T @ causes, causes.T @ response, len(response)


def _predicted(products: Sequence[Sequence[tuple[np.ndarray, np.ndarray, int]]], first: int) -> Change:
    """The change explained by the first ``first`` causes in each sector, with effects fitted to the other sectors."""
    explained, sizes = [], []
    for held in range(len(products[0])):
        covariance = 0.0
        for sectors in products:
            square = np.sum([part[0] for k, part in enumerate(sectors) if k != held], axis=0)
            right = np.sum([part[1] for k, part in enumerate(sectors) if k != held], axis=0)
            # Without variation of the causes the matrix is singular.
            ridge = max(_RIDGE * np.trace(square) / len(square), _LEAST_RIDGE) * np.eye(len(square))
            effects = np.linalg.solve(square + ridge, right)
            own_square, own_right, size = sectors[held]
            rest = own_right - own_square[:, first:] @ effects[first:]
            covariance += float(effects[:first] @ rest[:first]) / max(size, 1) / len(products)
        explained.append(covariance)
        sizes.append(size)
    return change_of(explained, sizes)


@dataclass(frozen=True, eq=False)
class PointViews:
    """Points of the object as the frames see them; one row a view of a point.

    Attributes:
        point: number of the point.
        frame: number of the frame.
        normal: normal of the point in the camera's frame: right, up, towards the camera.
        reflectance: by colour.
        positions_m: positions of the points, object frame.
        normals: normals of the points, object frame.
    """

    point: Int[np.ndarray, "n"]
    frame: Int[np.ndarray, "n"]
    normal: Float[np.ndarray, "n 3"]
    reflectance: Float[np.ndarray, "n colours"]
    positions_m: Float[np.ndarray, "points 3"]
    normals: Float[np.ndarray, "points 3"]

    @property
    def sector(self) -> Int[np.ndarray, "points"]:
        """Sector of each point about the object's axis."""
        x, y = (self.positions_m - self.positions_m.mean(axis=0))[:, :2].T
        return np.minimum(((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * SECTORS).astype(int), SECTORS - 1)


def point_views(
    bins: Sequence[Float[np.ndarray, "bins h w"]],
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    distortion: Float[np.ndarray, "4"],
    hull: VotedHull,
) -> PointViews:
    """Look the hull's points up in the frames.

    Args:
        camera_to_worlds: poses, OpenGL axes.
        distortion: k1, k2, p1, p2 (OpenCV).
    """
    distance_m = float(np.linalg.norm(camera_to_worlds[:, :3, 3] - hull.core.mean(axis=0), axis=1).mean())
    # The hull is that of masks which were dilated by this.
    excess_m = (hull.voxel_px - 1) / 2.0 * distance_m / intrinsics.fl_x
    everywhere, normals = _surface(hull, excess_m)
    rng = np.random.default_rng(0)
    lid_m = hull.core[:, 2].min() + 2.0 * hull.sides_m[2]
    chosen = rng.permutation(np.flatnonzero(everywhere[:, 2] > lid_m))[:MAX_POINTS]
    points, normals = everywhere[chosen], normals[chosen]
    found: list[tuple[np.ndarray, ...]] = []
    for frame in range(0, len(masks), -(-len(masks) // MAX_FRAMES)):
        pose = camera_to_worlds[frame]
        pixels, depth = project(points, pose, intrinsics, distortion)
        to_eye = pose[:3, 3] - points
        facing = (normals * to_eye).sum(axis=1) / np.linalg.norm(to_eye, axis=1)
        inside = ~dilate(~masks[frame], 2 * OUTLINE_PX + 1)
        x, y = np.floor(pixels).astype(int).T
        in_image = (x >= 0) & (y >= 0) & (x < intrinsics.w) & (y < intrinsics.h)
        seen = in_image & (facing > np.cos(np.deg2rad(MAX_INCIDENCE_DEG)))
        seen[seen] = inside[y[seen], x[seen]]
        seen &= _nearest(everywhere, points, depth, pose, intrinsics, hull)
        rows = np.flatnonzero(seen)
        at = pixels[rows].T[::-1] - 0.5
        image = colours_of(bins[frame])
        values = np.stack([ndimage.map_coordinates(colour, at, order=1) for colour in image], axis=-1)
        found.append((rows, np.full(len(rows), frame), normals[rows] @ pose[:3, :3], values))
    point, frames, normal, reflectance = map(np.concatenate, zip(*found, strict=True))
    return PointViews(point, frames, normal, reflectance, points, normals)


def _surface(hull: VotedHull, inwards_m: float) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points on the hull's smoothed surface, moved inwards, and their normals."""
    low = hull.core.min(axis=0)
    index = np.rint((hull.core - low) / hull.sides_m).astype(int) + 4
    full = np.zeros(index.max(axis=0) + 5, np.float32)
    full[tuple(index.T)] = 1.0
    border = index[~ndimage.binary_erosion(full)[tuple(index.T)]]
    smooth = ndimage.gaussian_filter(full, _SMOOTH_VOXELS)
    gradient = np.stack([part[tuple(border.T)] for part in np.gradient(smooth)], axis=-1) / hull.sides_m
    steepness = np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)
    normals = -gradient / steepness
    level = (smooth[tuple(border.T)] - 0.5)[:, None] / steepness
    outwards_m = np.clip(level, -hull.sides_m.max(), hull.sides_m.max()) - inwards_m
    return low + (border - 4) * hull.sides_m + outwards_m * normals, normals


def _nearest(
    everywhere: Float[np.ndarray, "m 3"],
    points: Float[np.ndarray, "n 3"],
    depth: Float[np.ndarray, "n"],
    pose: Float[np.ndarray, "4 4"],
    intrinsics: PinholeIntrinsics,
    hull: VotedHull,
) -> Bool[np.ndarray, "n"]:
    """Points that no other part of the surface hides from a camera."""
    cell_px = hull.voxel_px
    shape = (intrinsics.h // cell_px + 1, intrinsics.w // cell_px + 1)

    def cells(seen: Float[np.ndarray, "k 3"]) -> tuple[np.ndarray, np.ndarray]:
        pixels, depths = project(seen, pose, intrinsics)
        column, line = (pixels / cell_px).astype(int).clip(0, (shape[1] - 1, shape[0] - 1)).T
        return line * shape[1] + column, depths

    front = np.full(shape[0] * shape[1], np.inf)
    cell, depths = cells(everywhere)
    np.minimum.at(front, cell, depths)
    # Across a cell, a surface seen obliquely recedes by up to twice its width.
    return depth < front[cells(points)[0]] + 3.0 * float(np.linalg.norm(hull.sides_m))


def colours_of(bins: Float[np.ndarray, "bins h w"]) -> Float[np.ndarray, "colours h w"]:
    """Means of neighbouring bins."""
    parts = np.array_split(np.asarray(bins, np.float32), min(COLOURS, len(bins)))
    return np.stack([part.mean(axis=0) for part in parts])
