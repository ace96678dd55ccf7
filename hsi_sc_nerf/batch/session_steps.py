"""The commands of one session, from captures to a report: what `run` and the workflow of `batch` both do."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shlex
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf import __version__
from hsi_sc_nerf.analysis.library import envi_pair
from hsi_sc_nerf.benchmark.configurations import split_words
from hsi_sc_nerf.benchmark.steps import StepCost, typed_command
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import make_folder, read_json, write_json
from hsi_sc_nerf.models.presets import Preset
from hsi_sc_nerf.number_table import read_notes
from hsi_sc_nerf.settings_file import between

STEPS_NAME = "steps.json"
"""File of the output folder that says which steps were done with what; it marks the folder as a run's."""
MATERIAL_NAME = "point_cloud-material.json"
"""File of the output folder that says what was decided of the light on the object."""
OPTIONAL_STEPS = ("inspect", "material")
"""Where one of these fails, the others do without."""
WORDED_STEPS = ("process", "train", "material", "traits")
"""Those for which the settings of their names hold more words."""
_DATASET_NAME = "transforms.json"
"""The file of a dataset that tells of its frames."""
_ENVI = (".sli", ".hdr", "")
"""Endings of the two files of an ENVI library."""
StepRunner = Callable[[str, Sequence[str], Path], StepCost]
"""Runs a command; gets the step's name, the command and the file for its output."""


@dataclass(frozen=True)
class Step:
    """A command of the run.

    Attributes:
        name: shown, and the name of the log.
        words: the command as a user would type it; the run's own paths are `Path`, the user's words text.
        inputs: files and folders that its results depend on.
        outputs: files that it leaves.
    """

    name: str
    words: tuple[str | Path, ...]
    inputs: tuple[Path, ...]
    outputs: tuple[Path, ...]

    @property
    def needed(self) -> bool:
        """Whether the others cannot do without it."""
        return self.name not in OPTIONAL_STEPS

    def fingerprint(self, outside: Path) -> str:
        """Hash of command, version, and sizes and times of the inputs but for those in the folder ``outside``.

        An input that lies in that folder itself is a result of an earlier step, and counts. It is the same from
        whatever folder the command is called, and after session and results were moved.
        """
        outside = outside.resolve()
        words = [_within(outside, word) if isinstance(word, Path) else word for word in self.words]
        digest = hashlib.sha256(json.dumps([__version__, words]).encode())
        for path in map(Path.resolve, self.inputs):
            inside = outside in path.parents
            root = outside if inside else path if path.is_dir() else path.parent
            for file in _files_below(path, None if inside else outside) if path.is_dir() else [path]:
                if file.is_file():
                    state = file.stat()
                    digest.update(f"{file.relative_to(root)} {state.st_size} {state.st_mtime_ns}\n".encode())
        return digest.hexdigest()

    def was_tried(self, out: Path) -> bool:
        """Whether it was started with the same command and inputs, however it ended."""
        return bool(_entries(out).get(self.name, {}).get("fingerprint") == self.fingerprint(out))

    def remove_outputs(self) -> None:
        """Remove what the command left, such as half of its results where it failed."""
        for path in self.outputs:
            path.unlink(missing_ok=True)


def _files_below(folder: Path, outside: Path | None) -> list[Path]:
    """Files of a folder, also behind links to folders, each folder once; without those in ``outside``."""
    found: list[Path] = []
    entered: set[Path] = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        here = Path(place).resolve()
        if here in entered or (outside is not None and here.is_relative_to(outside)):
            folders.clear()
            continue
        entered.add(here)
        found += [Path(place, name) for name in names]
    return sorted(found)


@dataclass(frozen=True, kw_only=True)
class SessionSettings:
    """What a user may choose of the steps."""

    preset: Preset = "balanced"
    """How long to train: fast for a first look (a hollow may stay closed), balanced, or best, which gains little
    without a GPU; the times are in docs/validation/accuracy_and_time.md."""
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


def session_steps(session: Path, out: Path, settings: SessionSettings, folder: Path = Path()) -> list[Step]:
    """The commands from a session to its report, in order.

    Args:
        session: folder of the captures.
        out: folder for all results. The traits are of the cloud that the material's step leaves there, or not.
        settings: what the user chose.
        folder: that relative paths in the user's words start from.

    Example:
        >>> [step.name for step in session_steps(Path("session"), Path("out"), SessionSettings())][:3]
        ['process', 'train', 'evaluate']
    """
    data, cloud, traits = out / "data", out / "point_cloud.ply", out / "traits"
    material = out / "point_cloud-material.ply"
    with_material = material if material.is_file() else cloud
    run = out / "training" / "hsi-sc-nerf" / "run"
    config, weights = run / "config.yml", run / "nerfstudio_models"
    packed, measured = data / _DATASET_NAME, traits / "traits.json"
    training = ["ns-train", "hsi-sc-nerf", "--data", data, "--output-dir", out, "--experiment-name", "training"]
    training += ["--timestamp", "run", "--vis", "tensorboard", "--preset", settings.preset]
    if settings.max_num_iterations is not None:
        training += ["--max-num-iterations", settings.max_num_iterations]
    evaluating = ["ns-eval", "--load-config", config, "--output-path", out / "eval.json"]
    exporting = ["ns-export", "pointcloud", "--load-config", config, "--output-dir", out]
    exporting += ["--num-points", settings.num_points]
    measuring = ["hsi-sc-nerf", "traits", with_material, "--data", data, "--output-dir", traits]
    reporting = ["hsi-sc-nerf", "report", run, "--output", out / "report.html", "--cloud", cloud]
    reporting += ["--traits", measured]

    def step(name: str, words: list[Any], inputs: tuple[Path, ...], *outputs: Path) -> Step:
        own = getattr(settings, name) if name in WORDED_STEPS else ""
        typed = (word if isinstance(word, Path) else str(word) for word in (*words, *split_words(own)))
        return Step(name, tuple(typed), (*inputs, *_named_files(own, folder)), outputs)

    return [
        step("process", ["hsi-sc-nerf", "process", session, "--output-dir", data], (session,), packed),
        step("train", training, (packed, data / "masks"), config),
        step("evaluate", evaluating, (packed, weights), out / "eval.json"),
        step("export", exporting, (packed, weights), cloud),
        step(
            "material",
            ["hsi-sc-nerf", "material", cloud, "--load-config", config],
            (packed, weights, cloud),
            *(material, out / MATERIAL_NAME),
        ),
        step("traits", measuring, (packed, with_material), measured),
        step("report", reporting, (packed, weights, cloud, measured), out / "report.html"),
    ]


def is_up_to_date(step: Step, out: Path) -> bool:
    """Whether a step's results are there, of the same command and inputs."""
    return _is_finished(step, _entries(out).get(step.name, {}), step.fingerprint(out))


def bring_up_to_date(step: Step, out: Path, console: Console, title: str, run_step: StepRunner) -> StepCost:
    """Run a step unless its results are those of the same command and inputs; a training goes on where it stopped.

    Args:
        step: one of `session_steps`.
        out: folder of the results.
        console: for the title and the command.
        title: title of the step.
        run_step: runs the command.

    Returns:
        What it cost, now or when it was done.

    Raises:
        InputError: it failed, or left no results.
    """
    # Once: of a session it looks at all files, which may lie on a slow network.
    done, fingerprint = _entries(out), step.fingerprint(out)
    before = done.get(step.name, {})
    if _is_finished(step, before, fingerprint):
        console.print(f"{title}: up to date")
        return _cost(step.name, before)
    words: list[str | Path] = [*step.words]
    same = before.get("fingerprint") == fingerprint
    run = step.outputs[0].parent
    if step.name == "train":
        if not same:
            shutil.rmtree(run, ignore_errors=True)
        elif any(run.glob("nerfstudio_models/*.ckpt")):
            words += ["--load-dir", run / "nerfstudio_models"]
    console.print(f"{title}\n{escape(shlex.join(map(str, words)))}")
    command = shlex.join(map(str, step.words))
    entry: dict[str, Any] = {"command": command, "fingerprint": fingerprint, "finished": False}
    write_json(out / STEPS_NAME, done | {step.name: entry})
    logs = out / "logs"
    make_folder(logs)
    # A training whose last stage is kept was killed between its end and the next line of steps.json.
    if step.name != "train" or not (same and any(run.glob("stage-masked/*.ckpt"))):
        cost = run_step(step.name, typed_command(words), logs / f"{step.name}.log")
        entry |= {"seconds": round(cost.seconds, 1), "peak_memory_mib": round(cost.peak_memory_mib, 1)}
    missing = [path for path in step.outputs if not path.is_file()]
    if missing:
        raise InputError(f"{missing[0]}: was not written by the step '{step.name}'; its log is in {logs}.")
    write_json(out / STEPS_NAME, done | {step.name: entry | {"finished": True}})
    return _cost(step.name, entry)


def _named_files(text: str, folder: Path) -> list[Path]:
    """Files that the user's words name, also behind an equals sign; of a dataset's folder ``transforms.json``.

    Of an ENVI library they are both files, and with a calibration's table goes the model that it names.
    """
    named = [folder / value for word in split_words(text) for value in (word, word.partition("=")[2]) if value]
    # `os.path` takes names that are too long for a file, such as formulas.
    files = [path for one in named for path in (one, one / _DATASET_NAME) if os.path.isfile(path)]
    return [path for one in files for path in (one, *_with(one))]


def _with(path: Path) -> Iterator[Path]:
    """What is read where a file is named, beside it."""
    if path.suffix.lower() in _ENVI:
        with suppress(InputError):
            yield from envi_pair(path)
    with suppress(OSError, ValueError):
        if model := read_notes(path).get("model"):
            yield path.with_name(Path(model).name)


def _within(folder: Path, path: Path) -> str:
    """A path as it lies in the folder; of the session, which lies elsewhere, the files count and not the place."""
    path = path.resolve()
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else ""


def _is_finished(step: Step, entry: dict[str, Any], fingerprint: str) -> bool:
    finished = entry.get("fingerprint") == fingerprint and entry.get("finished") is True
    return finished and all(path.is_file() for path in step.outputs)


def _cost(name: str, entry: dict[str, Any]) -> StepCost:
    return StepCost(name, entry.get("seconds", 0.0), entry.get("peak_memory_mib", 0.0))


def _entries(out: Path) -> dict[str, Any]:
    """What the output folder says of its steps, by name; what is damaged is not believed."""
    path = out / STEPS_NAME
    found = read_json(path, "delete it to make all steps again") if path.is_file() else {}
    return {name: entry for name, entry in found.items() if isinstance(entry, dict) and _has_costs(entry)}


def _has_costs(entry: dict[str, Any]) -> bool:
    costs = [entry.get(name, 0.0) for name in ("seconds", "peak_memory_mib")]
    return all(isinstance(cost, float | int) and 0.0 <= cost < 1e12 for cost in costs)
