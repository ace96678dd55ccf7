"""The light on the object of a trained run, and whether the light is uneven at all.

The run's surface casts the shade, and its training frames are the measurements. Uneven light shows in two ways. The
brightness of an element changes from view to view as the fitted light predicts. And of elements with similar spectra,
those that receive less light are darker; this also shows light that does not change with the turn.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import CERTAIN
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.light.elements import observe_elements, spread_elements, support_mesh
from hsi_sc_nerf.light.known_light import KnownLight
from hsi_sc_nerf.light.material import (
    ObjectLight,
    PointMaterial,
    centre_in_camera,
    light_on_object,
    turning_elements,
    white_place,
)
from hsi_sc_nerf.light.material_fit import LightFit
from hsi_sc_nerf.light.matte_views import HIGHLIT, matte_views
from hsi_sc_nerf.light.views import ElementViews, TurningElements
from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.processing.view_changes import like_spectra
from hsi_sc_nerf.surface.depth_renders import DepthRenders, render_depth_maps
from hsi_sc_nerf.surface.outline_opacity import outline_opacity
from hsi_sc_nerf.surface.surface_depth import camera_rays, render_object
from hsi_sc_nerf.surface.surface_points import SurfaceMesh, surface_mesh
from hsi_sc_nerf.terminal import progress_bar

ELEMENTS, SUPPORT_ELEMENTS = 2000, 800
"""Number of elements on the object and on its support: 2 to 4 mm apart on a fruit."""
LIFT_M = 0.0005
"""Distance of the rays' origins from the surface: half a voxel of the mesh."""
SMOOTHING_M = 0.003
"""Normals and light are means over this radius: the mesh is rough by its voxels, and pixels show no more."""
LEAST_VIEWS = 200
"""Fewer measurements do not determine the light."""
STANDS_ON_DISC_M = 0.01
"""Largest height of the lower side of an object's box over the disc if it stands on the disc itself: its shaded
underside may be missing from the masks."""
LEAST_UNEVENNESS = 0.01
"""Irradiance that varies by less over the object changes no result."""


@dataclass(frozen=True, eq=False)
class RunLight:
    """The light on the object of a run.

    Attributes:
        run: the trained run.
        light: irradiance and materials.
        stationary: the light itself, at the bands of the run.
        evidence: evidence of uneven light.
        renders: depth maps of the training frames.
        mesh: the object's surface, scene units.
    """

    run: TrainedRun
    light: ObjectLight
    stationary: KnownLight
    evidence: ShadingEvidence
    renders: DepthRenders
    mesh: SurfaceMesh

    @property
    def support_unknown(self) -> bool:
        """Whether the object stands above the disc on something of unknown size, whose shade is left out."""
        return _support_unknown(self.run.dataset)

    def frontal(
        self, points_m: Float[np.ndarray, "n 3"]
    ) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n 3"]]:
        """The frame that sees each point most from the front or -1, image coordinates there, and unit normals."""
        points = self.run.to_scene(points_m)
        normals = self.mesh.normals_at(points)
        frames, xy_px, _ = self.renders.most_frontal(*_beside(self.renders, points, normals))
        return frames.cpu().numpy(), xy_px.cpu().numpy(), normals

    def material(
        self,
        reflectance: Float[np.ndarray, "n selected"],
        points_m: Float[np.ndarray, "n 3"],
        bands: Int[np.ndarray, "selected"],
    ) -> PointMaterial:
        """The material at points of the object, with the light of the view that it is taken from.

        That is the most frontal view. If a highlight lies on the point there, the point is rendered anew in the view
        that `matte_views` finds.

        Args:
            reflectance: as measured, in the most frontal views.
            points_m: object frame.
            bands: of the run, at which the reflectance is given.
        """
        frames, _, normals = self.frontal(points_m)
        seen, gloss = frames >= 0, self.light.fit.gloss
        frames = np.maximum(frames, 0)
        if gloss is not None:
            in_camera = np.einsum("nk,nkj->nj", normals, self.light.turning.rotations[frames])
            rows = np.flatnonzero(seen & (gloss.highlight(in_camera) > HIGHLIT))
            there = _beside(self.renders, self.run.to_scene(points_m[rows]), normals[rows])
            others, xy_px = (column.cpu().numpy() for column in matte_views(self.renders, gloss, *there))
            better = (others >= 0) & (others != frames[rows])
            rows, reflectance = rows[better], reflectance.copy()
            frames[rows] = others[better]
            reflectance[rows] = self._rendered(frames[rows], xy_px[better])[:, bands]
        return self.light.material_at(reflectance, points_m, normals, frames, bands)

    def _rendered(
        self, frames: Int[np.ndarray, "n"], xy_px: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n bands"]:
        """The object's reflectance at image points."""
        model, cameras = self.run.model, self.run.manager.train_dataset.cameras
        batch, parts = model.config.eval_num_rays_per_chunk, [np.zeros((0, len(model.wavelengths_nm)), np.float32)]
        with progress_bar("rendering spectra without highlights", "points", len(frames)) as update:
            for start in range(0, len(frames), batch):
                rays = camera_rays(cameras, frames[start : start + batch], xy_px[start : start + batch], model.device)
                parts.append(render_object(model, rays)[1].cpu().numpy())
                update(min(start + batch, len(frames)))
        return np.concatenate(parts)


def light_of_run(
    run: TrainedRun,
    white_normal: Float[np.ndarray, "3"],
    known: KnownLight | None = None,
    white_height_m: float | None = None,
) -> RunLight:
    """Fit the light on the object of a run.

    Args:
        white_normal: outward unit normal of the white reference, camera's frame (OpenGL axes).
        known: light of another session in the same chamber, which is taken instead; the white reference is its own.
        white_height_m: height of the white reference over the disc, on its axis; None for where the camera looks.

    Raises:
        InputError: the run holds no object, no frame sees enough of it, or the known light has other bands.

    Example:
        >>> found = light_of_run(open_trained_run(Path("config.yml")), np.array([0.0, 0.0, 1.0]))
        >>> frames, _, normals = found.frontal(cloud.points)  # those that gave the cloud's spectra
        >>> irradiance, std = found.light.irradiance(cloud.points, normals, np.maximum(frames, 0))
    """
    wavelengths_nm = run.model.wavelengths_nm
    if known is not None:
        known = known.at(known.centre_m, wavelengths_nm)  # refused before the work
    sampler, dataset = run.manager.train_pixel_sampler, run.dataset
    cameras, batch = run.manager.train_dataset.cameras, run.model.config.eval_num_rays_per_chunk
    renders = render_depth_maps(run.model, cameras, sampler.masks, batch)
    mesh = surface_mesh(run.model, renders, run.to_scene(dataset.object_box_m), batch, outline_opacity(run, batch))
    if mesh is not None:
        mesh = seen_part(mesh, renders)
    if mesh is None or not len(mesh.triangles):
        raise InputError("the run holds no object that could cast shade; train longer.")
    scanned = Mesh(run.to_metres(mesh.vertices), mesh.triangles)
    container = dataset.container
    size_m = None if container is None else (container.diameter_m, container.height_m)
    support = support_mesh(size_m, float(dataset.scene_box_m[1, 0]))
    elements = spread_elements(scanned, support, ELEMENTS, SUPPORT_ELEMENTS, SMOOTHING_M)
    if _support_unknown(dataset):  # which shades the disc as well
        elements = replace(elements, shows_light=elements.on_object)
    poses = renders.camera_to_world.cpu().numpy().astype(float)
    poses[:, :3, 3] = run.to_metres(poses[:, :3, 3])
    centre_m = centre_in_camera(elements, poses)
    if known is not None:
        known = known.at(centre_m, wavelengths_nm)

    def pixels(frame: int, lines: np.ndarray, samples: np.ndarray) -> np.ndarray:
        reflectance, valid = unpack(
            sampler.reader.read(np.stack([np.full(len(lines), frame), lines, samples], axis=1))
        )
        return np.where(valid, reflectance, np.nan)

    views = observe_elements(elements, poses, renders.intrinsics, renders.distortion, sampler.masks, pixels, LIFT_M)
    if views.on_object.sum() < LEAST_VIEWS:
        raise InputError(
            "too few pixels of the object fit its surface and are measured in all bands; look at masks and poses in "
            "the dataset's report, and in its calibration.json at the flags of each band."
        )
    turning = turning_elements(elements, poses[:, :3, :3], SMOOTHING_M, LIFT_M)
    white_m = white_place(centre_m, poses, white_height_m)
    light = light_on_object(elements, turning, views, white_normal, known, white_m)
    covariance, evidence = light.fit.covariance, shading_evidence(turning, light.views, light.spectral)
    stationary = KnownLight(light.spectral.light, covariance, centre_m, wavelengths_nm)
    return RunLight(run, light, stationary, evidence, renders, mesh)


def _support_unknown(dataset: PackedDataset) -> bool:
    return dataset.container is None and bool(dataset.object_box_m[0, 2] > STANDS_ON_DISC_M)


def seen_part(mesh: SurfaceMesh, renders: DepthRenders) -> SurfaceMesh:
    """The triangles that some frame sees. Fusion also leaves a shell inside the object, at the truncation
    distance."""
    middles = mesh.vertices[mesh.triangles].mean(axis=1)
    frames, *_ = renders.most_frontal(*_beside(renders, middles, mesh.facet_normals()))
    triangles = mesh.triangles[(frames >= 0).cpu().numpy()]
    used, corners = np.unique(triangles, return_inverse=True)
    return SurfaceMesh(mesh.vertices[used], corners.reshape(-1, 3))


def _beside(renders: DepthRenders, *arrays: np.ndarray) -> tuple[torch.Tensor, ...]:
    """Arrays as tensors on the device of the renders."""
    return tuple(torch.from_numpy(array).float().to(renders.camera_to_world.device) for array in arrays)


@dataclass(frozen=True)
class ShadingEvidence:
    """Evidence of uneven light on an object.

    Attributes:
        turning: ratio of measured to predicted changes of brightness from view to view; 1 if the light is right.
        turning_std: standard deviation of it.
        turning_spread: standard deviation of irradiance between the views of an element, relative.
        profile: ratio of measured to predicted differences of brightness between elements of similar spectra; 1 if
            the light is right and the materials are the same, 0 in even light.
        profile_std: standard deviation of it.
        profile_spread: standard deviation of irradiance between elements, relative.
    """

    turning: float
    turning_std: float
    turning_spread: float
    profile: float
    profile_std: float
    profile_spread: float

    @property
    def shaded(self) -> bool:
        """Whether the light is uneven beyond noise."""
        turning = self.turning_spread > LEAST_UNEVENNESS and self.turning > CERTAIN * self.turning_std
        # Half way between even light and the light as it was fitted.
        profile = self.profile_spread > LEAST_UNEVENNESS and self.profile - 0.5 > self.profile_std
        return turning or profile


def shading_evidence(elements: TurningElements, views: ElementViews, fit: LightFit) -> ShadingEvidence:
    """Look for uneven light.

    Args:
        elements: that were measured.
        views: their measurements without gloss, by the same bands as the fit.
        fit: light and materials.
    """
    rows = np.flatnonzero(views.on_object)
    element, weights = views.element[rows], fit.weights[rows]
    brightness = np.log(np.maximum(views.reflectance[rows].mean(axis=1), 1e-4))
    # Brightness of a material is that of its mean over the bands.
    shown = (fit.material[element] * fit.irradiance[rows]).mean(axis=1)
    light = np.log(shown / fit.material[element].mean(axis=1))
    count = len(elements.positions)
    total = np.maximum(np.bincount(element, weights, count), 1e-9)
    means = [np.bincount(element, weights * values, count) / total for values in (brightness, light)]
    brighter, lighter = (values - mean[element] for values, mean in zip((brightness, light), means, strict=True))
    cells = elements.cells
    turning = _slope(brighter, lighter, weights, cells[element])
    seen = np.unique(element)
    spectra = np.stack([np.bincount(element, weights * band, count) for band in views.reflectance[rows].T], axis=-1)
    alike = like_spectra(spectra[seen])
    # Each is compared with the mean of the similar ones and itself.
    own_brighter, own_lighter = (mean[seen] - mean[seen][alike].mean(axis=1) for mean in means)
    profile = _slope(own_brighter, own_lighter, np.ones(len(seen)), cells[seen])
    return ShadingEvidence(*turning, float(np.std(lighter)), *profile, float(np.std(means[1][seen])))


def _slope(
    response: Float[np.ndarray, "n"],
    cause: Float[np.ndarray, "n"],
    weights: Float[np.ndarray, "n"],
    cells: np.ndarray,
) -> tuple[float, float]:
    """Regression through the origin, and its standard deviation where the errors in a cell are shared."""
    square = max(float((weights * cause**2).sum()), 1e-12)
    slope = float((weights * cause * response).sum()) / square
    sums = np.bincount(cells, weights * cause * (response - slope * cause))
    return slope, float(np.sqrt((sums**2).sum()) / square)
