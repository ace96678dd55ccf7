"""The workflow of `batch` with its real commands, each forked from one process that has imported them.

    python tests/forked_steps.py serve SOCKET
    python tests/forked_steps.py step SOCKET OBJECT STEP      (in the folder of the batch, as the workflow does)

Imports are more than half of the processor time of a step of a small session. All else is as in
`hsi_sc_nerf.batch.recorded_step`: a process a step, its record, its log.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import traceback
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def forked_workflow(folder):
    """The shipped workflow with these steps, as a Snakefile in ``folder``, while the server runs."""
    from hsi_sc_nerf.cli.batch import SNAKEFILE

    text, address = SNAKEFILE.read_text(), folder / "steps.socket"
    assert text.count("-m hsi_sc_nerf.batch.recorded_step ") == 1
    path = folder / "Snakefile"
    path.write_text(text.replace("-m hsi_sc_nerf.batch.recorded_step ", f"{__file__} step {address} "))
    # Threads of the process that is forked would be missing in its copies, which would wait for them.
    single = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    server = subprocess.Popen([sys.executable, __file__, "serve", str(address)], env=os.environ | single)
    try:
        while not address.exists():
            assert server.poll() is None
            time.sleep(0.05)
        yield path
    finally:
        server.kill()
        server.wait()


def serve(address):
    """Fork a process for each step that is asked for, and another one that answers with its exit status."""
    from nerfstudio.scripts import eval, exporter, train  # noqa: F401

    from hsi_sc_nerf.analysis import closed_mesh, pictures, report, traits  # noqa: F401
    from hsi_sc_nerf.benchmark.steps import end_with_parent
    from hsi_sc_nerf.cli import clouds, light, sessions, trained_runs  # noqa: F401
    from hsi_sc_nerf.nerfstudio_commands import extend_nerfstudio_commands

    end_with_parent()
    extend_nerfstudio_commands()  # as at the end of their import by a console script
    listening = socket.socket(socket.AF_UNIX)
    listening.bind(f"{address}.new")
    listening.listen()
    os.rename(f"{address}.new", address)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those that answer
    while True:
        connection, _ = listening.accept()
        if os.fork() == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            step = os.fork()
            if step == 0:
                do_step(**json.loads(connection.makefile().readline()))
            connection.sendall(b"%d" % os.waitstatus_to_exitcode(os.waitpid(step, 0)[1]))
            os._exit(0)
        connection.close()


def do_step(folder, name, step):
    """A step and its record, in this process, which ends with it."""
    from hsi_sc_nerf.batch.plan import read_plan
    from hsi_sc_nerf.batch.recorded_step import record_step

    status = 1
    try:
        os.chdir(folder)
        planned = read_plan(Path.cwd())[name]
        os.chdir(planned.caller)
        record_step(planned, step, run_here)
        status = 0
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def run_here(name, argv, log):
    """A command in this process; it has a program after ``-c``, or our module after ``-m``."""
    from hsi_sc_nerf.benchmark.steps import own_cost
    from hsi_sc_nerf.cli.main import main
    from hsi_sc_nerf.errors import InputError

    _, kind, program, *sys.argv[1:] = argv
    sys.argv[0] = program
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as output:
        for stream in (1, 2):
            os.dup2(output.fileno(), stream)
    started = time.perf_counter()
    try:
        main() if kind == "-m" else exec(program, {})
    except SystemExit as end:
        if end.code:
            sys.stdout.flush()
            sys.stderr.flush()
            raise InputError(f"the step '{name}' failed with status {end.code}; its output is in {log}.") from end
    return own_cost(name, started)


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(sys.argv[2])
    with socket.socket(socket.AF_UNIX) as asking:
        asking.settimeout(600)
        asking.connect(sys.argv[2])
        asking.sendall(json.dumps({"folder": os.getcwd(), "name": sys.argv[3], "step": sys.argv[4]}).encode() + b"\n")
        sys.exit(int(asking.recv(16) or 1))
