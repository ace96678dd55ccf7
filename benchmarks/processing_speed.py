"""Time to process a frame, compared with copying its raw file and with SPy and NumPy, as a table.

    uv run python benchmarks/processing_speed.py SESSION --frames 60

Each method runs in a process of its own. It first reads its input files, so that they are in the system's cache, and
processes one frame untimed, so that everything is loaded. The table shows medians over rounds of the time, and of its
ratio to copying as many files in the same round. "Processor" is the processor time of all workers, which other work
on the machine changes less.
"""

from __future__ import annotations

import json
import pickle
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from results_table import RESULTS, write_results
from spectral.io import envi

from hsi_sc_nerf.calibration.reflectance import FrameCalibration
from hsi_sc_nerf.calibration.session_calibration import CalibrationConfig, calibrate_session
from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.capture.session import Capture, Session, open_session
from hsi_sc_nerf.cli.steps import run_step
from hsi_sc_nerf.processing.frames import FramePaths, process_frame

COLUMNS = [
    "method",
    "frames",
    "workers",
    "a frame, ms",
    "of copying",
    "processor, ms",
    "of copying",
    "peak memory, MiB",
]
CALIBRATION_NAME = "calibration.pickle"

Work = Callable[[int], None]


@dataclass(frozen=True)
class ProcessingSpeed:
    """Measure the time to process frames, compared with copying their raw files and with SPy and NumPy."""

    session: tyro.conf.Positional[Path]
    """Session to process; a simulated one will do."""
    frames: int = 12
    """Frames that are processed in parallel."""
    workers: int = 2
    """Workers that process them."""
    rounds: int = 3
    """Repeats of each method."""
    folder: Path | None = None
    """Folder for the files; the system's temporary folder if not given."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Measure, print the table, write it."""
        with tempfile.TemporaryDirectory(prefix="processing-speed-", dir=self.folder) as folder:
            scratch = Path(folder)
            _run("calibrate", self.session, scratch, 0, 1)
            many = min(self.frames, len(_load(scratch)[0]))
            jobs = [("nothing", 0, 1), ("copy", 1, 1), ("process", 1, 1), ("spy", 1, 1)]
            jobs += [("copy", many, 1), ("copy", many, self.workers), ("process", many, self.workers)]
            rows: list[dict[str, Any]] = [
                {"method": method, "frames": frames, "workers": workers, "rounds": []}
                for method, frames, workers in jobs
            ]
            for _ in range(self.rounds):
                for row in rows:
                    cost = _run(row["method"], self.session, scratch, row["frames"], row["workers"])
                    row["rounds"].append(cost)
        cells = [_cells(row, rows) for row in rows]
        write_results("processing_speed", COLUMNS, cells, seed="0", folder=self.results)


METHODS = {"nothing": "Python, imports", "copy": "shutil.copyfile", "process": "this package", "spy": "SPy, numpy"}


def _cells(row: dict, rows: list[dict]) -> list[str]:
    peak = f"{np.median([r['peak_mib'] for r in row['rounds']]):.0f}"
    if row["method"] == "nothing":
        return [METHODS["nothing"], "", "", "", "", "", "", peak]
    cells = [METHODS[row["method"]], str(row["frames"]), str(row["workers"])]
    same_job = (row["frames"], row["workers"])
    copy = next(r for r in rows if r["method"] == "copy" and (r["frames"], r["workers"]) == same_job)
    for key in ("milliseconds", "processor_milliseconds"):
        own, copying = (np.array([r[key] for r in rs["rounds"]]) for rs in (row, copy))
        cells += [f"{np.median(own):.0f}", f"{np.median(own / copying):.1f}"]
    return [*cells, peak]


def _run(method: str, session: Path, scratch: Path, frames: int, workers: int) -> dict[str, float]:
    """Times a frame and peak memory of one method, in a process of its own."""
    log = scratch / "log"
    options = {"method": method, "session": session, "scratch": scratch, "frames": frames, "workers": workers}
    arguments = [argument for name, value in options.items() for argument in (f"--{name}", str(value))]
    cost = run_step(method, [sys.executable, __file__, *arguments], log)
    return {**json.loads(log.read_text(encoding="utf-8")), "peak_mib": cost.peak_memory_mib}


@dataclass(frozen=True)
class OneMethod:
    """Run one method and print its times a frame."""

    method: str
    """A key of ``METHODS``, or "calibrate"."""
    session: Path
    """Session to process."""
    scratch: Path
    """Folder for files, deleted at the end."""
    frames: int
    """Frames to process."""
    workers: int
    """Workers that process them."""

    def main(self) -> None:
        """Warm up, process the frames, print the times."""
        times = {}
        if self.method == "calibrate":
            calibration = calibrate_session(open_session(self.session), CalibrationConfig())
            with (self.scratch / CALIBRATION_NAME).open("wb") as file:
                pickle.dump((calibration.cubes, calibration.frames), file)
        elif self.method != "nothing":
            times = self._timed()
        print(json.dumps(times))

    def _timed(self) -> dict[str, float]:
        output_dir = self.scratch / "output"
        session = open_session(self.session)
        for path in {c.data_path for capture in session.frames[: self.frames] for c in capture.cubes}:
            with path.open("rb") as file:
                while file.read(1 << 24):
                    pass
        methods = {"copy": _copying, "process": _processing, "spy": _spy}
        work = methods[self.method](session, self.scratch, output_dir)
        with _fresh(output_dir):
            work(0)
        with _fresh(output_dir), ThreadPoolExecutor(self.workers) as pool:
            started, processor_started = time.perf_counter(), time.process_time()
            list(pool.map(work, range(self.frames)))
            seconds, processor_seconds = time.perf_counter() - started, time.process_time() - processor_started
        return {
            "milliseconds": 1000.0 * seconds / self.frames,
            "processor_milliseconds": 1000.0 * processor_seconds / self.frames,
        }


@contextmanager
def _fresh(folder: Path) -> Iterator[None]:
    folder.mkdir(parents=True)
    try:
        yield
    finally:
        shutil.rmtree(folder)


def _load(scratch: Path) -> tuple[tuple[Cube, ...], tuple[FrameCalibration, ...]]:
    with (scratch / CALIBRATION_NAME).open("rb") as file:
        return pickle.load(file)


def _copying(session: Session, _: Path, output_dir: Path) -> Work:
    def work(i: int) -> None:
        shutil.copyfile(session.frames[i].cube.data_path, output_dir / f"{i}.raw")

    return work


def _processing(session: Session, scratch: Path, output_dir: Path) -> Work:
    cubes, calibrations = _load(scratch)
    own = threading.local()

    def work(i: int) -> None:
        if not hasattr(own, "buffer"):
            own.buffer = np.empty(np.prod(cubes[i].shape), np.uint16)
        process_frame(
            cubes[i],
            calibrations[i],
            FramePaths.of(output_dir, session.frames[i].name),
            "",
            buffer=own.buffer,
        )

    return work


def _spy(session: Session, _: Path, output_dir: Path) -> Work:
    """As in SPy's manual: (S - D) / (W - D), clipped and saved."""
    tarp = session.white
    if tarp is None:
        raise ValueError("a session without a white tarp")
    white = _central_spectrum(tarp)

    def work(i: int) -> None:
        capture = session.frames[i]
        sample = envi.open(str(capture.cube.header_path)).load()
        dark = envi.open(str(capture.dark.header_path)).load().mean(axis=0) if capture.dark else np.float32(0.0)
        reflectance = np.clip((sample - dark) / (white - dark), 0.0, 1.0)
        envi.save_image(str(output_dir / f"{i}.hdr"), reflectance, dtype=np.float32)

    return work


def _central_spectrum(capture: Capture) -> np.ndarray:
    lines, samples, _ = capture.cube.shape
    middle = capture.cube.memmap()[lines // 3 : -(lines // 3), samples // 3 : -(samples // 3)]
    return middle.mean(axis=(0, 1), dtype=np.float64).astype(np.float32)


if __name__ == "__main__":
    tyro.cli(OneMethod if "--method" in sys.argv else ProcessingSpeed).main()
