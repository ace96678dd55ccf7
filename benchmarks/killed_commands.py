"""Commands killed at random moments and started again, and commands that get Ctrl-C at random moments.

    uv run python benchmarks/killed_commands.py

Each command works on a small simulated session. An undisturbed run of it is the reference. One half of the moments is
spread over the time until the command has written all, the other over that from its first file on, where files can be
hit.

Commands are killed (SIGKILL) and started again, which is killed, and so on, training with ``--load-dir`` as soon as
there is a checkpoint. After some kills a command may run to its end, and must leave the same files with the same
bytes as the undisturbed run; checkpoints are compared tensor by tensor, bit by bit, and config.yml without the
folder that was loaded. TensorBoard's logs are not compared, for they hold times, and each start adds one; nor are
the speeds among the metrics of a stage. A file is half-written if it lies under its final name, has not the
reference's bytes, and cannot be read as JSON, PNG, checkpoint or settings. A moment that comes after the command's
end, which differs from run to run, is drawn again for a shorter duration. All durations are processor time of the
command, so that other work on the machine changes neither the moments nor what is taken for "goes on". With --keep, a
run that was stopped goes on with the next moments. Linux alone.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro
from left_files import differences, files_in, half_written, leftovers, state_of
from results_table import RESULTS, current_commit, write_results

from hsi_sc_nerf.benchmark.steps import typed_command
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session

KILLED = [
    "command",
    "undisturbed, s",
    "moments",
    "runs to the end",
    "half-written files",
    "other results",
    "leftovers",
]
STOPPED = ["command", "moments", "130 and one line", "ends otherwise", "goes on", "half-written files", "leftovers"]
STEPS, RAYS = 120, 128
KILLS_IN_A_ROW = 4
TRAINED = Path("e", "hsi-sc-nerf", "run")
# A command that uses so much processor time after Ctrl-C, or waits so long, has swallowed it.
_ENDS_S, _HANGS_S = 10.0, 600.0
_LOOK_EVERY_S = 0.01


@dataclass(frozen=True)
class KilledCommand:
    """A command that writes to the folder ``out`` of the current one."""

    name: str
    words: tuple[str, ...]

    def again(self, folder: Path) -> tuple[str, ...]:
        """What is typed after it was killed."""
        checkpoints = Path("out") / TRAINED / "nerfstudio_models"
        saved = self.words[0] == "ns-train" and any((folder / checkpoints).glob("step-*.ckpt"))
        return (*self.words, *(("--load-dir", str(checkpoints)) if saved else ()))


def commands(inputs: Path) -> list[KilledCommand]:
    """The commands; each works on what the references of those before it left in ``inputs``."""
    data, run, cloud = inputs / "process" / "out", inputs / "ns-train" / "out" / TRAINED, "point_cloud.ply"
    training = f"ns-train hsi-sc-nerf --data {data} --output-dir out --experiment-name e --timestamp run"
    training += f" --vis tensorboard --max-num-iterations {STEPS} --steps-per-save {STEPS // 5}"
    training += f" --pipeline.datamanager.train-num-rays-per-batch {RAYS} --steps-per-eval-batch {STEPS // 3}"
    return [
        KilledCommand(line.split()[0] if line.startswith("ns") else line.split()[1], tuple(line.split()))
        for line in (
            f"hsi-sc-nerf process {inputs / 'session'} --output-dir out",
            training,
            f"ns-export pointcloud --load-config {run / 'config.yml'} --output-dir out --num-points 2000",
            f"hsi-sc-nerf export --load-config {run / 'config.yml'} --output-dir out --num-points 2000",
            f"hsi-sc-nerf traits {inputs / 'ns-export' / 'out' / cloud} --data {data} --splits 0 --output-dir out",
        )
    ]


@dataclass(frozen=True)
class Moment:
    """Processor time after a command's start, or after its first file."""

    after_s: float
    writing: bool

    def comes(self, process: subprocess.Popen[bytes], folder: Path) -> bool:
        """Wait for it; False if the process ended before."""
        before = state_of(folder)
        while self.writing and state_of(folder) == before:
            if process.poll() is not None:
                return False
            time.sleep(_LOOK_EVERY_S)
        begun_s = processor_s(process) if self.writing else 0.0
        while process.poll() is None:
            if processor_s(process) - begun_s >= self.after_s:
                return True
            time.sleep(_LOOK_EVERY_S)
        return False

    def shorter(self) -> Moment:
        """The same moment of a command that takes less time."""
        return Moment(0.9 * self.after_s, self.writing)


def simulated(folder: Path) -> Path:
    """The session that all commands work on."""
    return simulate_session(override(load_scene("pear"), frames=10, size_px=112, bands=12), folder, progress=False)


def start(words: tuple[str, ...], folder: Path) -> subprocess.Popen[bytes]:
    """Start a command in ``folder``, in a process group of its own that Ctrl-C reaches; its output goes to a log."""
    folder.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "TORCHDYNAMO_DISABLE": "1", "TERM": "dumb"}
    environment["PYTHONWARNINGS"] = "ignore"
    if environment.pop("PYTHONDONTWRITEBYTECODE", None):
        environment["PYTHONPYCACHEPREFIX"] = str(Path(tempfile.gettempdir()) / "killed-commands-pycache")
    with (folder / "log").open("wb") as log:
        return subprocess.Popen(
            typed_command(words),
            cwd=folder,
            env=environment,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )


def processor_s(process: subprocess.Popen[bytes]) -> float:
    """Processor time that a process has used; the last of it stays readable until its end is asked for."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def undisturbed(command: KilledCommand, folder: Path) -> tuple[float, float, float]:
    """Run a command; its processor time until its first file, until all is written, and until its end.

    Raises:
        RuntimeError: it failed.
    """
    process, first_file_s, written_s, before = start(command.words, folder), 0.0, 0.0, state_of(folder)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    while process.poll() is None:
        used_s, state = processor_s(process), state_of(folder)
        if state != before:
            first_file_s, written_s, before = first_file_s or used_s, used_s, state
        time.sleep(_LOOK_EVERY_S)
    if process.returncode != 0:
        raise RuntimeError(f"{command.name}: {(folder / 'log').read_text()[-2000:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return first_file_s, written_s, after.ru_utime + after.ru_stime - children.ru_utime - children.ru_stime


def killed(command: KilledCommand, folder: Path, reference: Path, expected: list[Moment]) -> Counter[str]:
    """Kill a command at every moment, let it run to its end after some, and count what is wrong."""
    found: Counter[str] = Counter()
    shutil.rmtree(folder, ignore_errors=True)
    waiting, in_a_row = list(expected), 0
    while waiting:
        moment = waiting.pop(0)
        process = start(command.again(folder), folder)
        if moment.comes(process, folder):
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            in_a_row += 1
            half = half_written(folder / "out", reference / "out")
            found["half-written files"] += len(half)
            if half:
                print(f"{command.name} killed at {moment}: half-written: {', '.join(map(str, half))}", flush=True)
            if in_a_row < KILLS_IN_A_ROW and waiting:
                continue
            # A finished training has nothing to go on with, which is one sentence and status 1: its results decide.
            start(command.again(folder), folder).wait()
        else:
            waiting.append(moment.shorter())
        other, left = differences(reference / "out", folder / "out"), leftovers(folder / "out", reference / "out")
        if other or left:
            print(f"{command.name} after kills until {moment}: other {other}, left over {left}", flush=True)
        found += Counter({"runs to the end": 1, "other results": len(other), "leftovers": len(left)})
        shutil.rmtree(folder)
        in_a_row = 0
    return found


def in_pieces(
    expected: list[Moment], size: int, counted: Callable[[list[Moment]], Counter[str]], saved: Path
) -> Counter[str]:
    """What ``counted`` finds at all moments, ``size`` of them at a time, kept in a file after each time."""
    done, counts = 0, Counter[str]()
    if saved.is_file():
        content = json.loads(saved.read_text())
        done, counts = content["done"], Counter(content["counts"])
    for first in range(done, len(expected), size):
        counts += counted(expected[first : first + size])
        write_json(saved, {"done": first + size, "counts": counts})
    return counts


def pressed(command: KilledCommand, folder: Path, reference: Path, expected: list[Moment]) -> Counter[str]:
    """Press Ctrl-C once at every moment, each time in a new folder."""
    counts: Counter[str] = Counter()
    for moment in expected:
        found = None
        while found is None:
            shutil.rmtree(folder, ignore_errors=True)
            found = _stopped(command, folder, reference, moment)
            moment = moment.shorter()
        counts += found
    return counts


def _stopped(command: KilledCommand, folder: Path, reference: Path, moment: Moment) -> Counter[str] | None:
    """Press Ctrl-C once, and count how the command ends and what it leaves; None where it had ended."""
    found: Counter[str] = Counter()
    process = start(command.words, folder)
    if not moment.comes(process, folder):
        return None
    written = state_of(folder)
    swallowed = goes_on_after_ctrl_c(process)
    if process.returncode == 0 and state_of(folder) == written:
        return None  # all had been written
    told = (folder / "log").read_text(errors="replace")
    lines = [line for line in told.splitlines() if line.strip()]
    one_line = "Traceback" not in told and bool(lines) and "stopped" in lines[-1].lower()
    if process.returncode == 0 or swallowed:
        found["goes on"] = 1
    else:
        found["130 and one line" if process.returncode == 130 and one_line else "ends otherwise"] = 1
    found["half-written files"] = len(half_written(folder / "out", reference / "out"))
    left = [path for path in files_in(folder / "out") if ".partial-" in str(path) or "-writing" in str(path)]
    found["leftovers"] = len(left)
    if found["ends otherwise"] or found["goes on"] or left:
        print(f"{command.name}, Ctrl-C at {moment}, status {process.returncode}: {left}")
        print("    " + "\n    ".join(lines[-4:]), flush=True)
    return found


def goes_on_after_ctrl_c(process: subprocess.Popen[bytes], ends_s: float = _ENDS_S) -> bool:
    """Press Ctrl-C, and wait for the end; True where the process had to be killed."""
    before_s, since = processor_s(process), time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    while process.poll() is None:
        if processor_s(process) - before_s > ends_s or time.monotonic() - since > _HANGS_S:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return True
        time.sleep(_LOOK_EVERY_S)
    return False


def moments(count: int, first_file_s: float, written_s: float, rng: random.Random) -> Iterator[Moment]:
    """Random moments, one in each of equal parts of the time until all is written, then from the first file on."""
    lasts_s = {False: written_s, True: written_s - first_file_s}
    for writing, parts in ((False, count - count // 2), (True, count // 2)):
        for part in range(parts):
            yield Moment(lasts_s[writing] * (part + rng.random()) / parts, writing)


def main(
    kills: int = 20,
    presses: int = 10,
    seed: int = 0,
    only: str = "",
    keep: Path | None = None,
    results: Path = RESULTS,
) -> None:
    """Kill and interrupt every command, and write both tables.

    Args:
        kills: moments at which each command is killed; with 0, the table's rows stay.
        presses: moments at which each command gets Ctrl-C; likewise.
        seed: of both.
        only: part of the names of the commands to disturb; the other rows of the tables are kept.
        keep: folder for the session, the undisturbed results and what was counted; what lies there is not made again.
        results: folder of the tables.

    Raises:
        SystemExit: no command has such a name.
    """
    names = [command.name for command in commands(Path())]
    if not any(only in name for name in names):
        raise SystemExit(f"--only {only}: no command has that in its name; take one of {', '.join(names)}.")
    with tempfile.TemporaryDirectory() as temporary:
        inputs, folder = (keep or Path(temporary) / "inputs").absolute(), Path(temporary) / "disturbed"
        if not (inputs / "session").is_dir():
            simulated(inputs / "session")
            undisturbed(commands(inputs)[0], Path(temporary) / "first")  # compiles what the others find
        every = commands(inputs)
        last = max(number for number, command in enumerate(every) if only in command.name)
        for command in every[: last + 1]:
            if only not in command.name and (inputs / command.name).is_dir():
                continue
            # Moments of another commit, or of another number of them, are others.
            counted = inputs / "counted" / f"{current_commit()}-{seed}-{kills}-{presses}-{command.name}"
            durations = counted / "durations.json"
            if not (durations.is_file() and (inputs / command.name).is_dir()):
                shutil.rmtree(inputs / command.name, ignore_errors=True)
                write_json(durations, {"all": undisturbed(command, inputs / command.name)})
            first_file_s, written_s, seconds = json.loads(durations.read_text())["all"]
            if only not in command.name:
                continue
            rng, reference = random.Random(f"{seed} {command.name}"), inputs / command.name
            for name, columns, count, size, count_at in (
                ("killed_commands", KILLED, kills, KILLS_IN_A_ROW, killed),
                ("interrupted_commands", STOPPED, presses, 1, pressed),
            ):
                expected = list(moments(count, first_file_s, written_s, rng))
                if not expected:
                    continue
                rng.shuffle(expected)
                counting = partial(count_at, command, folder, reference)
                counts = in_pieces(expected, size, counting, counted / f"{name}.json")
                known = {"command": command.name, "undisturbed, s": f"{seconds:.1f}", "moments": count}
                row = [str(known.get(column, counts[column])) for column in columns]
                write_results(name, columns, [row], keys=1, seed=str(seed), folder=results)


if __name__ == "__main__":
    tyro.cli(main)
