"""Spectra at the points of any PLY file, a cloud or a mesh, rendered from the training cameras that see them.

Spectra depend on the viewing direction, and the model knows only the directions that it was trained on; no camera
looked along the normal of an upward face. So each point gets the mean spectrum over its most frontal training
cameras, at less than ``MAX_INCIDENCE_DEG``. Only rays that end at the point count, not those that end at an occluder
before it or behind it. Everything else in the file is kept, but for columns that another run measured.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import RayBundle
from plyfile import PlyData

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.comparison import read_surface
from hsi_sc_nerf.export.cloud import (
    COLOURS,
    LIGHT_COLUMNS,
    MAX_INCIDENCE_DEG,
    NORMALS,
    band_property_names,
    comment_lines,
    estimate_normals,
    is_of_a_run,
    own_name,
)
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.geometry.camera import pixels_of, unit_vectors
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.geometry.ply_file import ply_vertices, read_ply
from hsi_sc_nerf.light.stationary_light import even_directions
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.spectra import to_8_bit
from hsi_sc_nerf.surface.surface_depth import MIN_OPACITY, render_object, rendered_density, surface_depth
from hsi_sc_nerf.terminal import progress_bar

BATCH_POINTS = 1 << 12
_RADII, _DIRECTIONS = (0.02, 0.05), 64
"""Spheres on which a point's normal is found, about 2 and 5 mm, and how many places of each are looked at."""
_NO_SPECTRUM_GREY = 64
"""Colour of points without a spectrum, if the file has no colours of its own."""


@dataclass(frozen=True, eq=False)
class PointSpectra:
    """Spectra of points over the training cameras that see them.

    Attributes:
        normals: the points' normals, outward.
        spectra: mean reflectance over the views; NaN without a view.
        spectral_std: standard deviation over the views, averaged over the bands; NaN with fewer than two views.
        views: number of views.
    """

    normals: Float[np.ndarray, "n 3"]
    spectra: Float[np.ndarray, "n bands"]
    spectral_std: Float[np.ndarray, "n"]
    views: Float[np.ndarray, "n"]


def sample_points(
    run: TrainedRun,
    points_m: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None,
    max_distance_m: float,
    max_views: int,
) -> PointSpectra:
    """Spectra of points. Lens distortion is neglected when selecting the images that hold a point.

    Args:
        points_m: object frame, metres.
        normals: unit vectors, to either side of the surface; 0 for a point that gets no spectrum. None: those of the
            density around each point (`normals_of_density`).
        max_distance_m: largest distance of a point from the model's surface, along its normal.
        max_views: number of training cameras to average over, at most.

    Example:
        >>> run, points = open_trained_run(Path("config.yml")), read_points(Path("scan.ply"))
        >>> found = sample_points(run, points.positions, points.normals(), max_distance_m=0.003, max_views=4)
        >>> found.spectra.shape
        (80000, 204)
    """
    frames = run.manager.train_dataparser_outputs.metadata["turntable"]["frame_indices"]
    poses = run.refined_poses_m()[frames]
    poses[:, :3, 3] = run.to_scene(poses[:, :3, 3])
    max_distance = max_distance_m * run.scale
    points = run.to_scene(points_m)

    @torch.no_grad()
    def density(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 1"]:
        parts = torch.from_numpy(positions).float().to(run.model.device)[:, None].split(BATCH_POINTS)
        return torch.cat([rendered_density(run.model, part)[:, 0] for part in parts]).cpu().numpy()

    if normals is None:
        outward = normals_of_density(points, density, run.to_scene(run.dataset.object_box_m)[0, 2])
    else:
        outward = outward_normals(normals, points, density, max_distance)
    count, bands = len(points), len(run.model.wavelengths_nm)
    result = PointSpectra(outward, np.empty((count, bands), np.float32), *np.zeros((2, count), np.float32))
    with progress_bar("sampling", "points", count) as update:
        for start in range(0, count, BATCH_POINTS):
            rows = slice(start, start + BATCH_POINTS)
            views = _render_views(run, poses, points[rows], outward[rows], max_distance, max_views)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of points without a view
                result.spectra[rows] = np.nanmean(views, axis=1)
                result.spectral_std[rows] = np.nanstd(views, axis=1, ddof=1).mean(axis=1)
            result.views[rows] = np.isfinite(views[..., 0]).sum(axis=1)
            update(min(rows.stop, count))
    return result


def outward_normals(
    normals: Float[np.ndarray, "n 3"],
    points: Float[np.ndarray, "n 3"],
    density: Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 1"]],
    distance: float,
) -> Float[np.ndarray, "n 3"]:
    """Normals turned to the side with the lower density at ``distance``; unchanged where both sides are alike.

    The normals of a file may point inwards, or to either side.
    """
    inside, outside = density(points - distance * normals), density(points + distance * normals)
    return np.where(outside > inside, -normals, normals)


def normals_of_density(
    points: Float[np.ndarray, "n 3"],
    density: Callable[[Float[np.ndarray, "m 3"]], Float[np.ndarray, "m 1"]],
    base: float,
) -> Float[np.ndarray, "n 3"]:
    """Outward unit normals: away from what is opaque on spheres around each point; 0 where nothing differs.

    The gradient at the point itself is too rough: a trained density changes from place to place inside of a surface.
    The larger sphere meets a surface that the point does not lie on. What is lower than ``base``, the object's lowest
    height, counts for points down there only: to the object's own, its support is no part of it. Scene units.
    """
    of_support = points[:, 2:] < base - _RADII[0]
    normals = np.zeros(points.shape)
    for radius in _RADII:
        for direction in even_directions(_DIRECTIONS):
            at = points + radius * direction
            counts = of_support | (at[:, 2:] >= base)
            normals += direction * np.expm1(-_RADII[0] * density(at)) * counts
    return unit_vectors(normals)


def frontal_views(
    cosines: Float[np.ndarray, "n cameras"], in_frame: Bool[np.ndarray, "n cameras"]
) -> tuple[Int[np.ndarray, "n cameras"], Bool[np.ndarray, "n cameras"]]:
    """The cameras of each point, the most frontal first, and which of them the point faces, the first ones."""
    ranked = np.where(in_frame, cosines, -1.0)
    cameras = np.argsort(-ranked, axis=1)
    return cameras, np.take_along_axis(ranked, cameras, axis=1) > np.cos(np.deg2rad(MAX_INCIDENCE_DEG))


def first_hits(
    facing: Bool[np.ndarray, "n cameras"],
    count: int,
    render: Callable[[Int[np.ndarray, "rays"], Int[np.ndarray, "rays"]], Float[np.ndarray, "rays bands"]],
    bands: int,
) -> Float[np.ndarray, "n count bands"]:
    """Spectra of each point in the first ``count`` of its cameras that see it; NaN where there are fewer.

    An occluder hides a point from cameras that it faces, which only a rendered ray tells. So as many cameras of a
    point are rendered as it still needs, until it has enough or none is left.

    Args:
        facing: cameras to try, in this order.
        render: spectra of points in their cameras of a rank; NaN where the camera does not see the point.
    """
    spectra = np.full((len(facing), count, bands), np.nan, np.float32)
    found, tried = np.zeros((2, len(facing)), int)
    ranks = np.arange(facing.shape[1])
    while True:
        until = tried + count - found
        point, rank = np.nonzero(facing & (ranks >= tried[:, None]) & (ranks < until[:, None]))
        if len(point) == 0:
            return spectra
        rendered = render(point, rank)
        hit = np.isfinite(rendered[:, 0])
        point, rendered, tried = point[hit], rendered[hit], until
        spectra[point, found[point] + np.arange(len(point)) - np.searchsorted(point, point)] = rendered
        found += np.bincount(point, minlength=len(facing))


@torch.no_grad()
def _render_views(
    run: TrainedRun,
    poses: Float[np.ndarray, "cameras 4 4"],
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    max_distance: float,
    max_views: int,
) -> Float[np.ndarray, "n views bands"]:
    """Spectra of points in the most frontal cameras that see them. Scene units."""
    model, intrinsics = run.model, run.dataset.intrinsics
    to_point = points[:, None] - poses[:, :3, 3]
    distances = np.linalg.norm(to_point, axis=-1)
    directions = to_point / distances[..., None]
    cosines = -np.einsum("nk,nck->nc", normals, directions)
    in_frame = np.stack([pixels_of(points, pose, intrinsics)[0] for pose in poses], axis=1)
    cameras, facing = frontal_views(cosines, in_frame)
    bands, chunk = len(model.wavelengths_nm), model.config.eval_num_rays_per_chunk

    def render(point: Int[np.ndarray, "rays"], rank: Int[np.ndarray, "rays"]) -> Float[np.ndarray, "rays bands"]:
        spectra = np.full((len(point), bands), np.nan, np.float32)
        for start in range(0, len(point), chunk):
            p = point[start : start + chunk]
            c = cameras[p, rank[start : start + chunk]]
            rendered, opacity, depth = _render_rays(model, poses[c, :3, 3], directions[p, c], cosines[p, c])
            hit = (opacity > MIN_OPACITY) & (np.abs(depth - distances[p, c]) * cosines[p, c] <= max_distance)
            spectra[start : start + chunk][hit] = rendered[hit]
        return spectra

    return first_hits(facing, min(max_views, len(poses)), render, bands)


def _render_rays(
    model: SpectralModel,
    origins: Float[np.ndarray, "rays 3"],
    directions: Float[np.ndarray, "rays 3"],
    cosines: Float[np.ndarray, "rays"],
) -> tuple[Float[np.ndarray, "rays bands"], Float[np.ndarray, "rays"], Float[np.ndarray, "rays"]]:
    """The object's spectrum along rays with unit directions, without the background's; opacity; surface depth."""
    ones = torch.ones(len(origins), 1)
    rays = RayBundle(
        origins=torch.from_numpy(origins).float(),
        directions=torch.from_numpy(directions).float(),
        pixel_area=ones,
        camera_indices=torch.zeros_like(ones, dtype=torch.long),
        metadata={"directions_norm": ones},
    ).to(model.device)
    outputs, spectra = render_object(model, rays)
    ray_cosines = torch.from_numpy(cosines[:, None]).to(rays.origins)
    depth, _ = surface_depth(model, rays.origins, rays.directions, outputs["depth"], ray_cosines)
    return spectra.cpu().numpy(), outputs["accumulation"][:, 0].cpu().numpy(), depth[:, 0].cpu().numpy()


@dataclass(frozen=True, eq=False)
class PlyPoints:
    """A PLY file with points.

    Attributes:
        content: all of its elements.
        positions: positions of the points, in the file's unit.
        triangles: triangles of a mesh; none for a cloud.
    """

    content: PlyData
    positions: Float[np.ndarray, "n 3"]
    triangles: Int[np.ndarray, "t 3"]

    def normals(self) -> Float[np.ndarray, "n 3"]:
        """Unit normals, to either side: the file's, or else of the faces, or else of neighbouring points.

        They are 0 for a point without one, such as a vertex of no face.
        """
        if len(self.triangles) and not self.has(NORMALS):
            return Mesh(self.positions, self.triangles).vertex_normals()
        if not self.has(NORMALS):
            return estimate_normals(self.positions)
        normals = np.stack([np.asarray(self.content["vertex"][name], float) for name in NORMALS], axis=1)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)

    def has(self, names: tuple[str, ...]) -> bool:
        """Whether the points have properties of these names."""
        return set(names) <= set(self.content["vertex"].data.dtype.names)


def read_points(path: Path) -> PlyPoints:
    """Read a PLY file of any kind: ASCII or binary, with or without faces.

    Raises:
        InputError: the file is missing, is no PLY, has no points, or its points hold lists or are not finite.
    """
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: is not a PLY file; export the cloud or mesh as PLY.")
    positions, triangles = read_surface(path)
    return PlyPoints(read_ply(path), positions, triangles)


def write_sampled_ply(
    path: Path,
    points: PlyPoints,
    found: PointSpectra,
    wavelengths_nm: Float[np.ndarray, "bands"],
    rgb_bands: list[int],
    run: str,
    material: tuple[Float[np.ndarray, "n bands"], Float[np.ndarray, "n"]] | None = None,
    metric: bool = True,
) -> None:
    """Write a file with the spectra of its points as binary PLY, and normals and pseudo-RGB if it has none.

    All else in the file is kept, but for the columns that a run had measured, such as those of the material: beside
    the new spectra they would be taken for theirs.

    Its comments state ``run``, the name of the run, and what the new columns mean. ``material`` is the reflectance of
    the material, and the relative standard deviation of the light (`CloudMaterial.at`), ``metric`` whether the run's
    lengths are metres.

    Raises:
        InputError: the file cannot be written.
    """
    content, vertices = points.content, points.content["vertex"].data
    columns = dict(zip(band_property_names(wavelengths_nm), found.spectra.T, strict=True))
    columns |= {"sampled_views": found.views, "sampled_std": found.spectral_std}
    if material is not None:
        spectra, relative_std = material
        with np.errstate(divide="ignore", invalid="ignore"):
            irradiance = found.spectra.mean(axis=1) / spectra.mean(axis=1)
        names = [*band_property_names(wavelengths_nm, "material"), *LIGHT_COLUMNS]
        columns |= zip(names, [*spectra.T, irradiance, relative_std * irradiance], strict=True)
    if not points.has(NORMALS):
        columns |= zip(NORMALS, found.normals.T.astype(np.float32), strict=True)
    if not points.has(COLOURS):
        colours = found.spectra[:, rgb_bands]
        known = np.isfinite(colours)
        colours = np.where(known, to_8_bit(np.where(known, colours, 0.0)), np.uint8(_NO_SPECTRUM_GREY))
        columns |= zip(COLOURS, colours.T, strict=True)
    earlier = [name for name in vertices.dtype.names if is_of_a_run(name)]
    kept = {name: vertices[name] for name in vertices.dtype.names if name not in (*columns, *earlier)}
    vertex = ply_vertices(kept | columns)
    elements = [vertex if element.name == "vertex" else element for element in content.elements]
    added = comment_lines([name for name in columns if name not in ("x", "y", "z")], run, metric)
    of_file = content.comments
    if earlier:
        outdated = comment_lines(map(own_name, earlier))
        of_file = [line for line in of_file if line not in outdated and not line.startswith(("run: ", "scale: "))]
    comments = [*of_file, *(line for line in added if line not in of_file)]
    with atomic_write(path) as (temporary,):
        file = PlyData(elements, byte_order="<", comments=comments, obj_info=content.obj_info)
        file.write(str(temporary))
