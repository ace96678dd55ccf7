"""How well the material's reflectance is separated from the light, on simulated sessions of known materials.

    uv run hsi-sc-nerf simulate pear SESSION --frames 30 --size 96 --bands 24 \\
        --effects chamber_shading '{inter_reflection: {bounces: 3}}' lamp
    uv run python benchmarks/material_reflectance.py SESSION "pear, lamp"
    uv run python benchmarks/material_reflectance.py SESSION "pear, lamp" \\
        --config RUN/config.yml --cloud EXPORT/point_cloud.ply

Without a run, light is the noise-free one of the session's truth, mesh and poses are the true ones, so that nothing
but the light is judged. A point's spectrum is that of its most frontal view; its true one is the reflectance of the
same pixels. With ``--even`` the session's light is replaced by even light.

With a run, all is as in `hsi-sc-nerf material`: the trained surface, the poses of the dataset, its noisy frames, and
the cloud's spectra. A point's true spectrum is that of the nearest point of the true surface. The true irradiance is
that of the pixel which shows the point most from the front.

With ``--light``, the light is taken from the file that `hsi-sc-nerf material` wrote for another object:

    uv run python benchmarks/material_reflectance.py MAIZE "maize" --light APPLE/cloud-material.json

The white reference of a session with a lamp faces the lamp, which is the simulator's convention.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, Int
from results_table import Benchmark, write_results
from true_object import TrueObject, relative_rms

from hsi_sc_nerf.export.cloud import INCIDENCE, read_spectral_ply
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.light.elements import (
    LARGEST_INCIDENCE_DEG,
    Elements,
    observe_elements,
    spread_elements,
    support_mesh,
)
from hsi_sc_nerf.light.fit import WHITE_STD
from hsi_sc_nerf.light.known_light import KnownLight, read_light
from hsi_sc_nerf.light.material import centre_in_camera, light_on_object, turning_elements
from hsi_sc_nerf.light.matte_views import matte_score
from hsi_sc_nerf.light.of_run import ShadingEvidence, light_of_run, shading_evidence
from hsi_sc_nerf.light.views import ElementViews
from hsi_sc_nerf.models.trained_run import open_trained_run
from hsi_sc_nerf.processing.visual_hull import DISC_OVER_MARKERS
from hsi_sc_nerf.simulate.effects.light import Lamp
from hsi_sc_nerf.simulate.truth import Truth, load_truth

COLUMNS = (
    "session",
    "kind",
    "shading found",
    "profile",
    "brightness as measured, 5 to 95 %",
    "brightness of material, 5 to 95 %",
    "median",
    "with the true irradiance, 5 to 95 %",
    "spots as measured, median, %",
    "worst, %",
    "spots of material, median, %",
    "90 %",
    "worst of material, %",
    "irradiance, true to found, 5 to 95 %",
    "stated std, median, %",
    "irradiance within 1 std, %",
    "irradiance within 2 std, %",
    "material within 1 std, %",
    "material within 2 std, %",
    "CPU seconds",
)
ELEMENTS, SUPPORT_ELEMENTS = 2000, 800
POINTS, SPOTS, SPOT_RADIUS_M = 6000, 200, 0.005
LIFT_M, SMOOTHING_M = 2e-4, 0.003
PURE = 0.999


@dataclass(frozen=True)
class MaterialReflectance(Benchmark):
    """Separate light and material of a simulated session, and compare with the truth."""

    session: tyro.conf.Positional[Path]
    """Folder of a simulated session."""
    name: tyro.conf.Positional[str]
    """Name of the session in the table."""
    even: bool = False
    """Take even light instead of the session's own."""
    config: Path | None = None
    """The config.yml of a run that was trained on the session, to be judged instead of the true mesh."""
    cloud: Path | None = None
    """The cloud that was exported from it."""
    light: Path | None = None
    """NAME-material.json of another session, whose light is taken."""

    def main(self) -> None:
        """Measure, and write the table's row."""
        truth = load_truth(self.session)
        known = None if self.light is None else read_light(self.light)
        if self.config is not None and self.cloud is not None:
            kind, judged = "trained", judge_run(truth, self.config, self.cloud, known)
        else:
            container_m = container_of(self.session)
            kind, judged = "true mesh", judge_true_mesh(truth, container_m, known, even=self.even)
        row = [self.name, kind, *judged.cells()]
        write_results("material_reflectance", COLUMNS, [row], keys=2, folder=self.results)


def container_of(session: Path) -> tuple[float, float]:
    """Diameter and height of the container, metres."""
    values = json.loads((session / "truth" / "truth.json").read_text(encoding="utf-8"))["container"]
    return values["diameter_m"], values["height_m"]


def facing_of(truth: Truth) -> Float[np.ndarray, "3"]:
    """Normal of the white reference, camera's frame."""
    lamp = truth.effects.get("lamp")
    return np.array([0.0, 0.0, 1.0]) if lamp is None else Lamp(**lamp).direction(np.eye(4))


@dataclass(frozen=True)
class Judged:
    """What is compared: spectra of points and their irradiance; its truth is NaN where no pixel shows it."""

    evidence: ShadingEvidence
    points: Float[np.ndarray, "n 3"]
    measured: Float[np.ndarray, "n bands"]
    material: Float[np.ndarray, "n bands"]
    true: Float[np.ndarray, "n bands"]
    irradiance: Float[np.ndarray, "n bands"]
    std: Float[np.ndarray, "n"]
    true_irradiance: Float[np.ndarray, "n"]
    seconds: float

    def cells(self) -> list[str]:
        """The row of the table."""
        evidence, found, std = self.evidence, self.irradiance, self.std
        if not evidence.shaded:
            found, std = np.ones_like(found), np.full(len(std), WHITE_STD)
        corrected = self.material if evidence.shaded else self.measured
        bright, apparent = (spectra.mean(axis=1) / self.true.mean(axis=1) for spectra in (corrected, self.measured))
        spots, as_measured = (spot_errors(self.points, spectra, self.true) for spectra in (corrected, self.measured))
        light, relative = self.true_irradiance / found.mean(axis=1), std / found.mean(axis=1)
        sigmas = (np.abs(light - 1.0) / relative)[np.isfinite(light)]
        of_material = np.abs(bright - 1.0) / relative
        span = "{:.3f} to {:.3f}"
        return [
            "yes" if evidence.shaded else "no",
            f"{evidence.profile:.2f} ± {evidence.profile_std:.2f}",
            span.format(*np.quantile(apparent, [0.05, 0.95])),
            span.format(*np.quantile(bright, [0.05, 0.95])),
            f"{np.median(bright):.3f}",
            span.format(*np.nanquantile(apparent / self.true_irradiance, [0.05, 0.95])),
            f"{100.0 * np.median(as_measured):.1f}",
            f"{100.0 * as_measured.max():.1f}",
            f"{100.0 * np.median(spots):.2f}",
            f"{100.0 * np.quantile(spots, 0.9):.1f}",
            f"{100.0 * spots.max():.1f}",
            span.format(*np.nanquantile(light, [0.05, 0.95])),
            f"{100.0 * np.median(relative):.1f}",
            f"{100.0 * (sigmas < 1.0).mean():.0f}",
            f"{100.0 * (sigmas < 2.0).mean():.0f}",
            f"{100.0 * (of_material < 1.0).mean():.0f}",
            f"{100.0 * (of_material < 2.0).mean():.0f}",
            f"{self.seconds:.0f}",
        ]


def judge_true_mesh(
    truth: Truth, container_m: tuple[float, float], known: KnownLight | None, *, even: bool
) -> Judged:
    """The light on the true mesh."""
    mesh, poses = truth.mesh(), truth.camera_to_world
    corners = np.concatenate(list(truth.marker_layout.values()))
    support = support_mesh(container_m, DISC_OVER_MARKERS * float(np.hypot(*corners[:, :2].T).max()))
    elements = spread_elements(mesh, support, ELEMENTS, SUPPORT_ELEMENTS, SMOOTHING_M)
    masks = np.stack([truth.object_coverage(capture) >= PURE for capture in truth.captures])

    @lru_cache(maxsize=2 * len(truth.captures))
    def cube(frame: int, of_material: bool) -> Float[np.ndarray, "h w bands"]:
        capture = truth.captures[frame]
        return truth.reflectance(capture) if of_material else truth.light(capture).radiance()

    def observed(some: Elements, *, of_material: bool) -> ElementViews:
        return observe_elements(
            some,
            poses,
            truth.intrinsics,
            truth.distortion,
            masks,
            lambda frame, line, sample: cube(frame, of_material)[line, sample].astype(float),
            LIFT_M,
        )

    views = observed(elements, of_material=even)
    facing = np.array([0.0, 0.0, 1.0]) if even else facing_of(truth)
    started = time.process_time()
    turning = turning_elements(elements, poses[:, :3, :3], SMOOTHING_M, LIFT_M)
    if known is not None:
        known = known.at(centre_in_camera(elements, poses), truth.wavelengths_nm)
    found = light_on_object(elements, turning, views, facing, known)
    evidence = shading_evidence(turning, views, found.spectral)
    seconds = time.process_time() - started

    points = frontal_points(elements, mesh)
    seen, material = observed(points, of_material=even), observed(points, of_material=True)
    sight = poses[seen.frame, :3, 3] - points.positions[seen.element]
    cosines = (sight * points.normals[seen.element]).sum(axis=1) / np.linalg.norm(sight, axis=1)
    best = best_views(seen.element, cosines)
    point, measured, true = seen.element[best], seen.reflectance[best], material.reflectance[best]
    where = points.positions[point], points.normals[point], seen.frame[best]
    irradiance, std = found.irradiance(*where)
    highlights, gloss = np.zeros(len(cosines)), found.fit.gloss
    if gloss is not None:
        highlights = gloss.highlight(np.einsum("nk,nkj->nj", points.normals[seen.element], poses[seen.frame, :3, :3]))
    matte = best_views(seen.element, matte_score(cosines, highlights))
    of_view = points.positions[point], points.normals[point], seen.frame[matte]
    separated = found.material_at(seen.reflectance[matte], *of_view, np.arange(measured.shape[1])).spectra
    shown = measured.mean(axis=1) / true.mean(axis=1)
    return Judged(evidence, points.positions[point], measured, separated, true, irradiance, std, shown, seconds)


def judge_run(truth: Truth, config: Path, cloud_path: Path, known: KnownLight | None) -> Judged:
    """The light on a run's surface, and the spectra of its cloud."""
    run, cloud = open_trained_run(config), read_spectral_ply(cloud_path)
    started = time.process_time()
    found = light_of_run(run, facing_of(truth), known)
    seconds, surface = time.process_time() - started, TrueObject.of(truth)
    frontal = np.flatnonzero(cloud.extra[INCIDENCE] < LARGEST_INCIDENCE_DEG)
    chosen = np.random.default_rng(0).choice(frontal, min(2 * POINTS, len(frontal)), replace=False)
    points = cloud.points[chosen].astype(float)
    frames, xy_px, normals = found.frontal(points)
    where, measured = (points, normals, np.maximum(frames, 0)), cloud.spectra[chosen]
    irradiance, std = found.light.irradiance(*where)
    separated = found.material(measured, points, np.arange(measured.shape[1])).spectra
    shown = np.full(len(points), np.nan)
    for index, frame in enumerate(run.manager.train_dataset.frames):
        rows = np.flatnonzero(frames == index)
        sample, line = xy_px[rows].astype(int).T
        radiance, material = truth.light(frame.capture).radiance(), truth.reflectance(frame.capture)
        pure = truth.object_coverage(frame.capture)[line, sample] >= PURE
        rows, line, sample = rows[pure], line[pure], sample[pure]
        shown[rows] = radiance[line, sample].mean(axis=1) / material[line, sample].mean(axis=1)
    _, weights, _ = surface.nearest(points)
    true = weights @ surface.endmembers
    return Judged(found.evidence, points, measured, separated, true, irradiance, std, shown, seconds)


def best_views(point: Int[np.ndarray, "m"], scores: Float[np.ndarray, "m"]) -> Int[np.ndarray, "seen"]:
    """Index of the view with the highest score of each point that is seen, by the points' order."""
    order = np.lexsort([-scores, point])
    return order[np.unique(point[order], return_index=True)[1]]


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
