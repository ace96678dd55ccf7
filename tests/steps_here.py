"""Steps of `run` and `demo` in this process, which imports nerfstudio once for all of them."""

import sys
import time
from contextlib import contextmanager, redirect_stdout

import pytest

from hsi_sc_nerf.benchmark.steps import own_cost
from hsi_sc_nerf.cli.main import main
from hsi_sc_nerf.nerfstudio_commands import extend_nerfstudio_commands


@contextmanager
def steps_here():
    """What runs a step, in the place of ``hsi_sc_nerf.benchmark.steps.run_step``."""
    from nerfstudio.scripts import eval, exporter, train  # noqa: F401
    from nerfstudio.utils import writer

    extend_nerfstudio_commands()  # as at the end of their import by a console script
    with pytest.MonkeyPatch.context() as patch:

        def run_step(name, argv, log):
            """A process has a program after ``-c``, or our module after ``-m``."""
            _, kind, program, *words = argv
            patch.setattr(sys, "argv", [program, *words])
            patch.setattr(writer, "EVENT_WRITERS", [])  # those of other runs in this process
            started = time.perf_counter()
            with log.open("w") as output, redirect_stdout(output):
                main() if kind == "-m" else exec(program, {})
            return own_cost(name, started)

        yield run_step
