"""Two balls on one table, from captures to traits by `hsi-sc-nerf run`: each one's volume beside the truth.

uv run python benchmarks/two_balls.py --output-dir OUT
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import tyro
from results_table import Benchmark, write_results

from hsi_sc_nerf.cli.sessions import SimulateCommand
from hsi_sc_nerf.cli.workflows import RunCommand
from hsi_sc_nerf.models.presets import Preset

DIAMETERS_M, APART_M = (0.036, 0.026), 0.044
MATERIAL = "tomato_red"
_LENGTHS = ("height", "largest_diameter")
EFFECTS = ("photon_noise", "read_noise", "dark_pattern")
COLUMNS = ("object", "true volume, mL", "volume, mL", "volume, error", "height, error", "largest diameter, error")
SCENE = """
name: balls
object: {{shape: mesh, mesh_file: balls.ply, materials: [{material}]}}
camera: {{elevation_deg: 22, distance_m: 0.45, aim_height_m: 0.062, size_px: 128}}
turntable: {{disc_diameter_m: 0.205, frames: 36}}
markers: {{side_m: 0.036}}
effects: [{effects}]
seed: 1
"""


@dataclass(frozen=True)
class TwoBalls(Benchmark):
    """Simulate, run, compare, write the table."""

    output_dir: Path
    """Folder for session and results; what is there is used again."""
    preset: Preset = "fast"
    """Of the training."""

    def main(self) -> None:
        """Do what is missing, print the table, write it."""
        out = self.output_dir
        session, run = out / "session", out / self.preset
        out.mkdir(parents=True, exist_ok=True)
        if not session.is_dir():
            balls = []
            for diameter_m, x_m in zip(DIAMETERS_M, (-APART_M / 2.0, APART_M / 2.0), strict=True):
                ball = trimesh.creation.icosphere(5, diameter_m / 2.0)
                balls.append(ball.apply_translation([x_m, 0.0, diameter_m / 2.0]))
            trimesh.util.concatenate(balls).export(out / "balls.ply")
            text = SCENE.format(material=MATERIAL, effects=", ".join(EFFECTS))
            (out / "balls.yaml").write_text(text, encoding="utf-8")
            SimulateCommand(str(out / "balls.yaml"), session).main()
        traits = run / "traits" / "traits.json"
        if not traits.is_file():
            words = {"process": "--masks.pieces 2", "traits": "--splits 0"}
            RunCommand(session, run, preset=self.preset, num_points=60_000, **words).main()
        found = json.loads(traits.read_text(encoding="utf-8"))["pieces"]
        rows = []
        for diameter_m, one in zip(DIAMETERS_M, found, strict=True):
            true_ml, size = 1e6 * np.pi * diameter_m**3 / 6.0, one["size"]
            ratios = [1e3 * size["volume_l"] / true_ml, *(size[f"{k}_m"] / diameter_m for k in _LENGTHS)]
            errors = [f"{100.0 * (ratio - 1.0):+.1f} %" for ratio in ratios]
            name = f"ball of {1e3 * diameter_m:.0f} mm, {self.preset}"
            rows.append([name, f"{true_ml:.2f}", f"{1e3 * size['volume_l']:.2f}", *errors])
        write_results("two_balls", COLUMNS, rows, keys=1, folder=self.results)


if __name__ == "__main__":
    tyro.cli(TwoBalls, description=__doc__).main()
