"""Comparison of the simulator's renderer with Mitsuba 3 on one frame, under each light transport.

    uv run python benchmarks/mitsuba_agreement.py --output-dir /tmp/agreement --scene pear

Mitsuba renders each image several times with different seeds. The scatter gives the Monte-Carlo error of the
difference.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import mitsuba_rendering
import numpy as np
import tyro
from calibration_accuracy import rms
from jaxtyping import Bool, Float
from results_table import Benchmark, write_results
from rich.console import Console
from rich.progress import track

from hsi_sc_nerf import paper
from hsi_sc_nerf.simulate.effects.detector import band_centres_nm
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import Scene, load_scene, override
from hsi_sc_nerf.terminal import screen_table

matplotlib.use("agg")
import matplotlib.pyplot as plt

BOTH = ("chamber_shading", "inter_reflection")
COMPARISONS: dict[mitsuba_rendering.Transport, tuple[str, ...]] = {
    "even": (),
    "chamber": ("chamber_shading",),
    "one_bounce": BOTH,
    "many_bounces": BOTH,
}
"""Effects for each transport of Mitsuba; the simulator has at most one bounce, so the last one differs."""
COLUMNS = ("scene", "light", "RMS", "expected", "mean of Mitsuba - ours", "on the object alone")
LARGEST_DIFFERENCE = 0.05
"""End of the colour scale of the picture's differences."""


@dataclass(frozen=True)
class Ours:
    """One frame as our renderer sees it.

    Attributes:
        radiance: relative to the white tarp's, the chamber as bright as in Mitsuba.
        weights: fraction of each material in each pixel; the last one is the chamber.
        materials: their names.
        of_object: which of them are the object's.
        ray_grid: error of our evenly spaced rays (RMS), from two numbers of rays a pixel in even light.
    """

    radiance: Float[np.ndarray, "lines samples bands"]
    weights: Float[np.ndarray, "lines samples materials"]
    materials: tuple[str, ...]
    of_object: Bool[np.ndarray, "materials"]
    ray_grid: float


@dataclass(frozen=True)
class Agreement:
    """How far two renderings of one frame are apart, in units of reflectance, where not the chamber alone is seen.

    Attributes:
        ours: our radiance.
        mitsuba: the mean of its renderings.
        rms: root mean square difference over pixels and bands.
        monte_carlo: the part of it that Mitsuba's random numbers explain.
        ray_grid: the part that our evenly spaced rays explain.
        bias: mean of Mitsuba minus ours, and its standard error.
        bias_of_object: the same for the object alone.
        bias_of_material: the same for each material, pixels weighted by its fraction.
    """

    ours: Float[np.ndarray, "lines samples bands"]
    mitsuba: Float[np.ndarray, "lines samples bands"]
    rms: float
    monte_carlo: float
    ray_grid: float
    bias: tuple[float, float]
    bias_of_object: tuple[float, float]
    bias_of_material: dict[str, tuple[float, float]]

    @property
    def expected(self) -> float:
        """The difference that two right renderers would have."""
        return float(np.hypot(self.monte_carlo, self.ray_grid))


def render_ours(scene: Scene, frame: int) -> Ours:
    """Render one frame under the scene's effects; with any, the chamber is a lamp of radiance 1 and seen as that."""
    simulation = Simulation(scene)
    rendered = simulation.frame(frame)
    radiance = rendered.light.radiance().astype(float)
    weights = rendered.material_weights
    camera = dataclasses.replace(scene.camera, supersampling=max(1, scene.camera.supersampling - 1))
    plain = Simulation(dataclasses.replace(scene, camera=camera, effects=()))
    other_grid = (plain.frame(frame).material_weights - weights) @ simulation.endmembers
    if scene.effects:
        radiance += weights[..., -1:] * (1.0 - simulation.endmembers[-1])
    ray_grid = rms(other_grid[weights[..., -1] < 1.0]) / np.sqrt(2.0)
    of_object = np.isin(simulation.materials, simulation.object_part.materials)
    return Ours(radiance, weights, simulation.materials, of_object, ray_grid)


def compare(
    scene: Scene, frame: int, transport: mitsuba_rendering.Transport, ours: Ours, rays_per_pixel: int, repeats: int
) -> Agreement:
    """Render one frame with Mitsuba and hold it against ours."""
    renders = np.stack(
        [
            mitsuba_rendering.render(scene, frame, transport, rays_per_pixel=rays_per_pixel, seed=seed)
            for seed in track(range(repeats), f"{scene.name}, {transport}", transient=True)
        ]
    )
    difference = renders - ours.radiance
    seen = ours.weights[..., -1] < 1.0
    return Agreement(
        ours=ours.radiance,
        mitsuba=renders.mean(axis=0),
        rms=rms(difference.mean(axis=0)[seen]),
        monte_carlo=rms(renders.std(axis=0, ddof=1)[seen]) / np.sqrt(repeats),
        ray_grid=ours.ray_grid,
        bias=_weighted_mean(difference, seen.astype(float)),
        bias_of_object=_weighted_mean(difference, ours.weights[..., ours.of_object].sum(axis=-1)),
        bias_of_material={
            name: _weighted_mean(difference, ours.weights[..., i])
            for i, name in enumerate(ours.materials)
            if ours.weights[..., i].any()
        },
    )


def _weighted_mean(
    difference: Float[np.ndarray, "repeats lines samples bands"], weights: Float[np.ndarray, "lines samples"]
) -> tuple[float, float]:
    """Mean over pixels and bands, and its standard error from the scatter of each pixel's repeats."""
    of_pixel = difference.mean(axis=-1)
    variance = of_pixel.var(axis=0, ddof=1) / len(of_pixel)
    mean = (of_pixel.mean(axis=0) * weights).sum() / weights.sum()
    return float(mean), float(np.sqrt((variance * weights**2).sum()) / weights.sum())


@dataclass(frozen=True)
class MitsubaAgreement(Benchmark):
    """Render one frame of a scene with our renderer and with Mitsuba 3 and compare them."""

    output_dir: Path
    """Folder for the picture."""
    scene: str = "pear"
    """A shipped scene's name, or a scene file; its effects are left out."""
    frame: int = 0
    """Which frame of the full turn."""
    size_px: int = 64
    """Side of the image."""
    bands: int = 6
    """Bands over the sensor's range."""
    rays_per_pixel: int = 144
    """Mitsuba's rays in each of its pictures; best a multiple of the bands, and the product of two near numbers."""
    repeats: int = 4
    """How many pictures Mitsuba makes of each; their scatter is the Monte-Carlo error."""
    supersampling: int = 16
    """Our rays along each side of a pixel."""

    def main(self) -> None:
        """Render, print the tables, draw the picture, write the results."""
        scene = override(load_scene(self.scene), size_px=self.size_px, bands=self.bands, effects=())
        scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, supersampling=self.supersampling))
        ours = {
            effects: render_ours(override(scene, effects=effects), self.frame)
            for effects in track(dict.fromkeys(COMPARISONS.values()), f"{scene.name}, ours", transient=True)
        }
        found = {
            transport: compare(scene, self.frame, transport, ours[effects], self.rays_per_pixel, self.repeats)
            for transport, effects in COMPARISONS.items()
        }
        self.output_dir.mkdir(parents=True, exist_ok=True)
        _picture(found, scene, self.output_dir / f"mitsuba-{scene.name}.png")
        materials = [
            [
                material,
                *(
                    "{:+.2f} ± {:.2f}".format(*1e3 * np.array(each.bias_of_material[material]))
                    for each in found.values()
                ),
            ]
            for material in found["even"].bias_of_material
        ]
        Console().print(screen_table(["bias, 1e-3", *found], materials))
        rows = [[scene.name, transport.replace("_", " "), *_cells(each)] for transport, each in found.items()]
        write_results("mitsuba_agreement", COLUMNS, rows, keys=2, folder=self.results)


def _cells(agreement: Agreement) -> list[str]:
    bias, error = agreement.bias_of_object
    return [
        f"{1e3 * agreement.rms:.1f}",
        f"{1e3 * agreement.expected:.1f}",
        f"{1e3 * agreement.bias[0]:+.2f}",
        f"{1e3 * bias:+.2f} ± {1e3 * error:.2f}",
    ]


def _picture(found: dict[mitsuba_rendering.Transport, Agreement], scene: Scene, path: Path) -> None:
    """Ours, Mitsuba's and the difference, a row for each transport."""
    centres_nm = band_centres_nm(scene.sensor.bands)
    rgb = [int(np.abs(centres_nm - wanted_nm).argmin()) for wanted_nm in paper.PSEUDO_RGB_NM]
    figure, axes = plt.subplots(len(found), 3, figsize=(7.0, 2.3 * len(found)), layout="constrained", squeeze=False)
    for row, (transport, each) in zip(axes, found.items(), strict=True):
        row[0].imshow(each.ours[..., rgb].clip(0.0, 1.0) ** (1.0 / 2.2))
        row[1].imshow(each.mitsuba[..., rgb].clip(0.0, 1.0) ** (1.0 / 2.2))
        difference = (each.mitsuba - each.ours).mean(axis=-1)
        image = row[2].imshow(difference, cmap="RdBu_r", vmin=-LARGEST_DIFFERENCE, vmax=LARGEST_DIFFERENCE)
        figure.colorbar(image, ax=row[2])
        ours = " + ".join(COMPARISONS[transport]).replace("_", " ") or "no effect"
        for axis, title in zip(row, (ours, f"Mitsuba: {transport}".replace("_", " "), "Mitsuba - ours"), strict=True):
            axis.set_title(title, fontsize=8)
            axis.set_axis_off()
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    tyro.cli(MitsubaAgreement).main()
