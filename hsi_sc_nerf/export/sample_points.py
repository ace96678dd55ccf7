"""Spectra of given points on the object's surface, as the training cameras that see them would render them.

A spectrum depends on the viewing direction, and the model knows only directions that it was trained on: a ray along
the normal of an upward face comes from where no camera ever stood (on a simulated pear such rays are 0.15 rad off the
truth, the cameras' own 0.05). So each point gets the mean over the training cameras that see it. Of those that look
at it at less than ``MAX_INCIDENCE_DEG`` the most frontal ones render their ray through the point, and those count
whose ray ends where the point is, not before it, at something in the way, nor behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from hsi_sc_nerf.export.cloud import MAX_INCIDENCE_DEG
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, project
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.surface.depth_renders import MIN_OPACITY, render_object, surface_along

POINTS_AT_A_TIME = 1 << 12


@dataclass(frozen=True, eq=False)
class PointSpectra:
    """What the training cameras see of points.

    Attributes:
        spectra: mean reflectance over the views; NaN without any.
        spectral_std: standard deviation over the views, mean over the bands; NaN with fewer than two.
        views: how many views were averaged.
    """

    spectra: Float[np.ndarray, "n bands"]
    spectral_std: Float[np.ndarray, "n"]
    views: Int[np.ndarray, "n"]


def frontal_views(
    cosines: Float[np.ndarray, "n cameras"], in_frame: Bool[np.ndarray, "n cameras"], count: int
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Pairs of a point and a camera that may see it: for each point the ``count`` most frontal cameras.

    Args:
        cosines: of the angle between the point's normal and the direction to the camera.
        in_frame: whether the camera's image holds the point.
        count: cameras a point, at most.
    """
    ranked = np.where(in_frame, cosines, -1.0)
    count = min(count, ranked.shape[1])
    best = np.argpartition(-ranked, count - 1, axis=1)[:, :count]
    point, place = np.nonzero(np.take_along_axis(ranked, best, axis=1) > np.cos(np.deg2rad(MAX_INCIDENCE_DEG)))
    return point, best[point, place]


def outward(
    normals: Float[Tensor, "n 3"],
    points: Float[Tensor, "n 3"],
    density: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 1"]],
    reach: float,
) -> Float[Tensor, "n 3"]:
    """Normals turned to the side on which, ``reach`` away from the point, there is less density.

    Files hold normals that point inwards, or either way. Where both sides are alike, a normal stays as it is.
    """
    inside, outside = density(points - reach * normals), density(points + reach * normals)
    return torch.where(outside > inside, -normals, normals)


def mean_and_spread(
    spectra: Float[np.ndarray, "pairs bands"], point: Int[np.ndarray, "pairs"], num_points: int
) -> PointSpectra:
    """Mean and spread of the spectra that belong to the same point."""
    bands = spectra.shape[1]
    views = np.bincount(point, minlength=num_points)
    total, squares = np.zeros((2, num_points, bands))
    np.add.at(total, point, spectra)
    with np.errstate(invalid="ignore"):
        mean = np.where(views[:, None] > 0, total / views[:, None], np.nan)
        np.add.at(squares, point, np.square(spectra - mean[point]))
        spread = np.where(views > 1, np.sqrt(squares / (views[:, None] - 1.0)).mean(axis=1), np.nan)
    return PointSpectra(mean.astype(np.float32), spread.astype(np.float32), views)


def sample_points(
    run: TrainedRun,
    points_m: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    reach_m: float,
    views: int,
) -> Iterator[tuple[slice, Float[np.ndarray, "part 3"], PointSpectra]]:
    """Outward normals and spectra of points, some at a time, so that memory does not grow with their number.

    Lens distortion is neglected where it is decided which images hold a point.

    Args:
        run: the trained run.
        points_m: object frame, metres.
        normals: unit vectors, to either side of the surface; 0 for a point that gets no spectrum.
        reach_m: how far from the model's surface a point may lie, along its normal.
        views: how many training cameras' views are averaged, at most.
    """
    frames = run.manager.train_dataparser_outputs.metadata["turntable"]["frame_indices"]
    poses = run.refined_poses_m()[frames]
    poses[:, :3, 3] = run.to_scene(poses[:, :3, 3])
    for start in range(0, len(points_m), POINTS_AT_A_TIME):
        rows = slice(start, min(start + POINTS_AT_A_TIME, len(points_m)))
        points = run.to_scene(points_m[rows])
        intrinsics, reach = run.dataset.intrinsics, reach_m * run.scale
        turned = _outward(run.model, normals[rows], points, reach)
        yield rows, turned, spectra_of_points(run.model, poses, intrinsics, points, turned, reach, views)


@torch.no_grad()
def spectra_of_points(
    model: SpectralModel,
    poses: Float[np.ndarray, "cameras 4 4"],
    intrinsics: PinholeIntrinsics,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    reach: float,
    views: int,
) -> PointSpectra:
    """Spectra of points, all at once.

    Args:
        model: trained model, in evaluation mode.
        poses: camera-to-world of the training cameras as refined, scene units.
        intrinsics: of the cameras.
        points: scene units.
        normals: unit vectors out of the surface; 0 for a point that gets no spectrum.
        reach: as `sample_points` takes it, scene units.
        views: likewise.
    """
    to_point = points[:, None] - poses[:, :3, 3]
    distances = np.linalg.norm(to_point, axis=-1)
    directions = to_point / distances[..., None]
    cosines = -np.einsum("nk,nck->nc", normals, directions)
    in_frame = np.stack([_in_frame(points, pose, intrinsics) for pose in poses], axis=1)
    point, camera = frontal_views(cosines, in_frame, views)

    kept, seen = [np.zeros((0, len(model.wavelengths_nm)), np.float32)], []
    chunk = model.config.eval_num_rays_per_chunk
    for start in range(0, len(point), chunk):
        p, c = point[start : start + chunk], camera[start : start + chunk]
        spectra, opacity, depth = _rendered(model, poses[c, :3, 3], directions[p, c], cosines[p, c])
        missed = np.abs(depth - distances[p, c]) * cosines[p, c]
        hit = (opacity > MIN_OPACITY) & (missed <= reach)
        kept.append(spectra[hit])
        seen.append(p[hit])
    return mean_and_spread(np.concatenate(kept), np.concatenate([np.zeros(0, int), *seen]), len(points))


@torch.no_grad()
def _outward(
    model: SpectralModel, normals: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "n 3"], reach: float
) -> Float[np.ndarray, "n 3"]:
    given, where = (torch.from_numpy(array).float().to(model.device) for array in (normals, points))
    return outward(given, where, lambda places: model.field.density_fn(places[:, None])[:, 0], reach).cpu().numpy()


def _in_frame(
    points: Float[np.ndarray, "n 3"], pose: Float[np.ndarray, "4 4"], intrinsics: PinholeIntrinsics
) -> Bool[np.ndarray, "n"]:
    pixels, depth = project(points, pose, intrinsics)
    return (depth > 0.0) & ((pixels >= 0.0) & (pixels < (intrinsics.w, intrinsics.h))).all(axis=-1)


def _rendered(
    model: SpectralModel,
    origins: Float[np.ndarray, "rays 3"],
    directions: Float[np.ndarray, "rays 3"],
    cosines: Float[np.ndarray, "rays"],
) -> tuple[Float[np.ndarray, "rays bands"], Float[np.ndarray, "rays"], Float[np.ndarray, "rays"]]:
    """Spectrum of what rays of unit length meet, without the background's share; opacity; depth of the surface."""
    ones = torch.ones(len(origins), 1)
    rays = RayBundle(
        origins=torch.from_numpy(origins).float(),
        directions=torch.from_numpy(directions).float(),
        pixel_area=ones,
        camera_indices=torch.zeros_like(ones, dtype=torch.long),
        metadata={"directions_norm": ones},
    ).to(model.device)
    outputs, spectra = render_object(model, rays)
    facing = torch.from_numpy(cosines[:, None]).to(rays.origins)
    depth, _ = surface_along(model, rays.origins, rays.directions, outputs["depth"], facing)
    return spectra.cpu().numpy(), outputs["accumulation"][:, 0].cpu().numpy(), depth[:, 0].cpu().numpy()
