"""How well the material's reflectance is told apart from the light, on simulated sessions of known materials.

    uv run python benchmarks/material_reflectance.py --objects pear apple maize

Each object is rendered in even light, in a chamber that it shades (three reflections between object, container and
disc), and in such a chamber with a lamp, without noise. Mesh and poses are the true ones, so that nothing but the
light is judged. A point's spectrum is that of its most frontal view, and its true one is what the same pixels show in
even light. The white reference of a session with a lamp faces the lamp, which is the simulator's convention.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float
from results_table import RESULTS, write_results

from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.light.elements import Elements, spread_elements, support_mesh
from hsi_sc_nerf.light.evidence import shading_evidence
from hsi_sc_nerf.light.material import light_on_object, turning_elements
from hsi_sc_nerf.light.observe import observe
from hsi_sc_nerf.simulate.effects.light import Lamp
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import Scene, load_scene, override
from hsi_sc_nerf.simulate.true_surface import relative_rms

SHADE = ("chamber_shading", "{inter_reflection: {bounces: 3}}")
LIGHTS: dict[str, tuple[str, ...]] = {
    "even": (),
    "shaded chamber": SHADE,
    "shaded chamber, lamp": (*SHADE, "lamp"),
}
COLUMNS = (
    "object",
    "light",
    "shading found",
    "profile",
    "brightness as measured, 5 to 95 %",
    "brightness of material, 5 to 95 %",
    "median",
    "spots as measured, worst, %",
    "spots of material, median, %",
    "90 %",
    "worst, %",
    "within 1 std, %",
    "within 2 std, %",
)
ELEMENTS, SUPPORT_ELEMENTS = 2000, 800
POINTS, SPOTS, SPOT_RADIUS_M = 6000, 200, 0.005
LIFT_M = 2e-4
PURE = 0.999
NO_DISTORTION = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class MaterialReflectance:
    """Simulate sessions, tell light and material apart, compare with the truth."""

    objects: tuple[str, ...] = ("pear", "apple", "maize")
    """Shipped scenes."""
    size: int = 128
    """Width and height of the images, pixels."""
    frames: int = 24
    """Frames of one turn."""
    bands: int = 12
    """Spectral bands."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Measure; each row is written as soon as it is known."""
        for name in self.objects:
            even: Float[np.ndarray, "frames h w bands"] | None = None
            for light, effects in LIGHTS.items():
                scene = override(
                    load_scene(name), size_px=self.size, frames=self.frames, bands=self.bands, effects=effects
                )
                scene = replace(scene, camera=replace(scene.camera, supersampling=3))
                simulation = Simulation(scene)
                frames = [simulation.frame(number) for number in range(self.frames)]
                shown = np.stack([frame.light.radiance() for frame in frames])
                even = shown if even is None else even
                masks = np.stack([frame.coverage >= PURE for frame in frames])
                row = [name, light, *judge(scene, simulation, shown, even, masks)]
                write_results("material_reflectance", COLUMNS, [row], keys=2, folder=self.results)


def judge(scene: Scene, simulation: Simulation, shown: np.ndarray, even: np.ndarray, masks: np.ndarray) -> list[str]:
    """The figures of one session."""
    mesh, poses = simulation.object_part.mesh, simulation.camera_to_world
    container = scene.container.diameter_m, scene.container.height_m
    support = support_mesh(container, scene.turntable.disc_diameter_m / 2.0)
    elements = spread_elements(mesh, mesh.vertex_normals(), support, ELEMENTS, SUPPORT_ELEMENTS)
    camera = poses, simulation.intrinsics, NO_DISTORTION, masks
    views = observe(elements, *camera, lambda f, line, s: shown[f, line, s].astype(float), LIFT_M)
    lamps = [effect for effect in scene.effects if isinstance(effect, Lamp)]
    facing = lamps[0].direction(np.eye(4)) if lamps else np.array([0.0, 0.0, 1.0])
    turning = turning_elements(elements, poses[:, :3, :3], LIFT_M)
    found = light_on_object(elements, turning, views, facing)
    evidence = shading_evidence(turning, views, found.spectral)

    points = frontal_points(elements, mesh)
    both = np.concatenate([shown, even], axis=-1)
    seen = observe(points, *camera, lambda f, line, s: both[f, line, s].astype(float), LIFT_M)
    sight = poses[seen.frame, :3, 3] - points.positions[seen.element]
    cosines = (sight * points.normals[seen.element]).sum(axis=1) / np.linalg.norm(sight, axis=1)
    order = np.lexsort([-cosines, seen.element])
    point, first = np.unique(seen.element[order], return_index=True)
    best = order[first]
    measured, true = np.split(seen.reflectance[best], 2, axis=1)
    material, relative = measured, np.full(len(best), 0.01)
    if evidence.shaded:
        irradiance, std = found.irradiance(points.positions[point], points.normals[point], seen.frame[best])
        material, relative = measured / irradiance, std / irradiance.mean(axis=1)
    bright, apparent = (spectra.mean(axis=1) / true.mean(axis=1) for spectra in (material, measured))
    spots, spots_apparent = (spot_errors(points.positions[point], spectra, true) for spectra in (material, measured))
    sigmas = np.abs(bright - 1.0) / relative
    span = "{:.3f} to {:.3f}"
    return [
        "yes" if evidence.shaded else "no",
        f"{evidence.profile:.2f} ± {evidence.profile_std:.2f}",
        span.format(*np.quantile(apparent, [0.05, 0.95])),
        span.format(*np.quantile(bright, [0.05, 0.95])),
        f"{np.median(bright):.3f}",
        f"{100.0 * spots_apparent.max():.1f}",
        f"{100.0 * np.median(spots):.2f}",
        f"{100.0 * np.quantile(spots, 0.9):.1f}",
        f"{100.0 * spots.max():.1f}",
        f"{100.0 * (sigmas < 1.0).mean():.0f}",
        f"{100.0 * (sigmas < 2.0).mean():.0f}",
    ]


def frontal_points(elements: Elements, mesh: Mesh) -> Elements:
    """Points of the object as a cloud has them, among the same occluders."""
    own = spread_elements(mesh, mesh.vertex_normals(), Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)), POINTS, 0)
    return replace(own, occluders=elements.occluders, of_triangle=elements.of_triangle)


def spot_errors(
    positions: Float[np.ndarray, "n 3"], spectra: Float[np.ndarray, "n bands"], true: Float[np.ndarray, "n bands"]
) -> Float[np.ndarray, "spots"]:
    """Relative RMS of the mean spectra of spots all over the points."""
    centres = positions[np.random.default_rng(0).choice(len(positions), SPOTS, replace=False)]
    near = (np.linalg.norm(positions - centre, axis=1) < SPOT_RADIUS_M for centre in centres)
    return np.array([relative_rms(spectra[some].mean(axis=0), true[some].mean(axis=0)) for some in near])


if __name__ == "__main__":
    tyro.cli(MaterialReflectance).main()
