"""Commands that run others as steps: ``run`` on a session, ``demo`` on a simulated one, compared with its truth."""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf import __version__
from hsi_sc_nerf.benchmark.configurations import split_words
from hsi_sc_nerf.benchmark.steps import StepCost, own_cost, run_step, typed_command
from hsi_sc_nerf.capture.session import is_session
from hsi_sc_nerf.cli.light import sentences
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write, make_folder, read_json, write_json
from hsi_sc_nerf.models.presets import Preset
from hsi_sc_nerf.processing.session_checks import CHECKS_PATH
from hsi_sc_nerf.settings_file import between, check_options

STEPS_NAME = "steps.json"
"""File of the output folder that says which steps were done with what; it marks the folder as a run's."""
MATERIAL_NAME = "point_cloud-material.json"
"""File of the output folder that says what was decided of the light on the object."""
DEMO_MARK = ".hsi-sc-nerf-demo"
"""File that marks the folder of a demo, whose contents may be replaced."""
StepRunner = Callable[[str, Sequence[str], Path], StepCost]
"""Runs a command; gets the step's name, the command and the file for its output."""

DEMO_TRAINING = {
    "preset": "fast",
    "evaluate-stages": "False",
    "steps-per-eval-batch": "1000000",
    "steps-per-eval-image": "1000000",
    "vis": "tensorboard",
}


@dataclass(frozen=True)
class Step:
    """A command of the run.

    Attributes:
        name: shown, and the name of the log.
        words: the command as a user would type it.
        inputs: files and folders that its results depend on.
        outputs: files that it leaves.
        needed: whether the run ends where it fails.
    """

    name: str
    words: tuple[str, ...]
    inputs: tuple[Path, ...]
    outputs: tuple[Path, ...]
    needed: bool = True

    def fingerprint(self, outside: Path) -> str:
        """Hash of command, version, and sizes and times of the inputs but for those inside the folder ``outside``."""
        digest = hashlib.sha256(json.dumps([__version__, self.words]).encode())
        for path in self.inputs:
            for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
                if file.is_file() and (path == file or outside not in file.parents):
                    state = file.stat()
                    digest.update(f"{file} {state.st_size} {state.st_mtime_ns}\n".encode())
        return digest.hexdigest()


@dataclass(frozen=True)
class RunCommand:
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
    preset: Preset = "balanced"
    """How long to train: on two cores without a GPU fast takes about one minute, balanced five and best twenty; on a
    GPU 10 seconds, one minute and seven."""
    max_num_iterations: int | None = between(1, math.inf, default=None)
    """Training steps of both stages together, in place of the preset's."""
    num_points: int = between(1, math.inf, default=200_000)
    """Number of points of the cloud."""
    process: str = ""
    """More words for `hsi-sc-nerf process`, joined to the option by an equals sign: --process="--poses colmap"."""
    train: str = ""
    """More words for `ns-train hsi-sc-nerf`, likewise: --train="--pipeline.model.head direct"."""
    material: str = ""
    """More words for `hsi-sc-nerf material`, likewise, such as the direction that the white reference faced:
    --material="--white-azimuth-deg -35"."""
    traits: str = ""
    """More words for `hsi-sc-nerf traits`, likewise: --traits="--index PRI --index CRI1"."""

    def main(self, run_step: StepRunner = run_step) -> None:
        """Run the steps that are not up to date and print what was found.

        Args:
            run_step: runs a step's command.

        Raises:
            InputError: a step failed, there is no session, or the output folder holds something else.
        """
        check_options(self)
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
        count = len(self._steps())
        for number in range(1, count + 1):
            # The traits are of the cloud that the material's step leaves, or not.
            step = self._steps()[number - 1]
            title = f"[bold]{number}/{count} {step.name}[/bold]"
            self._bring_up_to_date(step, console, title, run_step)
        _show_results(out, console)

    def _steps(self) -> list[Step]:
        """The commands, in order."""
        out = self.output_dir
        data, cloud, traits = out / "data", out / "point_cloud.ply", out / "traits"
        material = out / "point_cloud-material.ply"
        with_material = material if material.is_file() else cloud
        run = out / "training" / "hsi-sc-nerf" / "run"
        config, weights = run / "config.yml", run / "nerfstudio_models"
        packed = data / "transforms.json"
        training = ["ns-train", "hsi-sc-nerf", "--data", data, "--output-dir", out, "--experiment-name", "training"]
        training += ["--timestamp", "run", "--vis", "tensorboard", "--preset", self.preset]
        if self.max_num_iterations is not None:
            training += ["--max-num-iterations", self.max_num_iterations]
        evaluating = ["ns-eval", "--load-config", config, "--output-path", out / "eval.json"]
        exporting = ["ns-export", "pointcloud", "--load-config", config, "--output-dir", out]
        exporting += ["--num-points", self.num_points]
        reporting = ["hsi-sc-nerf", "report", run, "--output", out / "report.html", "--cloud", cloud]
        table: list[tuple[str, list[Any], tuple[Path, ...], tuple[Path, ...]]] = [
            (
                "process",
                ["hsi-sc-nerf", "process", self.session, "--output-dir", data, *split_words(self.process)],
                (self.session,),
                (packed,),
            ),
            ("train", [*training, *split_words(self.train)], (packed, data / "masks"), (config,)),
            ("evaluate", evaluating, (packed, weights), (out / "eval.json",)),
            ("export", exporting, (packed, weights), (cloud,)),
            (
                "material",
                ["hsi-sc-nerf", "material", cloud, "--load-config", config, *split_words(self.material)],
                (packed, weights, cloud),
                (material, out / MATERIAL_NAME),
            ),
            (
                "traits",
                [
                    "hsi-sc-nerf",
                    "traits",
                    with_material,
                    "--data",
                    data,
                    "--output-dir",
                    traits,
                    *split_words(self.traits),
                ],
                (packed, with_material),
                (traits / "traits.json",),
            ),
            (
                "report",
                [*reporting, "--traits", traits / "traits.json"],
                (packed, weights, cloud, traits / "traits.json"),
                (out / "report.html",),
            ),
        ]
        return [
            Step(name, tuple(map(str, words)), inputs, outputs, name != "material")
            for name, words, inputs, outputs in table
        ]

    def _bring_up_to_date(self, step: Step, console: Console, title: str, run_step: StepRunner) -> None:
        """Run a step unless its results are those of the same command and inputs."""
        steps_path = self.output_dir / STEPS_NAME
        done = read_json(steps_path, "delete it to make all steps again") if steps_path.is_file() else {}
        fingerprint = step.fingerprint(self.output_dir)
        before = done.get(step.name, {})
        same = before.get("fingerprint") == fingerprint
        if same and before["finished"] and all(path.is_file() for path in step.outputs):
            console.print(f"{title}: up to date")
            return
        words = [*step.words]
        if step.name == "train":
            run = step.outputs[0].parent
            if not same:
                shutil.rmtree(run, ignore_errors=True)
            elif any(run.glob("nerfstudio_models/*.ckpt")):
                words += ["--load-dir", str(run / "nerfstudio_models")]
        console.print(f"{title}\n{escape(shlex.join(words))}")
        entry = {"command": shlex.join(step.words), "fingerprint": fingerprint, "finished": False}
        write_json(steps_path, done | {step.name: entry})
        logs = self.output_dir / "logs"
        make_folder(logs)
        # A training whose last stage is kept was killed between its end and the next line of steps.json.
        if step.name != "train" or not (same and any(run.glob("stage-masked/*.ckpt"))):
            try:
                cost = run_step(step.name, typed_command(words), logs / f"{step.name}.log")
            except InputError as error:
                if step.needed:
                    raise
                for path in step.outputs:
                    path.unlink(missing_ok=True)
                console.print(f"[yellow]{escape(str(error))} The other steps do without.")
                return
            entry["seconds"] = round(cost.seconds, 1)
        missing = [path for path in step.outputs if not path.is_file()]
        if missing:
            raise InputError(f"{missing[0]}: was not written by the step '{step.name}'; its log is in {logs}.")
        write_json(steps_path, done | {step.name: entry | {"finished": True}})


def _show_results(out: Path, console: Console) -> None:
    """Print scores, sizes, warnings of the steps, and what to open."""
    results = json.loads((out / "eval.json").read_text(encoding="utf-8"))["results"]
    scores = "SAM {sam:.4f} rad, RMSE {rmse:.4f}, SSIM {ssim:.3f}, PSNR {psnr:.1f} dB".format(**results)
    console.print(f"Held-out views, inside the mask: {scores}")
    traits = json.loads((out / "traits" / "traits.json").read_text(encoding="utf-8"))
    size = traits["size"]
    volume = f"volume {1000 * size['volume_l']:.1f} mL" if traits["watertight"] else "no closed volume"
    console.print(f"Size: height {1000 * size['height_m']:.1f} mm, area {1e4 * size['area_m2']:.1f} cm², {volume}")
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

    Takes two to five minutes on two cores.
    """

    output_dir: Path = Path("hsi-sc-nerf-demo")
    """Folder for all results; an earlier demo there is replaced."""
    scene: str = "pear"
    """pear, apple, maize, tomato, pepper, sphere, cylinder, or the path of a scene file."""
    iterations: int | None = between(1, math.inf, default=None)
    """Training steps of both stages together, in place of those of `--preset fast`."""
    points: int = 60_000
    """Number of points of the cloud."""

    def main(self) -> None:
        """Run the demo.

        Raises:
            InputError: a step failed, or the folder cannot be used.
        """
        console, out = Console(), self.output_dir
        logs = out / "logs"
        make_folder(out)
        if any(out.iterdir()) and not (out / DEMO_MARK).is_file():
            raise InputError(f"{out}: holds something other than a demo; choose another --output-dir.")
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
        if self.iterations is not None:
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
