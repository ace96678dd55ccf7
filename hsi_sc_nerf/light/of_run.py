"""The light on the object of a trained run: its surface casts the shade, its training frames are the measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.light.elements import spread_elements, support_mesh
from hsi_sc_nerf.light.evidence import ShadingEvidence, shading_evidence
from hsi_sc_nerf.light.material import ObjectLight, light_on_object, turning_elements
from hsi_sc_nerf.light.observe import observe
from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.surface.depth_renders import DepthRenders, render_depth_maps
from hsi_sc_nerf.surface.surface_points import SurfaceMesh, surface_mesh

ELEMENTS, SUPPORT_ELEMENTS = 2000, 800
"""On the object and on what it stands on: 2 to 4 mm apart on a fruit."""
LIFT_M = 0.0005
"""Rays begin so far outside of the surface: half a voxel of the mesh."""
SMOOTHING_M = 0.003
"""Normals and light are means over this radius: the mesh is rough by its voxels, and pixels show no more."""
LEAST_VIEWS = 200
"""Fewer measurements tell nothing of the light."""


@dataclass(frozen=True, eq=False)
class RunLight:
    """The light on the object of a run.

    Attributes:
        run: the trained run.
        light: irradiance and materials.
        evidence: what tells of shading.
        renders: depth maps of the training frames.
        mesh: the object's surface, scene units.
    """

    run: TrainedRun
    light: ObjectLight
    evidence: ShadingEvidence
    renders: DepthRenders
    mesh: SurfaceMesh

    def irradiance(
        self, points_m: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n bands"], Float[np.ndarray, "n"]]:
        """Irradiance at points of the object in the frames that see them most from the front, and its uncertainty.

        These frames give the spectra of an exported cloud. For a point that no frame sees it is that of the first
        frame.
        """
        frames, _, normals = self.frontal(points_m)
        return self.light.irradiance(points_m, normals, np.maximum(frames, 0))

    def frontal(
        self, points_m: Float[np.ndarray, "n 3"]
    ) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n 3"]]:
        """The frame that sees each point most from the front or -1, image coordinates there, and unit normals."""
        points = self.run.to_scene(points_m)
        normals = self.mesh.normals_at(points)
        device = self.renders.camera_to_world.device
        where, outward = (torch.from_numpy(array).float().to(device) for array in (points, normals))
        frames, xy_px, _ = self.renders.most_frontal(where, outward)
        return frames.cpu().numpy(), xy_px.cpu().numpy(), normals


def light_of_run(run: TrainedRun, white_normal: Float[np.ndarray, "3"]) -> RunLight:
    """Fit the light on the object of a run.

    Args:
        run: the trained run.
        white_normal: outward unit normal of the white reference, camera's frame (OpenGL axes).

    Raises:
        InputError: the run holds no object, or no frame sees enough of it.

    Example:
        >>> found = light_of_run(open_run(Path("config.yml")), np.array([0.0, 0.0, 1.0]))
        >>> irradiance, std = found.irradiance(cloud.points)
    """
    sampler, dataset = run.manager.train_pixel_sampler, run.dataset
    cameras, batch = run.manager.train_dataset.cameras, run.model.config.eval_num_rays_per_chunk
    renders = render_depth_maps(run.model, cameras, sampler.masks, batch)
    mesh = surface_mesh(run.model, renders, run.to_scene(dataset.object_box_m), batch)
    if mesh is not None:
        mesh = seen_part(mesh, renders)
    if mesh is None or not len(mesh.triangles):
        raise InputError("the run holds no object that could cast shade; train longer.")
    scanned = Mesh(run.to_metres(mesh.vertices), mesh.triangles)
    container = dataset.container
    size_m = None if container is None else (container.diameter_m, container.height_m)
    support = support_mesh(size_m, float(dataset.scene_box_m[1, 0]))
    elements = spread_elements(scanned, support, ELEMENTS, SUPPORT_ELEMENTS, SMOOTHING_M)
    poses = renders.camera_to_world.cpu().numpy().astype(float)
    poses[:, :3, 3] = run.to_metres(poses[:, :3, 3])

    def pixels(frame: int, lines: np.ndarray, samples: np.ndarray) -> np.ndarray:
        reflectance, valid = unpack(
            sampler.reader.read(np.stack([np.full(len(lines), frame), lines, samples], axis=1))
        )
        return np.where(valid, reflectance, np.nan)

    views = observe(elements, poses, renders.intrinsics, renders.distortion, sampler.masks, pixels, LIFT_M)
    if views.tells_light.sum() < LEAST_VIEWS:
        raise InputError(
            "too few pixels of the object fit its surface; look at masks and poses in the dataset's report."
        )
    turning = turning_elements(elements, poses[:, :3, :3], SMOOTHING_M, LIFT_M)
    light = light_on_object(elements, turning, views, white_normal)
    return RunLight(run, light, shading_evidence(turning, views, light.spectral), renders, mesh)


def seen_part(mesh: SurfaceMesh, renders: DepthRenders) -> SurfaceMesh:
    """The triangles that some frame sees: fusion also leaves a shell within the object, where its distances end."""
    middles = mesh.vertices[mesh.triangles].mean(axis=1)
    device = renders.camera_to_world.device
    where, outward = (torch.from_numpy(array).float().to(device) for array in (middles, mesh.facet_normals()))
    triangles = mesh.triangles[(renders.most_frontal(where, outward)[0] >= 0).cpu().numpy()]
    used, corners = np.unique(triangles, return_inverse=True)
    return SurfaceMesh(mesh.vertices[used], corners.reshape(-1, 3))
