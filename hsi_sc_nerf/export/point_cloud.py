"""Points on the object's surface with their spectra, from a trained model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.surface import opacity_crossing_depth
from hsi_sc_nerf.models.spectral_model import SpectralModel

MIN_OPACITY = 0.5
"""Rays that collect less than this hit no surface (released settings of the paper)."""
SURFACE_OPACITY = 0.25
"""The surface is where a ray has collected this much. Other views keep the space outside the object empty, so the
density begins at the true surface; how far into the object a ray reaches before it is half absorbed says how long the
model was trained. On the demo's pear, half the opacity lies 1.5 mm below the true surface, a quarter 0.3 mm."""
SEARCH_DEPTH = 0.1
"""The surface is sought this far around the median depth, scene units (about a centimetre)."""
SEARCH_STEPS = 40
_MAX_FRUITLESS_BATCHES = 50


@dataclass(eq=False)
class SurfacePoints:
    """Points of the surface, in scene units or metres as the function that returns them says.

    Attributes:
        points: positions.
        normals: unit vectors out of the surface.
        colours: pseudo-RGB.
        spectra: reflectance.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    spectra: Float[np.ndarray, "n bands"]

    def select(self, keep: np.ndarray) -> SurfacePoints:
        """The points that an index or boolean array selects."""
        return SurfacePoints(self.points[keep], self.normals[keep], self.colours[keep], self.spectra[keep])


def sample_surface_points(
    model: SpectralModel,
    cameras: Cameras,
    masks: Bool[np.ndarray, "frames lines samples"],
    num_points: int,
    rays_per_batch: int,
    box: Float[torch.Tensor, "2 3"],
    seed: int = 0,
) -> SurfacePoints:
    """Shoot rays through random places of the foreground and keep where they meet the surface (scene units).

    Args:
        model: trained model, in evaluation mode.
        cameras: the training cameras.
        masks: foreground of each camera's frame.
        num_points: how many points to return.
        rays_per_batch: rays rendered at a time.
        box: only points inside this box (scene units) are kept: it cuts the container away.
        seed: of the random places.

    Raises:
        InputError: the rays meet no surface, so the model holds no object.
    """
    rng = np.random.default_rng(seed)
    foreground = np.flatnonzero(masks)
    kept: list[SurfacePoints] = []
    found = fruitless = 0
    with Progress(
        TextColumn("[bold]sampling the surface"),
        BarColumn(),
        TextColumn("{task.completed:,.0f} of {task.total:,.0f} points"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    ) as progress:
        task = progress.add_task("", total=num_points)
        while found < num_points:
            chosen = rng.choice(foreground, min(rays_per_batch, model.config.eval_num_rays_per_chunk))
            rays = _rays_through(cameras, np.stack(np.unravel_index(chosen, masks.shape), axis=1), rng)
            batch = _surface_of_rays(model, rays.to(model.device), box.to(model.device))
            kept.append(batch)
            found += len(batch.points)
            fruitless = 0 if len(batch.points) else fruitless + 1
            if fruitless >= _MAX_FRUITLESS_BATCHES:
                raise InputError(
                    "the model holds no object: no ray through the foreground reaches an opacity of "
                    f"{MIN_OPACITY}; train longer, and look at the masks in the dataset's report folder."
                )
            progress.update(task, completed=min(found, num_points))
    joined = SurfacePoints(*(np.concatenate(parts) for parts in zip(*(vars(b).values() for b in kept), strict=True)))
    return joined.select(np.arange(num_points))


def _rays_through(cameras: Cameras, pixels: np.ndarray, rng: np.random.Generator) -> RayBundle:
    """Rays through a random place inside each (frame, line, sample) pixel."""
    places = pixels[:, 1:] + rng.random((len(pixels), 2))
    return cameras.generate_rays(
        camera_indices=torch.from_numpy(pixels[:, :1]), coords=torch.from_numpy(places).float()
    )


def _surface_depth(
    model: SpectralModel, rays: RayBundle, median_depth: Float[torch.Tensor, "n 1"]
) -> Float[torch.Tensor, "n 1"]:
    """Depth of the surface, sought in fine steps around the median depth of the rendering."""
    offsets = torch.linspace(-SEARCH_DEPTH, SEARCH_DEPTH, SEARCH_STEPS + 1, device=median_depth.device)
    edges = (median_depth + offsets).clamp_min(0.0)
    middles = (edges[:, 1:] + edges[:, :-1]) / 2.0
    positions = rays.origins[:, None] + rays.directions[:, None] * middles[..., None]
    densities = model.field.density_fn(positions)[..., 0]
    return opacity_crossing_depth(edges, densities, SURFACE_OPACITY)[:, None]


@torch.no_grad()
def _surface_of_rays(model: SpectralModel, rays: RayBundle, box: Float[torch.Tensor, "2 3"]) -> SurfacePoints:
    """The surface points that rays hit inside the box."""
    background = model.spectra_behind(rays)  # before the model corrects the rays
    outputs = model(rays)
    points = rays.origins + rays.directions * _surface_depth(model, rays, outputs["depth"])
    opacity = outputs["accumulation"]
    hit = (opacity[:, 0] > MIN_OPACITY) & ((points > box[0]) & (points < box[1])).all(dim=-1)
    points, opacity = points[hit], opacity[hit]
    # What the ray collected beside the background's share is the object's own spectrum.
    spectra = ((outputs["spectral"][hit] - background[hit] * (1.0 - opacity)) / opacity).clamp(0.0, 1.0)
    normals = -torch.nn.functional.normalize(model.field.density_gradient(points), dim=-1)
    facing = (normals * rays.directions[hit]).sum(dim=-1, keepdim=True) <= 0
    return SurfacePoints(
        points=points.cpu().numpy(),
        normals=torch.where(facing, normals, -normals).cpu().numpy(),
        colours=(spectra[:, model.rgb_bands] * 255.0).round().byte().cpu().numpy(),
        spectra=spectra.cpu().numpy(),
    )
