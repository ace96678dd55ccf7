"""Cost of each effect of the simulator, and the error of neglecting it, as a table.

    uv run python benchmarks/effects_cost.py

Each effect is simulated alone, with its default settings, on each scene. Its cost is the time to prepare the scene
and to simulate a frame, beside a frame without effects in the same run. Its error is the difference of the calibrated
reflectance with and without it over the object's pixels: root mean square and mean spectral angle.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float
from results_table import RESULTS, write_results
from rich.progress import track

from hsi_sc_nerf.numerics import spectral_angle
from hsi_sc_nerf.simulate.effects import EFFECTS
from hsi_sc_nerf.simulate.frames import SimulatedCapture, Simulation
from hsi_sc_nerf.simulate.scene import Scene, load_scene, override

COLUMNS = [
    "scene",
    "effect",
    "to prepare, s",
    "a frame, ms",
    "without, ms",
    "RMS if left out",
    "SAM if left out, rad",
]


@dataclass(frozen=True)
class EffectsCost:
    """Measure the cost and the error of every effect."""

    scenes: tuple[str, ...] = ("pear", "apple", "maize")
    """Scenes to measure on."""
    effects: tuple[str, ...] = tuple(EFFECTS)
    """Effects to measure."""
    frames: int = 8
    """Frames in the turn."""
    size: int = 128
    """Width and height of the images, pixels."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Measure, print the table, write it."""
        rows = []
        for name in self.scenes:
            scene = override(load_scene(name), frames=self.frames, size_px=self.size, effects=())
            _make(scene)  # the first run includes imports and caches
            plain = _make(scene)
            for effect in track(self.effects, f"effects on {name}"):
                rows.append([name, effect, *_cells(plain, _make(override(scene, effects=(effect,))))])
        write_results("effects_cost", COLUMNS, rows, keys=2, folder=self.results)


@dataclass(frozen=True)
class _Made:
    prepare_s: float
    frames_s: float
    reflectance: list[Float[np.ndarray, "lines samples bands"]]
    on_object: list[Bool[np.ndarray, "lines samples"]]


def _make(scene: Scene) -> _Made:
    started = time.perf_counter()
    simulation = Simulation(scene)
    prepared = time.perf_counter()
    frames = [simulation.frame(i) for i in range(len(simulation.captures))]
    made = time.perf_counter()
    white = simulation.white()
    centre = scene.camera.size_px // 2
    middle = slice(centre - 4, centre + 4)
    signal = _above_dark(white)[middle, middle].mean(axis=(0, 1))
    # Detector pixels without light get reflectance 0.
    signal = np.where(signal > 0, signal, np.inf)
    return _Made(
        prepare_s=prepared - started,
        frames_s=made - prepared,
        reflectance=[np.clip(_above_dark(f) / signal, 0.0, 1.0) for f in frames],
        on_object=[frame.coverage > 0.5 for frame in frames],
    )


def _above_dark(capture: SimulatedCapture) -> Float[np.ndarray, "lines samples bands"]:
    return capture.counts.astype(float) - capture.dark.mean(axis=0)


def _cells(plain: _Made, made: _Made) -> list[str]:
    """Times with and without the effect, and the error of leaving it out."""
    squares, angles = [], []
    for before, after, mask in zip(plain.reflectance, made.reflectance, plain.on_object, strict=False):
        squares.append(np.mean((after[mask] - before[mask]) ** 2))
        angles.append(spectral_angle(torch.from_numpy(after[mask]), torch.from_numpy(before[mask])).mean().item())
    return [
        f"{made.prepare_s:.2f}",
        f"{1000 * made.frames_s / len(made.reflectance):.0f}",
        f"{1000 * plain.frames_s / len(plain.reflectance):.0f}",
        f"{np.sqrt(np.mean(squares)):.4f}",
        f"{np.mean(angles):.4f}",
    ]


if __name__ == "__main__":
    tyro.cli(EffectsCost).main()
