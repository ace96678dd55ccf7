"""Measurements that need a GPU, in one run of some minutes: tests, the demo, and a session of full size.

    python benchmarks/gpu.py --output-dir /tmp/gpu

Parts run one after the other, each in processes of its own, and a part that fails loses only its own rows. The
session is 60 noisy views of the simulated pear, 512 x 512 x 204. Rows are added to benchmarks/results/gpu.csv as they
come. Where Open3D is missing, `gpu_stand_ins` takes its place.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

ROOT = Path(__file__).resolve().parents[1]
# The package need not be installed.
sys.path.insert(0, str(ROOT))
from results_table import RESULTS, current_commit, write_results  # noqa: E402

STAND_INS = ROOT / "benchmarks" / "gpu_stand_ins"
UNUSED = ("mediapy", "pymeshlab", "xatlas")
"""Packages that nerfstudio's exporter imports for meshes and textures, which are not exported here: empty modules."""
COLUMNS = {
    "part": "",
    "configuration": "",
    "step": "",
    "stage": "",
    "iterations": "",
    "train, s": ".1f",
    "ms per iteration": ".1f",
    "SAM, rad": ".4f",
    "RMSE": ".4f",
    "SSIM": ".3f",
    "PSNR, dB": ".1f",
    "GPU, MiB": ".0f",
    "process, MiB": ".0f",
    "note": "",
}
"""Columns of the table, and how their values are written."""
METRICS = {"SAM, rad": "sam", "RMSE": "rmse", "SSIM": "ssim", "PSNR, dB": "psnr"}
STEPS = {"graph": "", "eager": "--capture-steps False"}
"""How a step is launched, and the words that say so."""
EFFECTS = ("photon_noise", "read_noise", "chamber_shading")
"""Those of benchmarks/beyond_the_paper.py."""
PLUGIN = {
    "NERFSTUDIO_METHOD_CONFIGS": "hsi-sc-nerf=hsi_sc_nerf.config:hsi_sc_nerf,"
    "hsi-sc-nerf-paper=hsi_sc_nerf.config:hsi_sc_nerf_paper",
    "NERFSTUDIO_DATAPARSER_CONFIGS": "hsi-sc-nerf-data=hsi_sc_nerf.data.dataparser:hsi_sc_nerf_dataparser",
}


@dataclass(frozen=True)
class TrainingRun:
    """One training: ``NAME:STEP:SECONDS``, or ``NAME:STEP:ITERATIONSi``."""

    configuration: str
    step: str
    seconds: float | None
    iterations: int | None

    @classmethod
    def parse(cls, text: str) -> TrainingRun:
        """From the command line."""
        name, step, length = text.split(":")
        if length.endswith("i"):
            return cls(name, step, None, int(length[:-1]))
        return cls(name, step, float(length), None)


@dataclass
class GpuBenchmark:
    """Run the parts."""

    output_dir: Path
    """For logs and everything that is made."""
    results: Path = RESULTS
    """Folder of the CSV file to which rows are added."""
    commit: str = ""
    """Commit of the code; by default the current one of git."""
    parts: tuple[str, ...] = ("tests", "demo", "session", "train")
    """Parts to run."""
    scene: str = "pear"
    """Scene of the session."""
    frames: int = 60
    """Frames of the session."""
    size: int = 512
    """Width and height of its frames, pixels."""
    bands: int = 204
    """Spectral bands of its frames."""
    demo_iterations: int = 500
    """Iterations of the demo's training."""
    runs: tuple[str, ...] = (
        "ours:graph:600i",
        "ours:graph:60",
        "ours:graph:150",
        "ours:eager:300i",
        "paper:graph:300i",
        "paper:graph:60",
    )
    """Trainings, CONFIGURATION:STEP:SECONDS or CONFIGURATION:STEP:ITERATIONSi. For the seconds, an earlier run of
    the same configuration and step tells how long an iteration takes."""
    checkpoints: tuple[float, ...] = (0.34, 0.67)
    """Fractions of a run of given seconds at which it is evaluated."""
    held_out_views: int | None = None
    """Evaluate this many of the held-out views; None for all."""
    words: str = ""
    """More words for every training, as after `ns-train hsi-sc-nerf`."""
    limit_seconds: float = 540.0
    """No part begins after so many."""
    _started: float = field(default_factory=time.perf_counter, init=False)
    _seconds_of: dict[tuple[str, str], float] = field(default_factory=dict, init=False)

    def main(self) -> None:
        """Run all parts."""
        self.output_dir.mkdir(parents=True, exist_ok=True)
        self.output_dir, self.commit = self.output_dir.resolve(), self.commit or current_commit()
        self._say(f"{_machine()}, commit {self.commit}")
        parts = {"tests": self._tests, "session": self._session, "demo": self._demo, "train": self._train}
        for name, work in parts.items():
            if name in self.parts:
                self._guarded(name, work)
        self._say("done")

    def _say(self, text: str) -> None:
        print(f"[{time.perf_counter() - self._started:6.1f} s] {text}", flush=True)

    def _guarded(self, name: str, work: Callable[[], None]) -> None:
        if time.perf_counter() - self._started > self.limit_seconds:
            self._say(f"{name}: left out, there is no time left")
            return
        self._say(f"{name} ...")
        try:
            work()
        except Exception as error:
            self._say(f"{name} FAILED: {error!r}")
            self._row(part=name, note=f"failed: {error}"[:300])

    def _row(self, **values: Any) -> None:
        """Add a row; ``values`` are named as the columns, and an unnamed cell stays empty."""
        cells = ["" if values.get(c) is None else f"{values[c]:{form}}" for c, form in COLUMNS.items()]
        # Cells and commit name a row: an earlier measurement is replaced only by an equal one.
        keys = len(COLUMNS) + 1
        write_results(
            "gpu",
            list(COLUMNS),
            [cells],
            keys=keys,
            seed="0",
            commit=self.commit,
            machine=_machine(),
            folder=self.results,
        )

    def _environment(self) -> dict[str, str]:
        environment = os.environ | PLUGIN | {"PYTHONUNBUFFERED": "1", "PYTHONWARNINGS": "ignore"}
        places = [str(ROOT), os.environ.get("PYTHONPATH", "")]
        try:
            missing = importlib.util.find_spec("open3d") is None
        except ImportError:
            missing = True
        if missing:
            empty = self.output_dir / "empty"
            empty.mkdir(exist_ok=True)
            for name in UNUSED:
                (empty / f"{name}.py").touch()
            places += [str(STAND_INS), str(empty)]
        environment["PYTHONPATH"] = os.pathsep.join(place for place in places if place)
        return environment

    def _command(self, name: str, words: list[str], timeout: float) -> float:
        """Run a command into a log; seconds that it took."""
        log = self.output_dir / f"{name}.log"
        started = time.perf_counter()
        with log.open("wb") as file:
            done = subprocess.run(
                words, stdout=file, stderr=subprocess.STDOUT, env=self._environment(), cwd=ROOT, timeout=timeout
            )
        if done.returncode != 0:
            tail = log.read_text(encoding="utf-8", errors="replace")[-2500:]
            print(tail, flush=True)
            raise RuntimeError(f"{name} ended with status {done.returncode}")
        return time.perf_counter() - started

    def _tests(self) -> None:
        """The tests that have a CUDA case; others are left out, and so are files that need what is not there."""
        files = [
            str(path)
            for path in sorted((ROOT / "tests").rglob("test_*.py"))
            if "cuda" in path.read_text(encoding="utf-8") and "fake_cuda" not in path.name
        ]
        words = [sys.executable, "-m", "pytest", "-q", "-k", "cuda", "--numprocesses", "4", *files]
        try:
            seconds = self._command("tests", words, 240.0)
        finally:
            log = (self.output_dir / "tests.log").read_text(encoding="utf-8", errors="replace")
            lines = [line for line in log.splitlines() if line.startswith(("FAILED", "ERROR")) or " in " in line]
            print("\n".join(lines[-25:]), flush=True)
        self._row(part="tests", note=f"{seconds:.0f} s; " + log.strip().splitlines()[-1].strip("= "))

    def _demo(self) -> None:
        """The demo's steps; its iterations and scene are the options'."""
        folder = self.output_dir / "demo"
        words = [sys.executable, "-m", "hsi_sc_nerf.cli.main", "demo", "--output-dir", str(folder)]
        words += ["--scene", self.scene, "--iterations", str(self.demo_iterations)]
        try:
            self._command("demo", words, 240.0)
        except RuntimeError:
            for log in sorted((folder / "logs").glob("*.log")):
                print(f"--- {log.name}\n{log.read_text(encoding='utf-8', errors='replace')[-1500:]}", flush=True)
            raise
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        metrics = summary["metrics"]
        size = "36 views of 128 x 128"
        common = {"part": "demo", "configuration": "ours", "step": "graph"}
        for cost in summary["steps"]:
            measured = {"train, s": cost["seconds"], "process, MiB": cost["peak_memory_mib"]}
            self._row(**common, stage=cost["name"], note=size, **measured)
        measured = {"train, s": summary["seconds"]} | {title: metrics[name] for title, name in METRICS.items()}
        note = f"{size}; F-score at 2 mm {metrics['f_score']:.2f} %"
        self._row(**common, stage="all", iterations=self.demo_iterations, note=note, **measured)

    def _session(self) -> None:
        """Simulate and process the session, each with all cores."""
        session = self._data.parent / "session"
        size = ["--frames", str(self.frames), "--size", str(self.size), "--bands", str(self.bands)]
        command = [sys.executable, "-m", "hsi_sc_nerf.cli.main"]
        self._data.parent.mkdir(parents=True, exist_ok=True)
        simulated = self._command(
            "simulate", [*command, "simulate", self.scene, str(session), *size, "--effects", *EFFECTS], 300.0
        )
        workers = str(max(2, min(12, (os.cpu_count() or 2) // 2)))
        words = ["process", str(session), "--output-dir", str(self._data), "--workers", workers]
        processed = self._command("process", [*command, *words], 300.0)
        self._row(part="session", note=f"simulated in {simulated:.1f} s; processed in {processed:.1f} s")

    @property
    def _data(self) -> Path:
        return self.output_dir / f"{self.scene}-{self.size}-{self.frames}" / "data"

    def _train(self) -> None:
        for number, text in enumerate(self.runs):
            try:
                self._train_one(number, TrainingRun.parse(text))
            except Exception as error:
                self._say(f"{text} FAILED: {error!r}")
                self._row(part="train", note=f"{text} failed: {error}"[:300])

    def _train_one(self, number: int, run: TrainingRun) -> None:
        """One training in a process of its own, as `hsi-sc-nerf benchmark` does it."""
        import shlex

        from hsi_sc_nerf.benchmark.configurations import named_configuration

        key = run.configuration, run.step
        iterations, checkpoints = run.iterations, ()
        left = self.limit_seconds - (time.perf_counter() - self._started)
        if run.seconds is not None:
            if run.seconds > left:
                raise RuntimeError(f"there is no time left for {run.seconds:g} s")
            iterations, checkpoints = int(run.seconds / self._seconds_of[key]), self.checkpoints
        configuration = named_configuration(run.configuration)
        job = {
            "method": configuration.method,
            "words": [*configuration.words, *STEPS[run.step].split(), *shlex.split(self.words)],
            "data": str(self._data),
            "output_dir": str(self.output_dir / f"run-{number}"),
            "iterations": iterations,
            "train_seconds": None,
            "clock": "wall",
            "checkpoints": checkpoints,
            "threads": max(1, (os.cpu_count() or 2) // 2),
            "held_out_views": self.held_out_views,
        }
        job_path, result_path = (self.output_dir / f"{kind}-{number}.json" for kind in ("job", "result"))
        job_path.write_text(json.dumps(job), encoding="utf-8")
        self._say(f"{run.configuration}, {run.step}, {iterations} iterations ...")
        module = "hsi_sc_nerf.benchmark.run"
        words = [sys.executable, "-m", module, str(job_path), str(result_path)]
        self._command(f"train-{number}-{run.configuration}-{run.step}", words, left + 60.0)
        result = json.loads(result_path.read_text(encoding="utf-8"))
        for found in result["checkpoints"]:
            views = f"{self.held_out_views} held-out views" if self.held_out_views else ""
            whole_frame = f"whole frame {found['metrics']['full_psnr']:.1f} dB"
            measured = {
                "train, s": found["train_seconds"],
                "ms per iteration": 1000.0 * found["train_seconds"] / found["iteration"],
                "GPU, MiB": found["gpu_memory_mib"],
                "process, MiB": found["peak_memory_mib"],
            }
            self._row(
                part="train",
                configuration=run.configuration,
                step=run.step,
                stage=found["stage"] + (" (end)" if found["ends_stage"] else ""),
                iterations=found["iteration"],
                note="; ".join(text for text in (self.words, views, whole_frame) if text),
                **measured,
                **{title: found["metrics"][name] for title, name in METRICS.items()},
            )
        last = result["checkpoints"][-1]
        first = result["checkpoints"][0]
        # The second half, where libraries and graphs are ready.
        self._seconds_of[key] = (last["train_seconds"] - first["train_seconds"]) / max(
            1, last["iteration"] - first["iteration"]
        )


def _machine() -> str:
    import torch

    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"
    return f"{device}, torch {torch.__version__}"


if __name__ == "__main__":
    tyro.cli(GpuBenchmark).main()
