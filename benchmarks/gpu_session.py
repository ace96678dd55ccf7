"""A session of many large frames, simulated by many processes at once, and its dataset.

    python benchmarks/gpu_session.py FOLDER --frames 60 --size 512

leaves FOLDER/session and FOLDER/data. A frame takes seconds of one core, and frames do not depend on one another.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from hsi_sc_nerf.benchmark.machine import available_cores
from hsi_sc_nerf.processing.process import ProcessConfig, process_session
from hsi_sc_nerf.simulate import session as session_writer
from hsi_sc_nerf.simulate import truth
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import load_scene, override

EFFECTS = ("photon_noise", "read_noise", "chamber_shading")
"""Those of benchmarks/beyond_the_paper.py."""


@dataclass(frozen=True)
class Session:
    """Simulate and process a session."""

    folder: tyro.conf.Positional[Path]
    """Where to."""
    scene: str = "pear"
    """Scene of `hsi-sc-nerf simulate`."""
    frames: int = 60
    """Frames of a turn."""
    size: int = 512
    """Width and height, pixels."""
    bands: int = 204
    """Spectral bands."""

    def main(self) -> None:
        """Do what is missing."""
        started = time.perf_counter()
        scene = override(
            load_scene(self.scene), frames=self.frames, size_px=self.size, bands=self.bands, effects=EFFECTS
        )
        session = self.folder / "session"
        if not session.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            global _simulation, _building
            _simulation = Simulation(scene)
            stamp = session_writer._stamp(_simulation)
            # Where the writer itself would build it: it then finds the frames done.
            _building = session.absolute().parent / f".partial-{stamp}-{session.name}"
            _building.mkdir(exist_ok=True)
            truth.write_truth(_building, _simulation)
            with multiprocessing.get_context("fork").Pool(available_cores()) as pool:
                pool.map(_write_frame, range(len(_simulation.captures)), chunksize=1)
            session_writer.simulate_session(scene, session, progress=False)
        print(f"simulated in {time.perf_counter() - started:.1f} s", flush=True)
        started = time.perf_counter()
        config = ProcessConfig(workers=max(2, min(12, available_cores() // 2)))
        process_session(session, self.folder / "data", config, progress=False)
        print(f"processed in {time.perf_counter() - started:.1f} s", flush=True)


_simulation: Simulation
_building: Path


def _write_frame(number: int) -> None:
    capture, frame = _simulation.captures[number], _simulation.frame(number)
    session_writer._write_capture(_building, capture, frame, _simulation)
    truth.write_pixels(_building, capture, frame)


if __name__ == "__main__":
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    tyro.cli(Session).main()
