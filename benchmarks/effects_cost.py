"""Cost of each effect of the simulator, and the error of neglecting it, as a table.

    uv run python benchmarks/effects_cost.py --page docs/effects.md

Each effect is simulated alone, with its default settings, on each scene. Its cost is the time to prepare the scene
and to simulate a frame, beside a frame without effects in the same run. Its error is the difference of the calibrated
reflectance with and without it over the object's pixels: root mean square and mean spectral angle.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float
from page import write_table
from rich.console import Console
from rich.progress import track
from rich.table import Table

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

    page: Path
    """Markdown page whose table is replaced; a JSON file beside it gets the same figures."""
    scenes: tuple[str, ...] = ("pear", "apple", "maize")
    """Scenes to measure on."""
    effects: tuple[str, ...] = tuple(EFFECTS)
    """Effects to measure."""
    frames: int = 8
    """Frames in the turn."""
    size: int = 128
    """Width and height of the images, pixels."""

    def main(self) -> None:
        """Measure, print the table, write it into the page."""
        rows = []
        for name in self.scenes:
            scene = override(load_scene(name), frames=self.frames, size_px=self.size, effects=())
            _make(scene)  # the first run includes imports and caches
            plain = _make(scene)
            for effect in track(self.effects, f"effects on {name}"):
                made = _make(override(scene, effects=(effect,)))
                rows.append({"scene": name, "effect": effect, **_compare(plain, made)})
        self.page.with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        write_table(self.page, "table", COLUMNS, _cells(rows))
        shown = Table(*COLUMNS)
        for cells in _cells(rows):
            shown.add_row(*cells)
        Console(width=110).print(shown)


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


def _compare(plain: _Made, made: _Made) -> dict[str, float]:
    squares, angles = [], []
    for before, after, mask in zip(plain.reflectance, made.reflectance, plain.on_object, strict=False):
        squares.append(np.mean((after[mask] - before[mask]) ** 2))
        angles.append(spectral_angle(torch.from_numpy(after[mask]), torch.from_numpy(before[mask])).mean().item())
    return {
        "prepare_s": made.prepare_s,
        "seconds_per_frame": made.frames_s / len(made.reflectance),
        "plain_seconds_per_frame": plain.frames_s / len(plain.reflectance),
        "rms_reflectance": float(np.sqrt(np.mean(squares))),
        "sam_rad": float(np.mean(angles)),
    }


def _cells(rows: list[dict]) -> list[list[str]]:
    return [
        [
            row["scene"],
            row["effect"],
            f"{row['prepare_s']:.2f}",
            f"{1000 * row['seconds_per_frame']:.0f}",
            f"{1000 * row['plain_seconds_per_frame']:.0f}",
            f"{row['rms_reflectance']:.4f}",
            f"{row['sam_rad']:.4f}",
        ]
        for row in rows
    ]


if __name__ == "__main__":
    tyro.cli(EffectsCost).main()
