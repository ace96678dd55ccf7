"""One step of one object, as the workflow starts it: whatever happens to the session, its record says how it ended.

    python -m hsi_sc_nerf.batch.recorded_step OBJECT STEP [COPY]      (in the folder of the batch)

The workflow asks for records, not for results, so that a session that fails ends its own steps only. COPY is where
it wants the record, unless that is its own place.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rich.console import Console

from hsi_sc_nerf.batch.plan import STEPS, PlannedObject, read_plan
from hsi_sc_nerf.batch.session_steps import StepRunner, bring_up_to_date
from hsi_sc_nerf.benchmark.steps import StepCost, end_with_parent, run_step
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import make_folder, read_json, write_json

_TOLD = ("Error: ", "hsi-sc-nerf: ")
"""What the sentence of a failure begins with, in our commands and in nerfstudio's."""
_AGAIN = "delete it and start `hsi-sc-nerf batch` again"


def record_step(one: PlannedObject, name: str, run_step: StepRunner) -> None:
    """Bring a step up to date, unless one that it needs failed, and record how it ended.

    The record's status is ``done``, ``failed`` (the sentence says why) or ``skipped`` (an earlier step failed).

    Args:
        one: the object.
        name: name of the step.
        run_step: runs its command.
    """
    before = STEPS[: STEPS.index(name)]
    lost = [step for step in before if one.step(step).needed and _status(one, step) == "failed"]
    if lost:
        _write(one, name, "skipped", f"The step '{lost[0]}' failed.", StepCost(name, 0.0, 0.0))
        return
    step, log = one.step(name), one.folder / "logs" / f"{name}.txt"
    make_folder(one.folder)
    console = Console(highlight=False, soft_wrap=True)
    sentence, status, started = "", "done", time.perf_counter()

    def run(step_name: str, argv: Sequence[str], _: Path) -> StepCost:
        if name == "inspect":
            step.remove_outputs()
        try:
            return run_step(step_name, argv, log)
        except InputError as error:
            raise InputError(_told(log) or str(error)) from error

    try:
        cost = bring_up_to_date(step, one.folder, console, f"{one.folder.name} {name}", run)
    except InputError as error:
        cost = StepCost(name, time.perf_counter() - started, 0.0)
        sentence = str(error)
        # `inspect` ends so where it found something red as well, of which its result tells.
        if name != "inspect" or not step.outputs[0].is_file():
            status = "failed"
            if not step.needed:
                step.remove_outputs()
    _write(one, name, status, sentence, cost)


def runner_of(one: PlannedObject) -> StepRunner:
    """Runs commands in the folder that the batch was started in, where the user's words were checked.

    A pod need not have that folder; words for it hold absolute paths.
    """
    return partial(run_step, errors=subprocess.STDOUT, folder=one.caller if one.caller.is_dir() else None)


def copy_record(one: PlannedObject, name: str, copy: Path) -> None:
    """Copy a step's record to where Snakemake looks for it; its own place is left as it is."""
    if copy.resolve() != one.record(name).resolve():
        make_folder(copy.parent)
        shutil.copyfile(one.record(name), copy)


def _write(one: PlannedObject, name: str, status: str, sentence: str, cost: StepCost) -> None:
    # The page of all objects is handed on: it names files as they lie in the session and in the object's folder.
    for folder in (one.folder, one.session):
        sentence = sentence.replace(f"{folder}/", "").replace(str(folder), folder.name)
    content = {"step": name, "status": status, "seconds": round(cost.seconds, 1)}
    write_json(one.record(name), content | {"peak_memory_mib": round(cost.peak_memory_mib, 1), "sentence": sentence})


def _status(one: PlannedObject, name: str) -> str:
    record = one.record(name)
    status = read_json(record, _AGAIN).get("status")
    if status not in ("done", "failed", "skipped"):
        raise InputError(f"{record}: does not say how the step ended; {_AGAIN}.")
    return str(status)


def _told(log: Path) -> str:
    """The last sentence of a failure in a log."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.is_file() else []
    told = [line.removeprefix(start) for line in lines for start in _TOLD if line.startswith(start)]
    return told[-1].strip() if told else ""


if __name__ == "__main__":
    # Snakemake that is killed leaves its jobs; started again, it would have two of them write to one folder.
    end_with_parent()
    planned = read_plan(Path.cwd())[sys.argv[1]]
    record_step(planned, sys.argv[2], runner_of(planned))
    for path in sys.argv[3:]:
        copy_record(planned, sys.argv[2], Path(path))
