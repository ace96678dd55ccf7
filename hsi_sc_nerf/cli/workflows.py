"""Commands that run others as steps: ``run`` on a session, ``demo`` on a simulated one, compared with its truth."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.analysis.report import each_object, scale_note
from hsi_sc_nerf.batch.session_steps import (
    MATERIAL_NAME,
    STEPS_NAME,
    SessionSettings,
    StepRunner,
    bring_up_to_date,
    session_steps,
)
from hsi_sc_nerf.benchmark.steps import StepCost, alone_in, own_cost, run_step, typed_command
from hsi_sc_nerf.capture.session import is_session
from hsi_sc_nerf.cli.light import sentences
from hsi_sc_nerf.cli.step_words import check_words
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write, content_of, make_folder
from hsi_sc_nerf.processing.session_checks import CHECKS_PATH
from hsi_sc_nerf.settings_file import between, check_options

DEMO_MARK = ".hsi-sc-nerf-demo"
"""File that marks the folder of a demo, whose contents may be replaced."""

DEMO_TRAINING = {
    "preset": "fast",
    "evaluate-stages": "False",
    "steps-per-eval-batch": "1000000",
    "steps-per-eval-image": "1000000",
    "vis": "tensorboard",
}


@dataclass(frozen=True)
class RunCommand(SessionSettings):
    """Process a session, train, evaluate, export the cloud, tell material and light apart, measure traits, report.

    Where the light on the object is uneven beyond noise, point_cloud-material.ply holds the reflectance of the
    material beside that measured, and so do the traits; the last lines say so.

    Each step is a command of its own, which is printed as it starts. A step is skipped while its inputs, its words
    and its results are unchanged. A run that was stopped goes on where it stopped, also within the training.
    """

    session: tyro.conf.Positional[Path]
    """Folder of the capture session."""
    output_dir: Path
    """Folder for the dataset, the trained run, the cloud, the traits and report.html."""

    def main(self, run_step: StepRunner = run_step) -> None:
        """Run the steps that are not up to date and print what was found.

        Raises:
            InputError: a step failed, there is no session, or the output folder holds something else or another run
                works there.
        """
        check_options(self)
        check_words(self, [self.output_dir])
        out = self.output_dir
        if not self.session.is_dir():
            raise InputError(f"{self.session}: is no folder; give that of a capture session.")
        if out.resolve() == self.session.resolve():
            raise InputError(f"{out}: is the session itself; choose another --output-dir.")
        if out.is_dir() and not (out / STEPS_NAME).is_file() and any(out.iterdir()):
            raise InputError(f"{out}: holds something other than a run of `hsi-sc-nerf run`; choose another folder.")
        if not is_session(self.session):
            raise InputError(f"{self.session}: holds no captures; give the folder of a capture session.")
        make_folder(out)
        console = Console(highlight=False, soft_wrap=True)
        with alone_in(out):
            self._bring_up_to_date(console, run_step)
        with content_of(out, "results that can be shown", f"delete its {STEPS_NAME} to make them again"):
            _show_results(out, console)

    def _bring_up_to_date(self, console: Console, run_step: StepRunner) -> None:
        out, count = self.output_dir, len(session_steps(self.session, self.output_dir, self))
        for number in range(count):
            # Anew each time: the traits are of the cloud that the material's step leaves, or not.
            step = session_steps(self.session, out, self)[number]
            title = f"[bold]{number + 1}/{count} {step.name}[/bold]"
            try:
                bring_up_to_date(step, out, console, title, run_step)
            except InputError as error:
                if step.needed:
                    raise
                step.remove_outputs()
                console.print(f"[yellow]{escape(str(error))} The other steps do without.")


def _show_results(out: Path, console: Console) -> None:
    """Print scores, sizes, warnings of the steps, and what to open."""
    results = json.loads((out / "eval.json").read_text(encoding="utf-8"))["results"]
    scores = "SAM {sam:.4f} rad, RMSE {rmse:.4f}, SSIM {ssim:.3f}, PSNR {psnr:.1f} dB".format_map(
        defaultdict(lambda: math.nan, results)  # a single band has no spectral angle
    )
    console.print(f"Held-out views, inside the mask: {scores}")
    traits = json.loads((out / "traits" / "traits.json").read_text(encoding="utf-8"))
    if note := scale_note(each_object(traits)[0]):
        console.print(f"[yellow]{note}")
    for one in each_object(traits):
        size, which = one["size"], f" of piece {one['piece']}" if "piece" in one else ""
        volume = f"volume {1000 * size['volume_l']:.1f} mL" if one["watertight"] else "no closed volume"
        height_mm, area_cm2 = 1000 * size["height_m"], 1e4 * size["area_m2"]
        console.print(f"Size{which}: height {height_mm:.1f} mm, area {area_cm2:.1f} cm², {volume}")
    if (out / MATERIAL_NAME).is_file():
        console.print(f"Light: {sentences(json.loads((out / MATERIAL_NAME).read_text(encoding='utf-8')))[0]}")
    for line in _warnings(out):
        console.print(f"[yellow]{escape(line)}")
    console.print(f"Open {escape(str(out / 'report.html'))} in a browser.", style="bold")


def _warnings(out: Path) -> Iterator[str]:
    """What `process` found that is not green, and lines of the steps' logs that warn."""
    checks = out / "data" / CHECKS_PATH
    found = json.loads(checks.read_text(encoding="utf-8"))["findings"] if checks.is_file() else []
    yield from (f"{one['name']}: {one['sentence']}" for one in found if one["level"] != "green")
    for log in sorted((out / "logs").glob("*.log")):
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("Warning"):
                yield f"{log.stem}: {line}"


@dataclass(frozen=True)
class DemoCommand:
    """Simulate a session of a fruit, reconstruct it, and compare the result with the truth.

    Takes one to three minutes on two cores.
    """

    output_dir: Path = Path("hsi-sc-nerf-demo")
    """Folder for all results; an earlier demo there is replaced."""
    scene: str = "pear"
    """pear, apple, maize, tomato, pepper, sphere, cylinder, or the path of a scene file."""
    iterations: int = between(1, math.inf, default=400)
    """Training steps of both stages together; `--preset fast` takes 800, or 1000 on a GPU."""
    points: int = between(1, math.inf, default=60_000)
    """Number of points of the cloud."""

    def main(self) -> None:
        """Run the demo.

        Raises:
            InputError: a step failed, or the folder cannot be used.
        """
        check_options(self)
        out = self.output_dir
        make_folder(out)
        if any(out.iterdir()) and not (out / DEMO_MARK).is_file():
            raise InputError(f"{out}: holds something other than a demo; choose another --output-dir.")
        with alone_in(out):
            self._reconstruct(Console(), out)

    def _reconstruct(self, console: Console, out: Path) -> None:
        logs = out / "logs"
        make_folder(logs)
        with atomic_write(out / DEMO_MARK) as (mark,):
            mark.write_text(
                "This folder belongs to `hsi-sc-nerf demo`, which replaces its contents.\n", encoding="utf-8"
            )
        session, data, runs = out / "session", out / "data", out / "runs"
        for earlier in (runs, out / "renders"):
            shutil.rmtree(earlier, ignore_errors=True)
        config = runs / "demo" / "hsi-sc-nerf" / "demo" / "config.yml"
        training: list[object] = ["ns-train", "hsi-sc-nerf", "--data", data, "--output-dir", runs]
        training += ["--experiment-name", "demo", "--timestamp", "demo"]
        training += ["--max-num-iterations", self.iterations]
        training += [word for key, value in DEMO_TRAINING.items() for word in (f"--{key}", value)]
        evaluating = ["ns-eval", "--load-config", config, "--output-path", out / "eval.json"]
        exporting = ["ns-export", "pointcloud", "--load-config", config, "--output-dir", out]
        commands: dict[str, list[object]] = {
            "simulate": ["hsi-sc-nerf", "simulate", self.scene, session],
            "process": ["hsi-sc-nerf", "process", session, "--output-dir", data],
            "train": training,
            "evaluate": [*evaluating, "--render-output-path", out / "renders"],
            "export": [*exporting, "--num-points", self.points],
        }
        costs: list[StepCost] = []
        for number, (name, words) in enumerate(commands.items(), start=1):
            console.print(f"[bold]{number}/{len(commands) + 1} {name}")
            costs.append(run_step(name, typed_command(words), logs / f"{name}.log"))
        console.print(f"[bold]{len(costs) + 1}/{len(commands) + 1} compare")
        started = time.perf_counter()
        # Deferred because Open3D takes seconds to import.
        from hsi_sc_nerf.cli.demo_report import draw_pictures, score, show_table, write_summary

        metrics, processing = score(out)
        draw_pictures(out)
        costs.append(own_cost("compare", started))
        write_summary(out, metrics, processing, costs)
        show_table(console, out, metrics, processing, costs)
