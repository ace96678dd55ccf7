"""Run a command as a step of its own, and tell what it cost."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hsi_sc_nerf.benchmark.machine import peak_memory_mib
from hsi_sc_nerf.errors import InputError


@dataclass(frozen=True)
class StepCost:
    """What a step cost.

    Attributes:
        name: the step.
        seconds: wall time, starting Python included.
        peak_memory_mib: most memory that it held at once.
    """

    name: str
    seconds: float
    peak_memory_mib: float


def run_step(name: str, argv: Sequence[str], log: Path) -> StepCost:
    """Run ``argv`` in a process of its own; its progress bars stay on the terminal, its report goes to ``log``.

    Raises:
        InputError: the command failed; the sentence names its log.
    """
    started = time.perf_counter()
    # Libraries' warnings about each other's versions would bury the progress bars.
    environment = os.environ | {"PYTHONWARNINGS": "ignore"}
    if environment.pop("PYTHONDONTWRITEBYTECODE", None):
        # Without compiled modules each start of nerfstudio takes twice as long; keep them beside the log.
        environment["PYTHONPYCACHEPREFIX"] = str(log.parent.resolve() / "pycache")
    with log.open("wb") as output:
        process = subprocess.Popen(list(argv), stdout=output, env=environment)
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            process.kill()
            process.wait()
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise InputError(
            f"the step '{name}' failed with status {process.returncode}; what it said is above and in {log}."
        )
    return StepCost(name, time.perf_counter() - started, peak_memory_mib(usage))


def own_cost(name: str, started: float) -> StepCost:
    """Cost of a step that ran in this process since ``started`` (`time.perf_counter`)."""
    return StepCost(name, time.perf_counter() - started, peak_memory_mib())


def nerfstudio_command(script: str) -> list[str]:
    """How to start one of nerfstudio's commands (``train``, ``eval``, ``exporter``) with this Python."""
    return [sys.executable, "-c", f"from nerfstudio.scripts.{script} import entrypoint; entrypoint()"]


def own_command() -> list[str]:
    """How to start `hsi-sc-nerf` with this Python."""
    return [sys.executable, "-m", "hsi_sc_nerf.cli.main"]
