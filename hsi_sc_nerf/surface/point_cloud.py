"""Points on the object's surface, evenly spread over it, from a trained model; all lengths in scene units.

The training frames' depth maps make a mesh. Places that are spread evenly over its area are moved,
each along the ray of the frame that sees it most from the front, to where the model has its surface; what no frame
sees is left out. The spectrum of a point is that ray's: seen from the front, as the white reference was.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor
from torch.nn import functional

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.progress import progress_bar
from hsi_sc_nerf.surface.depth_renders import (
    MIN_OPACITY,
    SEARCH_DEPTH,
    SEARCH_STEPS,
    SeenSurface,
    camera_rays,
    look_from_cameras,
    model_output,
    render_object,
    surface_along,
)
from hsi_sc_nerf.surface.even_points import even_points
from hsi_sc_nerf.surface.regions import EVERYWHERE, Region, in_box
from hsi_sc_nerf.surface.surface_mesh import SurfaceMesh, fuse_depth_maps
from hsi_sc_nerf.surface.visibility import DepthMaps, most_frontal

FARTHEST_MOVE = 0.02
"""Places are moved on to the surface by no more than this along their normal, scene units (about 2 mm)."""


@dataclass(eq=False)
class SurfacePoints:
    """Points of the surface, and how the training frames see them.

    Attributes:
        points: positions, scene units.
        facing: unit normals of the mesh that the points were spread on, outwards.
        frames: the training frame that sees each most from the front.
        places: where it is in that frame's picture, (x, y) in pixels from its corner.
        incidence_deg: angle between its normal and the way to that frame's camera.
    """

    points: Float[np.ndarray, "n 3"]
    facing: Float[np.ndarray, "n 3"]
    frames: Int[np.ndarray, "n"]
    places: Float[np.ndarray, "n 2"]
    incidence_deg: Float[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, keep: np.ndarray | slice) -> SurfacePoints:
        """The points that a slice, an index or a boolean array selects."""
        return SurfacePoints(*(getattr(self, field.name)[keep] for field in fields(self)))


def join(parts: list[SurfacePoints]) -> SurfacePoints:
    """The points of all parts, in their order."""
    return SurfacePoints(
        *(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(SurfacePoints))
    )


def spread_points(
    model: SpectralModel,
    seen: SeenSurface,
    num_points: int,
    rays_per_batch: int,
    box: Float[np.ndarray, "2 3"],
    region: Region,
    seed: int = 0,
) -> SurfacePoints:
    """Points spread evenly over the surface that at least one training frame sees.

    Args:
        model: trained model, in evaluation mode.
        seen: what its training cameras see.
        num_points: how many points to return; fewer come where hardly anything of the surface is wanted.
        rays_per_batch: rays searched at a time.
        box: the surface is sought in this box, scene units: it cuts the container away.
        region: which points are wanted.
        seed: of the random places.

    Raises:
        InputError: the model holds no object, or nothing of it is wanted.
    """
    mesh = fuse_depth_maps(seen.maps, seen.points[in_box(seen.points, box)], box)
    if mesh is None:
        raise InputError(
            f"the model holds no object: no ray through the foreground reaches an opacity of {MIN_OPACITY}; train "
            "longer, and look at the masks in the dataset's report folder."
        )

    placed = 0

    def keep(places: Float[np.ndarray, "n 3"]) -> SurfacePoints:
        nonlocal placed
        parts = []
        for start in range(0, len(places), rays_per_batch):
            moved = _moved_to_surface(model, seen.maps, mesh, places[start : start + rays_per_batch])
            parts.append(moved.select(in_box(moved.points, box) & region.holds(moved.points, moved.facing)))
            placed += len(parts[-1])
            done(placed)
        return join(parts)

    with progress_bar("spreading points", "points", num_points) as done:
        # An oblique ray moves a place by more than FARTHEST_MOVE, but no farther than it is searched.
        triangles = mesh.triangles_near(region.bounds, SEARCH_DEPTH)
        found = even_points(mesh.vertices, triangles, num_points, keep, seed)
    if not found:
        raise InputError("no point of the object lies in the region that was asked for; make it larger.")
    return join(found)


@torch.no_grad()
def _moved_to_surface(
    model: SpectralModel, maps: DepthMaps, mesh: SurfaceMesh, places: Float[np.ndarray, "n 3"]
) -> SurfacePoints:
    """Places near the surface, moved on to it along the rays that see them from the front; the others left out."""
    points = torch.from_numpy(places).float().to(model.device)
    facing = mesh.normals_at(places)
    frames, pixels, cosines = most_frontal(maps, points, torch.from_numpy(facing).to(points))
    chosen = frames >= 0
    points, frames, pixels, cosines = points[chosen], frames[chosen], pixels[chosen], cosines[chosen, None]
    origins = maps.camera_to_world[frames, :3, 3]
    away = points - origins
    distances = away.norm(dim=-1, keepdim=True)
    directions = away / distances
    depth, opacity = surface_along(model, origins, directions, distances, cosines)
    # What lies farther away is another part of the surface, which has its own places; and what is dense from the
    # search's start on has its surface before it.
    moved = (depth - distances).abs()
    near = (moved * cosines < FARTHEST_MOVE) & (moved < SEARCH_DEPTH * (1.0 - 2.0 / SEARCH_STEPS))
    met = ((opacity > MIN_OPACITY) & near)[:, 0]
    found = (origins + directions * depth)[met]
    return SurfacePoints(
        found.cpu().numpy(),
        facing[chosen.cpu().numpy()][met.cpu().numpy()],
        frames[met].cpu().numpy(),
        pixels[met].cpu().numpy(),
        torch.rad2deg(cosines[met, 0].clamp_max(1.0).arccos()).cpu().numpy(),
    )


@dataclass(frozen=True, eq=False)
class RenderedPoints:
    """What the rays see that end at points of the surface.

    Attributes:
        spectra: reflectance, without the background's share.
        opacity: what the rays collect, in [0, 1].
        colours: red, green, blue in [0, 1].
        normals: unit vectors.
    """

    spectra: Float[Tensor, "n bands"]
    opacity: Float[Tensor, "n"]
    colours: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]


@torch.no_grad()
def render_points(
    model: SpectralModel,
    cameras: Cameras,
    cloud: SurfacePoints,
    rgb_output_name: str = "rgb",
    normal_output_name: str = "normals",
    reorient_normals: bool = True,
) -> RenderedPoints:
    """Render the ray of each point.

    Args:
        model: trained model, in evaluation mode.
        cameras: the training cameras.
        cloud: points of the surface.
        rgb_output_name: the output shown as colours; ``rgb`` is three bands of the spectra.
        normal_output_name: ``normals`` are those of the density, other names the model's outputs.
        reorient_normals: turn the normals to the side that the ray comes from.

    Raises:
        InputError: the model has no such output.
    """
    rays = camera_rays(cameras, cloud.frames, cloud.places, model.device)
    outputs, spectra = render_object(model, rays)
    if rgb_output_name == "rgb":
        colours = spectra[:, model.rgb_bands]
    else:
        colours = model_output(outputs, rgb_output_name, "rgb")
        if colours.shape[1:] != (3,):
            raise InputError(f"--rgb-output-name {rgb_output_name}: is no picture of red, green and blue; take rgb.")
    if normal_output_name == "normals":
        points = torch.from_numpy(cloud.points).float().to(model.device)
        normals = -functional.normalize(model.field.density_gradient(points), dim=-1)
    else:
        # The model's outputs are pictures: -1 to 1 is shown as 0 to 1.
        normals = functional.normalize(2.0 * model_output(outputs, normal_output_name, "normal") - 1.0, dim=-1)
    if reorient_normals:
        away = (normals * rays.directions).sum(dim=-1, keepdim=True) > 0.0
        normals = torch.where(away, -normals, normals)
    return RenderedPoints(spectra, outputs["accumulation"][:, 0], colours.clamp(0.0, 1.0), normals)


def sample_surface_points(
    model: SpectralModel,
    cameras: Cameras,
    masks: Bool[np.ndarray, "frames lines samples"],
    num_points: int,
    rays_per_batch: int,
    box: Float[Tensor, "2 3"],
    seed: int = 0,
) -> SurfacePoints:
    """`look_from_cameras`, then `spread_points` over all that lies in the box (scene units).

    Raises:
        InputError: the model holds no object.
    """
    seen = look_from_cameras(model, cameras, masks, rays_per_batch)
    return spread_points(model, seen, num_points, rays_per_batch, box.cpu().numpy(), EVERYWHERE, seed)
