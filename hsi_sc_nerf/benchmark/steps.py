"""Commands as steps in processes of their own: what they cost, and on which machine."""

from __future__ import annotations

import ctypes
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from hsi_sc_nerf.errors import InputError

if TYPE_CHECKING:
    from resource import struct_rusage

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_PACKAGES = ("hsi-sc-nerf", "nerfstudio", "torch", "numpy")
SPINS = 3000
"""Times that a thread of OpenMP looks whether another one is ready before it sleeps, about ten microseconds. By
default it looks for a millisecond; on a busy machine the other one does not run meanwhile (docs/how-to/run.md)."""
_RSS_UNIT_BYTES = 1 if sys.platform == "darwin" else 1024


@dataclass(frozen=True)
class StepCost:
    """Time and memory of a step.

    Attributes:
        name: name of the step.
        seconds: wall time, start of Python included.
        peak_memory_mib: peak resident memory.
    """

    name: str
    seconds: float
    peak_memory_mib: float


def run_step(
    name: str, argv: Sequence[str], log: Path, errors: int | None = None, folder: Path | None = None
) -> StepCost:
    """Run a command in a process of its own.

    Args:
        name: name of the step.
        argv: command; its progress bars appear on the terminal.
        log: file for its standard output.
        errors: `subprocess.STDOUT` where errors and progress go there as well.
        folder: to run it in; by default the working folder.

    Raises:
        InputError: the command failed; the message names its log. Or the system measures no processes.
    """
    require_posix()
    started = time.perf_counter()
    # Warnings of libraries would hide the progress bars. Nothing here is compiled by PyTorch, but nerfstudio's import
    # compiles two functions of a method that is not used, for which PyTorch loads its compiler for seconds.
    # By the last one Python (from 3.11 on) takes no file of the working folder for a module of its name.
    defaults = {"TORCHDYNAMO_DISABLE": "1", "GOMP_SPINCOUNT": str(SPINS), "PYTHONSAFEPATH": "1"}
    environment = defaults | os.environ | {"PYTHONWARNINGS": "ignore"}
    if environment.pop("PYTHONDONTWRITEBYTECODE", None):
        # Compiled modules halve the start of nerfstudio; they are kept beside the log.
        environment["PYTHONPYCACHEPREFIX"] = str(log.parent.resolve() / "pycache")
    with log.open("wb") as output:
        # A step that outlives its run would write into the folder of the next one.
        orphans = end_with_parent if sys.platform == "linux" else None
        process = subprocess.Popen(
            list(argv), stdout=output, stderr=errors, env=environment, preexec_fn=orphans, cwd=folder
        )
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            process.kill()
            process.wait()
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        where = "above and in" if errors is None else "in"
        ended = f"failed with status {process.returncode}"
        if process.returncode < 0:
            ended = f"was ended by the system (signal {-process.returncode})"
        if process.returncode == -signal.SIGKILL:
            ended += ", most often because memory ran out: close other programs, or give it more memory"
        raise InputError(f"the step '{name}' {ended}; its output is {where} {log}.")
    return StepCost(name, time.perf_counter() - started, peak_memory_mib(usage))


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other commands that run steps out of a folder, until the block or this process ends.

    Raises:
        InputError: another one works there.
    """
    require_posix()
    import fcntl  # not on Windows

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"{folder}: another command works there; wait for it, or choose another.") from error
        except OSError:
            pass  # a network drive that has no locks
        yield
    finally:
        os.close(descriptor)


def require_posix() -> None:
    """Refuse systems that do not tell what another process cost.

    Raises:
        InputError: this is one of them, such as Windows.
    """
    if not hasattr(os, "wait4"):
        raise InputError(
            "this command works on Linux and macOS only; on Windows, call it in WSL (a Linux in Windows)."
        )


def own_cost(name: str, started: float) -> StepCost:
    """Cost of a step in this process since ``started`` (`time.perf_counter`)."""
    return StepCost(name, time.perf_counter() - started, peak_memory_mib())


def typed_command(words: Sequence[object]) -> list[str]:
    """Command that runs with this Python what a user would type, such as ``("ns-train", "hsi-sc-nerf", ...)``."""
    name, *rest = map(str, words)
    if name == "hsi-sc-nerf":
        return [sys.executable, "-m", "hsi_sc_nerf.cli.main", *rest]
    script = {"ns-train": "train", "ns-eval": "eval", "ns-export": "exporter"}[name]
    return [sys.executable, "-c", f"from nerfstudio.scripts.{script} import entrypoint; entrypoint()", *rest]


def end_with_parent() -> None:
    """In a new process: end when the process that started it is killed (Linux; elsewhere nothing is done)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def peak_memory_mib(usage: struct_rusage | None = None) -> float:
    """The most memory that a process held at once; without its ``usage``, of this one."""
    import resource  # not on Windows, where the commands that measure no memory run

    usage = usage or resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_maxrss * _RSS_UNIT_BYTES / 2**20


def describe_machine() -> dict[str, str]:
    """System, processor, cores, accelerator and versions, in words."""
    import torch

    machine = {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": str(available_cores()),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "python": platform.python_version(),
    }
    return machine | {package: version(package) for package in _PACKAGES}


def _processor() -> str:
    """Model name of the processor where the system tells it (Linux), otherwise what Python calls it."""
    facts = Path("/proc/cpuinfo")
    if facts.is_file():
        for line in facts.read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or "unknown"
