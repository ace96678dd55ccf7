"""What accuracy costs in time: the demo with training runs of several lengths, as a table.

    uv run python benchmarks/accuracy_and_time.py --output-dir /tmp/accuracy --iterations 125 250 500 1000

Every row is a whole demo of its own (simulate, process, train, evaluate, export, compare); a row that is already
there is not run again.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class AccuracyAndTime:
    """Run the demo with training runs of several lengths and compare them."""

    output_dir: Path
    """Folder for the demos and for table.json."""
    iterations: tuple[int, ...] = (125, 250, 500, 1000)
    """Training steps of each run."""
    scene: str = "pear"
    """What stands on the turntable."""

    def main(self) -> None:
        """Run the demos and print the table."""
        table = Table("iterations", "train, s", "all, s", "SAM, rad", "RMSE", "SSIM", "PSNR, dB", "F-score, %")
        rows = []
        for iterations in self.iterations:
            out = self.output_dir / f"{self.scene}-{iterations}"
            if not (out / "summary.json").exists():
                words = ["demo", "--scene", self.scene, "--output-dir", str(out), "--iterations", str(iterations)]
                subprocess.run([sys.executable, "-m", "hsi_sc_nerf.cli.main", *words], check=True)
            summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
            metrics = summary["metrics"]
            train_s = next(step["seconds"] for step in summary["steps"] if step["name"] == "train")
            rows.append({"iterations": iterations, "train_s": train_s, "all_s": summary["seconds"], **metrics})
            table.add_row(
                str(iterations),
                f"{train_s:.0f}",
                f"{summary['seconds']:.0f}",
                *(f"{metrics[key]:.3f}" for key in ("sam", "rmse", "ssim")),
                *(f"{metrics[key]:.1f}" for key in ("psnr", "f_score")),
            )
        (self.output_dir / "table.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        Console().print(table)


if __name__ == "__main__":
    tyro.cli(AccuracyAndTime).main()
