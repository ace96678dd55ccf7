"""What the training frames see of a trained model's surface: their rays, poses and depth maps (scene units)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor
from torch.nn import functional

from hsi_sc_nerf.data.cameras import FRAME_INDEX
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.numerics import safe_ratio
from hsi_sc_nerf.progress import progress_bar
from hsi_sc_nerf.surface.crossing import opacity_crossing_depth
from hsi_sc_nerf.surface.visibility import MIN_COSINE, DepthMaps

MIN_OPACITY = 0.5
"""Rays that collect less than this hit no surface (released settings of the paper)."""
SURFACE_OPACITY = 0.07
"""The surface is where a ray from the front has collected this much. Other views keep the space outside the object
empty, so the density begins at the true surface; how far into the object a ray reaches before it is half absorbed
says how long the model was trained (benchmarks/surface_depth.py)."""
WELL_WITHIN = 0.25
"""Where a ray has collected this much, the density rises towards the object; further out its gradient is noise."""
SEARCH_DEPTH = 0.1
"""The surface is sought this far around a depth that is nearly right, scene units (about a centimetre)."""
SEARCH_STEPS = 40
DEPTH_RAYS = 300_000
"""Rays of all depth maps together; where frames have more pixels on the object, cells of several pixels share one."""
CELLS_AROUND = 5
"""Depth maps reach this far beyond the masks."""
_LEAST_OPACITY = 1e-3
_DEPTH_TOLERANCE = 0.02
"""Scene units: about 2 mm."""


@torch.no_grad()
def refined_poses(model: SpectralModel, cameras: Cameras) -> Float[Tensor, "frames 4 4"]:
    """Camera-to-world of training cameras as training has refined them, scene units."""
    poses = torch.eye(4).repeat(len(cameras), 1, 1)
    poses[:, :3] = cameras.camera_to_worlds.cpu()
    assert cameras.metadata is not None
    frames = cameras.metadata[FRAME_INDEX][:, 0].long().to(model.device)
    return model.camera_optimizer.corrected(frames, poses.to(model.device))


def camera_rays(
    cameras: Cameras, frames: Int[np.ndarray, "n"], places: Float[np.ndarray, "n 2"], device: torch.device | str
) -> RayBundle:
    """Rays of cameras as measured, which the model corrects, through places (x, y) in pixels from the corner."""
    return cameras.generate_rays(
        camera_indices=torch.from_numpy(np.asarray(frames)[:, None]),
        coords=torch.from_numpy(np.asarray(places)[:, ::-1].copy()).float(),
    ).to(device)


@torch.no_grad()
def render_object(model: SpectralModel, rays: RayBundle) -> tuple[dict[str, Tensor], Float[Tensor, "n bands"]]:
    """The model's outputs for rays as measured, and the object's own reflectance: without the background's share.

    A model without a background fills the rest of a ray with what the ray met last, which is the object's already.
    """
    behind = model.background_spectrum(rays)  # before the model corrects the rays
    outputs = model(rays)
    spectra, opacity = outputs["spectral"], outputs["accumulation"]
    if model.background is not None:
        spectra = safe_ratio(spectra - behind * (1.0 - opacity), opacity, minimum=_LEAST_OPACITY)
    return outputs, spectra.clamp(0.0, 1.0)


@torch.no_grad()
def surface_along(
    model: SpectralModel,
    origins: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    near_depth: Float[Tensor, "n 1"],
    cosines: Float[Tensor, "n 1"] | None = None,
) -> tuple[Float[Tensor, "n 1"], Float[Tensor, "n 1"]]:
    """Depth of the surface, sought in fine steps around a depth, and the opacity collected on the way.

    Args:
        model: trained model, in evaluation mode.
        origins: of the rays, scene units.
        directions: unit vectors.
        near_depth: a depth that is nearly right.
        cosines: of the angles between the rays and the surface's inward normal; without it, the density's gradient
            where a ray is well within the surface says which way that faces. An oblique ray's way through the same
            density is longer: what counts is what a ray from the front would collect.
    """
    offsets = torch.linspace(-SEARCH_DEPTH, SEARCH_DEPTH, SEARCH_STEPS + 1, device=near_depth.device)
    edges = (near_depth + offsets).clamp_min(0.0)
    middles = (edges[:, 1:] + edges[:, :-1]) / 2.0
    densities = model.field.density_fn(origins[:, None] + directions[:, None] * middles[..., None])[..., 0]
    opacity = 1.0 - torch.exp(-(densities * edges.diff(dim=-1)).sum(dim=-1, keepdim=True))
    if cosines is None:
        within = origins + directions * opacity_crossing_depth(edges, densities, WELL_WITHIN)[:, None]
        inwards = functional.normalize(model.field.density_gradient(within), dim=-1)
        cosines = (inwards * directions).sum(dim=-1, keepdim=True).clamp_min(MIN_COSINE)
    return opacity_crossing_depth(edges, densities * cosines, SURFACE_OPACITY)[:, None], opacity


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """What training cameras see.

    Attributes:
        maps: depth maps.
        points: where rays in the masks meet something, scene units.
    """

    maps: DepthMaps
    points: Float[np.ndarray, "n 3"]


@torch.no_grad()
def look_from_cameras(
    model: SpectralModel,
    cameras: Cameras,
    masks: Bool[np.ndarray, "frames lines samples"],
    rays_per_batch: int,
    depth_output_name: str = "depth",
) -> SeenSurface:
    """Depth maps of training cameras, in the cells that the masks touch and a little beyond them.

    What a ray just beside the object passes through is known to be empty; without these rays, what is thinner than
    the mesh's band of distances would swell.

    Args:
        model: trained model, in evaluation mode.
        cameras: the training cameras.
        masks: pixels of each camera's frame to look through.
        rays_per_batch: rays rendered at a time.
        depth_output_name: the model's output that the surface is sought around.

    Raises:
        InputError: the model has no such output.
    """
    lines, samples = masks.shape[1:]
    cell_px = max(1, int(np.ceil(np.sqrt(masks.sum() / DEPTH_RAYS))))
    in_mask = _touched_cells(masks, cell_px)
    around = np.stack([dilate(mask, 2 * CELLS_AROUND + 1) for mask in in_mask])
    cells = np.argwhere(around)
    depths = torch.full(around.shape, torch.nan, device=model.device)
    met = [np.zeros((0, 3), np.float32)]
    with progress_bar("seeking the surface", "rays", len(cells)) as done:
        for start in range(0, len(cells), rays_per_batch):
            frame, line, sample = cells[start : start + rays_per_batch].T
            places = (np.stack([sample, line], axis=1) + 0.5) * cell_px
            rays = camera_rays(cameras, frame, np.minimum(places, (samples - 0.5, lines - 0.5)), model.device)
            outputs = model(rays)
            near_depth = model_output(outputs, depth_output_name, "depth")
            depth, _ = surface_along(model, rays.origins, rays.directions, near_depth)
            hit = outputs["accumulation"][:, 0] > MIN_OPACITY
            depths[frame, line, sample] = torch.where(hit, depth[:, 0], torch.inf)
            wanted = hit & torch.from_numpy(in_mask[frame, line, sample]).to(hit.device)
            met.append((rays.origins + rays.directions * depth)[wanted].cpu().numpy())
            done(start + rays_per_batch)
    lens = PinholeIntrinsics(
        samples, lines, *(float(getattr(cameras, name)[0, 0]) for name in ("fx", "fy", "cx", "cy"))
    )
    k1, k2, _, _, p1, p2 = [0.0] * 6 if cameras.distortion_params is None else cameras.distortion_params[0].tolist()
    maps = DepthMaps(
        camera_to_world=refined_poses(model, cameras),
        intrinsics=lens,
        distortion=(k1, k2, p1, p2),
        depths=depths,
        cell_px=cell_px,
        masks=torch.from_numpy(masks).to(model.device),
        tolerance=_DEPTH_TOLERANCE,
    )
    return SeenSurface(maps, np.concatenate(met))


def _touched_cells(
    masks: Bool[np.ndarray, "frames lines samples"], cell_px: int
) -> Bool[np.ndarray, "frames cells_down cells_across"]:
    """Cells of some pixels' side that hold a pixel of the masks."""
    frames, lines, samples = masks.shape
    down, across = -(-lines // cell_px), -(-samples // cell_px)
    padded = np.pad(masks, ((0, 0), (0, down * cell_px - lines), (0, across * cell_px - samples)))
    return padded.reshape(frames, down, cell_px, across, cell_px).max(axis=(2, 4))


def model_output(outputs: dict[str, Tensor], name: str, option: str) -> Tensor:
    """An output of the model.

    Raises:
        InputError: there is none of that name.
    """
    if name not in outputs:
        given = ", ".join(sorted(key for key in outputs if torch.is_tensor(outputs[key])))
        raise InputError(f"--{option}-output-name {name}: the model has no such output; choose one of {given}.")
    return outputs[name]
