"""Commands as steps in forks of this process, which share what it has imported.

nerfstudio and PyTorch take most of the time of a short command to import. A fork begins with them; it costs a few
milliseconds, and what it does stays in it. Where forks are not safe (macOS, and CUDA once it is in use), a step is a
process that starts anew.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path

from hsi_sc_nerf.benchmark.steps import (
    SCRIPTS,
    WITHOUT_COMPILER,
    StepCost,
    end_with_parent,
    finished_step,
    run_step,
    typed_command,
)


class ForkedSteps:
    """Runs commands as a user would type them; the first ones can be started before nerfstudio is imported.

    Example:
        >>> steps = ForkedSteps()
        >>> cost = steps.run("evaluate", ["ns-eval", "--load-config", "config.yml"], Path("evaluate.log"))
    """

    def __init__(self) -> None:
        os.environ.update(WITHOUT_COMPILER)  # read when a step or ``meanwhile`` imports PyTorch
        self._may_fork = sys.platform == "linux" and not Path("/dev/nvidiactl").exists()

    def run(self, name: str, words: Sequence[object], log: Path, meanwhile: Sequence[str] = ()) -> StepCost:
        """Run a command to its end.

        Args:
            name: name of the step.
            words: command; its progress bars appear on the terminal.
            log: file for its standard output.
            meanwhile: modules to import in this process while the step runs, for the forks that follow.

        Raises:
            InputError: the command failed; the message names its log.
        """
        if not self._may_fork:
            return run_step(name, typed_command(words), log)
        started = time.perf_counter()
        sys.stdout.flush()
        sys.stderr.flush()
        child = os.fork()
        if child == 0:
            _become(list(map(str, words)), log)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for module in meanwhile:
                importlib.import_module(module)
        return finished_step(name, child, started, log)


def _become(words: list[str], log: Path) -> None:
    """In a fork: run a command and end, with the status of a process of its own."""
    status = 1
    try:
        end_with_parent()
        with log.open("wb") as output:
            os.dup2(output.fileno(), 1)
        # Whoever runs the steps may have put something else in the place of standard output.
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
        # Warnings of libraries would hide the progress bars.
        warnings.simplefilter("ignore")
        name, *rest = words
        sys.argv = [name, *rest]
        plugins_are_there = "hsi_sc_nerf.config" in sys.modules
        module = importlib.import_module(SCRIPTS[name][0])
        if plugins_are_there:
            # A script imports the plugins, which then extend it; these were imported before it.
            importlib.import_module("hsi_sc_nerf.nerfstudio_commands").extend_nerfstudio_commands()
        getattr(module, SCRIPTS[name][1])()
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)  # what the parent does at its end is not the fork's to do
