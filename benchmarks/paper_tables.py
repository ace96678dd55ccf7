"""What the benchmarks beside the paper's tables share: simulated objects, trained by several configurations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results_table import Benchmark
from torch import Tensor

from hsi_sc_nerf.benchmark.configurations import Configuration
from hsi_sc_nerf.benchmark.run import BenchmarkRun, HeldOutViews
from hsi_sc_nerf.cli.benchmark import BenchmarkCommand, train_all
from hsi_sc_nerf.files import read_json, write_json
from hsi_sc_nerf.models.schedule import Clock
from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.poses.pose_methods import find_poses
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.processing.process import process_session
from hsi_sc_nerf.simulate.scene import EFFECTS, Scene, load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session

METRICS = {"sam": ("SAM, rad", 4), "rmse": ("RMSE", 4), "ssim": ("SSIM", 3), "psnr": ("PSNR, dB", 1)}
"""Title and digits after the point of each metric."""


@dataclass(frozen=True)
class PaperTable(Benchmark):
    """Options of a benchmark that trains on simulated objects. What is finished is not done again."""

    output_dir: Path
    """Folder for sessions, datasets and runs."""
    common: str = ""
    """Words that every run gets, as in `hsi-sc-nerf benchmark`."""
    train_seconds: float = 600.0
    """Time for training each."""
    clock: Clock = "wall"
    """What the seconds are of, as in `hsi-sc-nerf benchmark`."""
    iterations: int | None = None
    """The same number of iterations for each run instead of the same time; the paper's is 40000."""
    threads: int | None = None
    """CPU threads; all cores where it is not given."""
    held_out_views: int | None = None
    """Evaluate this many of the held-out views instead of all."""
    frames: int = 60
    """Frames of a session."""
    size: int = 128
    """Width and height of the images, pixels."""
    bands: int = 204
    """Spectral bands."""

    def simulated(
        self,
        scene: str | Scene,
        session: Path,
        effects: Sequence[str] = (),
        poses: Callable[..., TurntablePoses] = find_poses,
    ) -> Path:
        """Dataset, ``SESSION-data``, of a scene with more effects than its own, simulated if it is missing."""
        if not session.exists():
            own = load_scene(scene) if isinstance(scene, str) else scene
            scene = override(own, frames=self.frames, size_px=self.size, bands=self.bands, effects=effects)
            # Effects act in a fixed order.
            both = sorted((*own.effects, *scene.effects), key=lambda effect: list(EFFECTS).index(effect.name))
            simulate_session(replace(scene, effects=tuple(both)), session)
        return process_session(session, session.with_name(f"{session.name}-data"), estimate_poses=poses)

    def trained(
        self, configurations: Sequence[Configuration], data: Path, runs: Path, seed: int = 0
    ) -> list[BenchmarkRun]:
        """One run for each configuration, in processes of their own."""
        seeds = f"--machine.seed {seed} --pipeline.datamanager.seed {seed}" if seed else ""
        command = BenchmarkCommand(
            data=data,
            output_dir=runs,
            common=f"{self.common} {seeds}".strip(),
            train_seconds=self.train_seconds,
            clock=self.clock,
            iterations=self.iterations,
            checkpoints=(1.0,),
            held_out_views=self.held_out_views,
            threads=self.threads,
        )
        return train_all(configurations, command)


def judged_once(runs: Path, run: BenchmarkRun, judge: Callable[[Path], Mapping[str, float]]) -> dict[str, float]:
    """What ``judge`` finds of a run by its ``config.yml``, kept beside the run's result."""
    folder = runs / run.name
    kept = folder / "judged.json"
    if not kept.is_file() or kept.stat().st_mtime < (folder / "result.json").stat().st_mtime:
        write_json(kept, {**judge(folder / "benchmark" / run.method / "run" / "config.yml")})
    return read_json(kept, "delete it to judge the run again")


def rendered_views(run: TrainedRun, count: int | None = None) -> Iterator[tuple[str, Tensor, dict[str, Any]]]:
    """Held-out views, so many or all: the capture, its rendered spectra (h, w, bands), and the batch as measured."""
    frames = run.manager.eval_dataset.metadata["frames"]
    for camera, batch in HeldOutViews(run.manager.fixed_indices_eval_dataloader, count):
        with torch.no_grad():
            rendered = run.model.get_outputs_for_camera(camera)["spectral"].cpu()
        yield frames[batch["image_idx"]].capture, rendered, batch


def short_training(data: Path, folder: Path, iterations: int) -> list[object]:
    """Words that train ``folder/run/hsi-sc-nerf/run`` in so many steps of 1024 rays, without evaluations."""
    never = 1_000_000
    return [
        *("ns-train", "hsi-sc-nerf", "--data", data, "--output-dir", folder, "--experiment-name", "run"),
        *("--timestamp", "run", "--max-num-iterations", iterations, "--vis", "tensorboard"),
        *("--evaluate-stages", "False", "--steps-per-eval-batch", never, "--steps-per-eval-image", never),
        *("--pipeline.datamanager.train-num-rays-per-batch", 1024),
    ]


def mean_and_deviation(values: Sequence[float], digits: int) -> str:
    """The mean over seeds and, of more than one, their standard deviation."""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {np.std(values, ddof=1):.{digits}f}"
