"""Rendering of a scene with Mitsuba 3, as an independent check of the simulator's own renderer.

Needs the package ``mitsuba`` of the dev group. Geometry, poses and material fractions are the simulator's own;
visibility, light transport and the spectral film are Mitsuba's. All spectra are explicit tables, because lights that
Mitsuba makes of plain numbers have the spectrum of daylight, which ends at 830 nm.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import mitsuba as mi
import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.simulate import assemble
from hsi_sc_nerf.simulate.effects.detector import band_centres_nm
from hsi_sc_nerf.simulate.effects.motion import MotionEffect
from hsi_sc_nerf.simulate.materials import endmembers
from hsi_sc_nerf.simulate.render import Part
from hsi_sc_nerf.simulate.scene import Scene

mi.set_variant("scalar_spectral")
# Mitsuba warns that integrators in Python are slow; for small images they are fast enough.
mi.set_log_level(mi.LogLevel.Error)

Transport = Literal["even", "chamber", "one_bounce", "many_bounces"]
"""Light transport: even light; direct light of the chamber with occlusion; one diffuse bounce in addition; any number
of bounces."""
TRANSPORTS: tuple[Transport, ...] = get_args(Transport)
COVERED_EFFECTS = ("chamber_shading", "inter_reflection")
"""Effects that a transport represents. Motion effects are part of the poses; other effects cannot be rendered."""
MAX_DEPTH: dict[Transport, int] = {"chamber": 2, "one_bounce": 3, "many_bounces": -1}
"""Largest number of segments of a path from the chamber to the camera; -1 for any."""
OPENGL_TO_MITSUBA = np.diag([-1.0, 1.0, -1.0, 1.0])
"""The x axis of Mitsuba's camera points left, and the camera looks along +z."""
SEAM_NM = 0.02
"""Half width of the transition between neighbouring bands."""


class SeenReflectance(mi.SamplingIntegrator):
    """Even light: the radiance of every surface is its reflectance, without occlusion."""

    def sample(
        self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: bool = True
    ) -> tuple[Any, bool, list[float]]:
        """Reflectance at the hit of the ray, or radiance of the chamber."""
        hit = scene.ray_intersect(ray)
        if hit.is_valid():
            return hit.bsdf(ray).eval_diffuse_reflectance(hit), True, []
        return scene.environment().eval(hit), False, []


mi.register_integrator("seen_reflectance", SeenReflectance)


def render(
    scene: Scene, frame: int, transport: Transport, *, rays_per_pixel: int, seed: int = 0
) -> Float[np.ndarray, "lines samples bands"]:
    """Radiance of one frame relative to the white tarp's, with Mitsuba's Monte-Carlo error.

    In even light the chamber has its own spectrum. Otherwise it is the light source, with radiance 1 in all bands.

    Args:
        scene: a scene without effects, or with motion effects and those of `COVERED_EFFECTS`.
        frame: index of the frame.
        transport: light transport.
        rays_per_pixel: rays in each pixel; a multiple of the number of bands avoids noise of the spectral film.
        seed: seed of Mitsuba's sampler.

    Raises:
        InputError: the scene names an effect that is neither motion nor one of `COVERED_EFFECTS`.
    """
    for effect in scene.effects:
        if effect.name not in COVERED_EFFECTS and not isinstance(effect, MotionEffect):
            raise InputError(
                f"scene {scene.name}: the effect {effect.name} cannot be rendered with Mitsuba; leave it out."
            )
    pose = assemble.frame_plan(scene).camera_to_world[frame]
    world: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": MAX_DEPTH[transport]}
        if transport in MAX_DEPTH
        else {"type": "seen_reflectance"},
        "sensor": {
            **_camera(assemble.intrinsics(scene.camera), pose),
            "film": _film(scene),
            "sampler": {"type": "multijitter", "sample_count": rays_per_pixel},
        },
        "chamber": {
            "type": "constant",
            "radiance": _material(scene, "chamber") if transport == "even" else _spectrum(scene),
        },
    }
    for number, part in enumerate([assemble.object_part(scene), *assemble.support_parts(scene)]):
        for group, mesh in enumerate(_meshes(scene, part)):
            world[f"part_{number}_{group}"] = mesh
    cube = np.array(mi.render(mi.load_dict(world), seed=seed), float)
    edges_nm = _band_edges_nm(scene)
    return cube / (edges_nm[1] - edges_nm[0])


def _camera(intrinsics: PinholeIntrinsics, camera_to_world: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """A pinhole camera with its principal point in the image centre."""
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(2.0 * np.rad2deg(np.arctan(intrinsics.w / 2.0 / intrinsics.fl_x))),
        "near_clip": 1e-3,
        "far_clip": 1e3,
        "to_world": mi.ScalarTransform4f(camera_to_world @ OPENGL_TO_MITSUBA),
    }


def _band_edges_nm(scene: Scene) -> Float[np.ndarray, "bands+1"]:
    """Edges of bands of equal width over the sensor's range.

    The simulator evaluates spectra at the band centres. Here each value is constant over its band, so the widths of
    the bands do not matter.
    """
    centres_nm = band_centres_nm(scene.sensor.bands)
    return np.linspace(centres_nm[0], centres_nm[-1], scene.sensor.bands + 1)


def _film(scene: Scene) -> dict[str, Any]:
    """A film that integrates the light in each band over the pixel's square."""
    edges_nm = _band_edges_nm(scene)
    film: dict[str, Any] = {
        "type": "specfilm",
        "width": scene.camera.size_px,
        "height": scene.camera.size_px,
        "rfilter": {"type": "box"},
        "component_format": "float32",
    }
    # The film samples wavelengths from the sum of its bands, which must be 1 everywhere for even sampling. So each
    # band fades out where the next one fades in.
    seams_nm = edges_nm[1:-1, None] + np.array([-SEAM_NM, SEAM_NM])
    for band in range(scene.sensor.bands):
        rise_nm = edges_nm[:1] if band == 0 else seams_nm[band - 1]
        fall_nm = edges_nm[-1:] if band == scene.sensor.bands - 1 else seams_nm[band]
        # Mitsuba sorts bands by name.
        film[f"band_{band:04d}"] = {
            "type": "irregular",
            "wavelengths": _numbers(np.concatenate([rise_nm, fall_nm])),
            "values": _numbers(np.concatenate([[0.0, 1.0][-len(rise_nm) :], [1.0, 0.0][: len(fall_nm)]])),
        }
    return film


def _spectrum(scene: Scene, values: Float[np.ndarray, "bands"] | None = None) -> dict[str, Any]:
    """A spectrum that is constant within each band; 1 by default."""
    edges_nm = _band_edges_nm(scene)
    nodes_nm = np.stack([edges_nm[:-1] + SEAM_NM, edges_nm[1:] - SEAM_NM], axis=-1)
    nodes_nm[0, 0], nodes_nm[-1, 1] = edges_nm[0] - 1.0, edges_nm[-1] + 1.0
    values = np.ones(scene.sensor.bands) if values is None else values
    return {
        "type": "irregular",
        "wavelengths": _numbers(nodes_nm.ravel()),
        "values": _numbers(np.repeat(values, 2)),
    }


def _material(scene: Scene, name: str, factor: float = 1.0) -> dict[str, Any]:
    values = endmembers([name], band_centres_nm(scene.sensor.bands), scene.materials)[0]
    return _spectrum(scene, factor * values)


def _numbers(values: Float[np.ndarray, "n"]) -> str:
    return ", ".join(f"{value:.9g}" for value in values)


def _meshes(scene: Scene, part: Part) -> list[Any]:
    """The part as one mesh for each set of materials that occurs in its triangles."""
    meshes = []
    present = (part.weights[part.mesh.triangles] > 0.0).any(axis=1)
    for of_group in np.unique(present, axis=0):
        triangles = part.mesh.triangles[(present == of_group).all(axis=1)]
        used, triangles = np.unique(triangles, return_inverse=True)
        columns = np.flatnonzero(of_group)
        names = [part.materials[column] for column in columns]
        properties = mi.Properties()
        properties["surface"] = mi.load_dict({"type": "twosided", "reflection": _mixture(scene, names)})
        mesh = mi.Mesh("part", len(used), triangles.size // 3, properties)
        buffers = mi.traverse(mesh)
        buffers["vertex_positions"] = part.mesh.vertices[used].ravel().tolist()
        buffers["faces"] = triangles.ravel().tolist()
        buffers.update()
        for column, name in zip(columns, names, strict=True):
            mesh.add_attribute(f"vertex_{name}", 1, part.weights[used, column].tolist())
        meshes.append(mesh)
    return meshes


def _mixture(scene: Scene, names: list[str]) -> dict[str, Any]:
    """A matte surface whose reflectance is the sum of the materials' weighted by their fractions at the vertices.

    Mitsuba only blends two surfaces with one weight. Two materials are one blend. Each of n > 2 materials is made n
    times as bright and blended with black; the even blend of the n surfaces is then the weighted sum.
    """
    if len(names) == 1:
        return {"type": "diffuse", "reflectance": _material(scene, names[0])}
    if len(names) == 2:
        first, second = (_mixture(scene, [name]) for name in names)
        return _blend(first, second, {"type": "mesh_attribute", "name": f"vertex_{names[1]}"})
    black = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}}
    mean: dict[str, Any] = {}
    for number, name in enumerate(names):
        bright = {"type": "diffuse", "reflectance": _material(scene, name, factor=float(len(names)))}
        weighted = _blend(black, bright, {"type": "mesh_attribute", "name": f"vertex_{name}"})
        mean = _blend(mean, weighted, 1.0 / (number + 1.0)) if mean else weighted
    return mean


def _blend(first: dict[str, Any], second: dict[str, Any], weight_of_second: dict[str, Any] | float) -> dict[str, Any]:
    return {"type": "blendbsdf", "weight": weight_of_second, "first": first, "second": second}
