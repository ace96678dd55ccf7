"""How well the material's reflectance is told apart from the light, on simulated sessions of known materials.

    uv run hsi-sc-nerf simulate pear SESSION --frames 30 --size 96 --bands 24 \\
        --effects chamber_shading '{inter_reflection: {bounces: 3}}' lamp
    uv run python benchmarks/material_reflectance.py SESSION "pear, lamp"

Light is the noise-free one of the session's truth, mesh and poses are the true ones, so that nothing but the light is
judged. A point's spectrum is that of its most frontal view; its true one is the reflectance of the same pixels. The
white reference of a session with a lamp faces the lamp, which is the simulator's convention. With ``--even`` the
session's light is replaced by even light.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
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
from hsi_sc_nerf.processing.scene_box import DISC_OVER_MARKERS
from hsi_sc_nerf.simulate.effects.light import Lamp
from hsi_sc_nerf.simulate.true_surface import relative_rms
from hsi_sc_nerf.simulate.truth import Truth, load_truth

COLUMNS = (
    "session",
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
LIFT_M, SMOOTHING_M = 2e-4, 0.003
PURE = 0.999
EVEN_STD = 0.01
"""Stated uncertainty of what is not corrected: that of the white reference."""


@dataclass(frozen=True)
class MaterialReflectance:
    """Tell light and material of a simulated session apart, and compare with the truth."""

    session: tyro.conf.Positional[Path]
    """Folder of a simulated session."""
    name: tyro.conf.Positional[str]
    """Of the session, in the table."""
    even: bool = False
    """Take even light instead of the session's own."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Measure, and write the table's row."""
        truth = load_truth(self.session)
        row = [self.name, *judge(truth, container_of(self.session), even=self.even)]
        write_results("material_reflectance", COLUMNS, [row], keys=1, folder=self.results)


def container_of(session: Path) -> tuple[float, float]:
    """Diameter and height of the container, metres."""
    values = json.loads((session / "truth" / "truth.json").read_text(encoding="utf-8"))["container"]
    return values["diameter_m"], values["height_m"]


def judge(truth: Truth, container_m: tuple[float, float], *, even: bool) -> list[str]:
    """The figures of one session."""
    mesh, poses = truth.mesh(), truth.camera_to_world
    corners = np.concatenate(list(truth.marker_layout.values()))
    support = support_mesh(container_m, DISC_OVER_MARKERS * float(np.hypot(*corners[:, :2].T).max()))
    elements = spread_elements(mesh, support, ELEMENTS, SUPPORT_ELEMENTS, SMOOTHING_M)
    masks = np.stack([truth.object_coverage(capture) >= PURE for capture in truth.captures])

    @lru_cache(maxsize=len(truth.captures))
    def cubes(frame: int) -> Float[np.ndarray, "h w both"]:
        capture = truth.captures[frame]
        material = truth.reflectance(capture)
        shown = material if even else truth.light(capture).radiance()
        return np.concatenate([shown, material], axis=-1)

    def observed(some: Elements) -> tuple:
        views = observe(
            some,
            poses,
            truth.intrinsics,
            truth.distortion,
            masks,
            lambda frame, line, sample: cubes(frame)[line, sample].astype(float),
            LIFT_M,
        )
        shown, material = np.split(views.reflectance, 2, axis=1)
        return replace(views, reflectance=shown), material

    views, _ = observed(elements)
    facing = np.array([0.0, 0.0, 1.0])
    if "lamp" in truth.effects and not even:
        facing = Lamp(**truth.effects["lamp"]).direction(np.eye(4))
    turning = turning_elements(elements, poses[:, :3, :3], LIFT_M)
    found = light_on_object(elements, turning, views, facing)
    evidence = shading_evidence(turning, views, found.spectral)

    points = frontal_points(elements, mesh)
    seen, material = observed(points)
    sight = poses[seen.frame, :3, 3] - points.positions[seen.element]
    cosines = (sight * points.normals[seen.element]).sum(axis=1) / np.linalg.norm(sight, axis=1)
    order = np.lexsort([-cosines, seen.element])
    point, first = np.unique(seen.element[order], return_index=True)
    best = order[first]
    measured, true = seen.reflectance[best], material[best]
    corrected, relative = measured, np.full(len(best), EVEN_STD)
    if evidence.shaded:
        irradiance, std = found.irradiance(points.positions[point], points.normals[point], seen.frame[best])
        corrected, relative = measured / irradiance, std / irradiance.mean(axis=1)
    bright, apparent = (spectra.mean(axis=1) / true.mean(axis=1) for spectra in (corrected, measured))
    spots, spots_apparent = (spot_errors(points.positions[point], spectra, true) for spectra in (corrected, measured))
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
    own = spread_elements(mesh, Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)), POINTS, 0, SMOOTHING_M)
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
