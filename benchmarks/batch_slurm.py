"""A batch of small sessions on a SLURM cluster of one node, which loses its power half-way.

    apt-get install slurm-wlm munge
    uv run python benchmarks/batch_slurm.py

Starts Debian's munged, slurmctld and slurmd as root, with files of their own in a temporary folder, whose slurm.conf
/etc/slurm/slurm.conf points at meanwhile (where there is one, nothing is done), and
`hsi-sc-nerf batch --executor slurm` on the six sessions of ``six_sessions.py``, of which one is broken and one has no
markers. As soon as the training of pear_2 has left a checkpoint, slurmd and all processes of its jobs are killed
(SIGKILL) and slurmd is started anew. If the batch ends early for that, it is started again. At the end every step
should have its record, the four whole sessions their report, and the two others a sentence in traits.csv.
"""

from __future__ import annotations

import csv
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NoReturn

import tyro
from results_table import RESULTS, write_results
from six_sessions import OBJECTS, TRAIN, TRAITS, write_six_sessions

from hsi_sc_nerf.batch.plan import STEPS, read_plan
from hsi_sc_nerf.benchmark.steps import available_cores, typed_command
from hsi_sc_nerf.files import read_json

COLUMNS = ["sessions", "broken", "without markers", "SLURM jobs", "jobs killed", "starts", "trainings that went on"]
COLUMNS += ["records", "reports", "failed with a sentence", "seconds"]
CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmctldPort=17817
SlurmdPort=17818
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
ReturnToService=2
SlurmdTimeout=15
MinJobAge=600
MpiDefault=none
SwitchType=switch/none
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={memory_mb} State=UNKNOWN
PartitionName=lab Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
# Not SLURM_CONF: the jobs of Snakemake's plugin have no variables of SLURM's own.
CONFIGURATION_PATH = Path("/etc/slurm/slurm.conf")
MARK = "HSI_SC_NERF_CLUSTER"
"""Stands in the surroundings of every process of the cluster."""


class Cluster:
    """munged, slurmctld and slurmd in a folder; ended at the end of the ``with`` block."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.host = folder, socket.gethostname()
        self.environment = os.environ | {MARK: str(folder)}
        self._ends = ExitStack()

    def __enter__(self) -> Cluster:
        memory_mb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
        for name in ("state", "spool"):
            (self.folder / name).mkdir(parents=True)
        text = CONFIGURATION.format(
            host=self.host, folder=self.folder, cores=available_cores(), memory_mb=memory_mb - 500
        )
        (self.folder / "slurm.conf").write_text(text)
        CONFIGURATION_PATH.symlink_to(self.folder / "slurm.conf")
        self._ends.callback(CONFIGURATION_PATH.unlink)
        key = self.folder / "munge.key"
        key.write_bytes(os.urandom(64))
        key.chmod(0o600)
        files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
        munge = [f"--{option}={self.folder}/munge.{name}" for option, name in files.items()]
        self._start("munged", "--foreground", "--force", *munge)
        time.sleep(2)
        self._start("slurmctld", "-D")
        self.node = self._start("slurmd", "-D", "-N", self.host)
        return self

    def __exit__(self, *error: object) -> None:
        self._kill_jobs()
        self._ends.close()

    def lose_power(self) -> None:
        """Kill slurmd and whatever it runs, wait until the cluster knows, and start slurmd anew."""
        self.node.kill()
        self.node.wait()
        self._kill_jobs()
        time.sleep(20)
        self.node = self._start("slurmd", "-D", "-N", self.host)

    def output(self, *words: str) -> str:
        """What one of SLURM's commands prints."""
        return subprocess.run(words, env=self.environment, capture_output=True, text=True).stdout

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        with (self.folder / f"{words[0]}.output").open("ab") as log:
            process = subprocess.Popen(words, env=self.environment, stdout=log, stderr=log)
        self._ends.callback(process.wait)
        self._ends.callback(process.kill)
        return process

    def _kill_jobs(self) -> None:
        """Kill what SLURM started: marked processes of other terminal sessions than this script's."""
        for entry in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                marked = f"{MARK}={self.folder}\0".encode() in (entry / "environ").read_bytes()
                if marked and os.getsid(int(entry.name)) != os.getsid(0):
                    os.kill(int(entry.name), signal.SIGKILL)


def start(cluster: Cluster, sessions: Path, out: Path, steps: int) -> subprocess.Popen[bytes]:
    """Start the batch on the cluster; its output goes to a log."""
    command = ["hsi-sc-nerf", "batch", sessions, "--output-dir", out, "--max-num-iterations", steps]
    command += ["--num-points", 1000, f"--train={TRAIN} --steps-per-save 10", f"--traits={TRAITS}", "--no-gpu"]
    command += ["--executor", "slurm", "--jobs", 8, "--slurm-status-command", "squeue"]
    command += ["--slurm-init-seconds-before-status-checks", 5]
    command += ["--default-resources", "runtime=30", "slurm_partition=lab"]
    # As many jobs at once as the node has cores; steps of such small sessions do not use two.
    command += ["--set-threads", *(f"{step}=1" for step in STEPS)]
    with out.with_suffix(".log").open("ab") as log:
        return subprocess.Popen(typed_command(command), env=cluster.environment, stdout=log, stderr=subprocess.STDOUT)


def give_up(out: Path) -> NoReturn:
    """End with what the batch and its jobs said last."""
    logs = [out.with_suffix(".log"), *out.glob(".snakemake/slurm_logs/**/*.log")]
    sys.exit("\n".join(f"{log}:\n{log.read_text(errors='replace')[-3000:]}" for log in logs))


def main(steps: int = 60, results: Path = RESULTS) -> None:
    """Run the batch, and write a row.

    Args:
        steps: of each training, but for the session whose own words say otherwise.
        results: folder of the table.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        sessions, out = write_six_sessions(folder), folder / "out"
        with Cluster(folder / "cluster") as cluster:
            started, starts = time.monotonic(), 1
            batch = start(cluster, sessions, out, steps)
            while not any(out.glob("objects/pear_2/training/hsi-sc-nerf/run/nerfstudio_models/*.ckpt")):
                if batch.poll() is not None:
                    give_up(out)
                time.sleep(0.5)
            lost = len(cluster.output("squeue", "--noheader", "--states=RUNNING").splitlines())
            print(f"{time.monotonic() - started:.0f} s: the node loses its power with {lost} jobs", flush=True)
            cluster.lose_power()
            while batch.wait() != 0:
                if starts == 3:
                    give_up(out)
                starts += 1
                print(f"{time.monotonic() - started:.0f} s: the batch ended early and is started again", flush=True)
                batch = start(cluster, sessions, out, steps)
            seconds = time.monotonic() - started
        records = [read_json(one.record(step), "")["status"] for one in read_plan(out).values() for step in STEPS]
        went_on = sum("Going on from" in log.read_text() for log in out.glob("objects/*/logs/train.txt"))
        reports = len([*out.glob("objects/*/report.html")])
        with (out / "traits.csv").open(newline="", encoding="utf-8") as file:
            told = [row["object"] for row in csv.DictReader(file) if row["status"] == "failed" and row["sentence"]]
        submitted = out.with_suffix(".log").read_text().count("has been submitted with SLURM jobid")
        row = [len(OBJECTS), 1, 1, submitted, lost, starts, went_on, len(records), reports, " ".join(told)]
        write_results("batch_slurm", COLUMNS, [[*map(str, row), f"{seconds:.0f}"]], folder=results, seed="1 to 6")


if __name__ == "__main__":
    tyro.cli(main)
