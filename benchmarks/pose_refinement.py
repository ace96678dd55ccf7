"""What refining poses during training is worth, by mode, on a simulated session with known truth, as a table.

    uv run python benchmarks/pose_refinement.py --output-dir /tmp/refinement

The same frames are trained on with the true poses, with the true poses disturbed by known errors, and with those that
the markers gave. Held-out views keep the errors of their poses, as in a real session. What is left of the errors is
told after the similarity that fits the training views best: no image shows where the object frame lies, or its scale.
Seconds are the processor's, so that what else the machine does hardly counts. Rows that are already there are not run
again.
"""

from __future__ import annotations

import copy
import json
import os
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from jaxtyping import Float
from pose_errors import align_poses, pose_errors, transformed_poses
from results_table import RESULTS, write_results
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.cli.demo import DEMO_TRAINING
from hsi_sc_nerf.config import hsi_sc_nerf
from hsi_sc_nerf.data.dataparser import scene_scaling
from hsi_sc_nerf.evaluation.spatial import precision_recall_f_score, sample_surface
from hsi_sc_nerf.geometry.camera import rotation_about_z
from hsi_sc_nerf.models.staged_trainer import StagedTrainer, StagedTrainerConfig
from hsi_sc_nerf.packed.dataset import PackedDataset, open_packed, write_transforms
from hsi_sc_nerf.processing.process import process_session
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import Truth, load_truth
from hsi_sc_nerf.surface.depth_renders import render_depth_maps
from hsi_sc_nerf.surface.surface_points import sample_surface_points

COLUMNS = (
    ("poses", "{poses}"),
    ("refinement", "{mode}"),
    ("SAM, rad", "{sam:.4f}"),
    ("RMSE", "{rmse:.4f}"),
    ("SSIM", "{ssim:.3f}"),
    ("PSNR, dB", "{psnr:.1f}"),
    ("F-score at 2 mm, %", "{f_score:.1f}"),
    ("training views, °", "{train_deg:.3f}"),
    ("mm", "{train_mm:.2f}"),
    ("held-out views, °", "{held_out_deg:.3f}"),
    ("mm", "{held_out_mm:.2f}"),
    ("scale, %", "{scale_percent:+.2f}"),
    ("train, CPU s", "{seconds:.0f}"),
)
Poses = Literal["true", "disturbed", "markers"]
ROWS: tuple[tuple[Poses, str], ...] = (
    ("true", "off"),
    ("disturbed", "off"),
    ("disturbed", "free-discarded"),
    ("disturbed", "turntable"),
    ("markers", "off"),
    ("markers", "turntable"),
)
CLOUD_POINTS, REFERENCE_POINTS = 20_000, 50_000


@dataclass(frozen=True)
class PoseErrors:
    """Errors to put into the true poses."""

    camera_turn_deg: float = 0.3
    """Turn of the camera about each of its three axes, the same in all frames."""
    camera_shift_mm: float = 1.0
    """Shift of the camera along each of its three axes, the same in all frames."""
    angle_drift_deg: float = 0.3
    """SD of the table's angle errors that come and go once a turn, as an eccentric drive makes them."""
    angle_jitter_deg: float = 0.3
    """SD of the angle errors of each frame by itself."""
    focal_length_percent: float = 0.5
    """Error of the focal length."""
    seed: int = 0
    """Seed of the angles."""

    def disturb(self, camera_to_worlds: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
        """Poses with these errors."""
        rng = np.random.default_rng(self.seed)
        count = len(camera_to_worlds)
        turn_once = np.sin(2 * np.pi * (np.arange(count) / count + rng.random()))
        angles = np.sqrt(2.0) * self.angle_drift_deg * turn_once + rng.normal(0.0, self.angle_jitter_deg, count)
        camera = np.eye(4)
        camera[:3, :3] = Rotation.from_rotvec(np.full(3, self.camera_turn_deg), degrees=True).as_matrix()
        camera[:3, 3] = self.camera_shift_mm / 1000
        return np.stack(
            [rotation_about_z(d) @ pose @ camera for d, pose in zip(angles, camera_to_worlds, strict=True)]
        )


@dataclass(frozen=True)
class PoseRefinementBenchmark:
    """Train with every mode of pose refinement and compare."""

    output_dir: Path
    """Folder for the session, the datasets and the runs."""
    errors: PoseErrors = PoseErrors()
    """Errors of the disturbed poses."""
    iterations: int = 500
    """Training steps of each run, both stages together."""
    scene: str = "pear"
    """What stands on the turntable."""
    frames: int = 36
    """Frames of the session."""
    size: int = 128
    """Width and height of the images, pixels."""
    bands: int = 48
    """Spectral bands."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Train what is missing, print the table, write it."""
        datasets, truth = self._datasets()
        cells = []
        for poses, mode in ROWS:
            path = self.output_dir / f"{poses}-{mode}.json"
            if not path.exists():
                row = {"poses": poses, "mode": mode, **self._row(datasets[poses], truth, mode)}
                path.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
            row = json.loads(path.read_text(encoding="utf-8"))
            cells.append([template.format(**row) for _, template in COLUMNS])
        write_results("pose_refinement", [title for title, _ in COLUMNS], cells, folder=self.results)

    def _datasets(self) -> tuple[dict[Poses, Path], Truth]:
        """The session's dataset with each kind of poses, and the truth; the pixels are linked, not copied."""
        session, markers = self.output_dir / "session", self.output_dir / "markers"
        scene = override(load_scene(self.scene), frames=self.frames, size_px=self.size, bands=self.bands)
        if not session.exists():
            simulate_session(scene, session)
        process_session(session, markers)
        truth = load_truth(session)
        true_poses = np.stack(
            [truth.camera_to_world[truth.captures.index(f.capture)] for f in open_packed(markers).frames]
        )
        focal = 1 + self.errors.focal_length_percent / 100
        lens = truth.intrinsics
        given: dict[Poses, tuple] = {
            "true": (true_poses, lens),
            "disturbed": (
                self.errors.disturb(true_poses),
                replace(lens, fl_x=focal * lens.fl_x, fl_y=focal * lens.fl_y),
            ),
        }
        for name, (poses, intrinsics) in given.items():
            folder = self.output_dir / name
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(markers, folder, copy_function=os.link)
            dataset = open_packed(folder)
            frames = tuple(replace(f, camera_to_world=p) for f, p in zip(dataset.frames, poses, strict=True))
            write_transforms(replace(dataset, frames=frames, intrinsics=intrinsics))
        return {
            "true": self.output_dir / "true",
            "disturbed": self.output_dir / "disturbed",
            "markers": markers,
        }, truth

    def _row(self, data: Path, truth: Truth, mode: str) -> dict[str, float]:
        trainer = self._trainer(data, mode)
        started = time.process_time()
        trainer.train()
        seconds = time.process_time() - started
        metrics = trainer.pipeline.get_average_eval_image_metrics()
        trainer.pipeline.eval()
        dataset = open_packed(data)
        true_poses = np.stack([truth.camera_to_world[truth.captures.index(f.capture)] for f in dataset.frames])
        refined = _refined_poses(trainer, dataset)
        frames = np.arange(len(refined))
        train = trainer.pipeline.datamanager.train_dataparser_outputs.metadata["turntable"]["frame_indices"]
        held_out = np.setdiff1d(frames, train)
        fit = align_poses(refined[train], true_poses[train])
        degrees, mm = pose_errors(transformed_poses(fit, refined), true_poses)
        mesh = truth.mesh()
        reference = sample_surface(mesh.vertices, mesh.triangles, REFERENCE_POINTS)
        return {
            **{name: metrics[name] for name in ("sam", "rmse", "ssim", "psnr")},
            "f_score": precision_recall_f_score(fit(_cloud_m(trainer)), reference).f_score,
            "train_deg": float(degrees[train].mean()),
            "train_mm": float(mm[train].mean()),
            "held_out_deg": float(degrees[held_out].mean()),
            "held_out_mm": float(mm[held_out].mean()),
            "scale_percent": 100 * (1 / fit.scale - 1),
            "seconds": seconds,
        }

    def _trainer(self, data: Path, mode: str) -> StagedTrainer:
        words = [word for key, value in DEMO_TRAINING.items() for word in (f"--{key}", *value.split())]
        config: StagedTrainerConfig = tyro.cli(
            StagedTrainerConfig,
            default=copy.deepcopy(hsi_sc_nerf.config),
            args=[*words, "--max-num-iterations", str(self.iterations)],
            config=(tyro.conf.FlagConversionOff,),
        )
        config.pipeline.datamanager.data = data
        config.pipeline.model.camera_optimizer.mode = mode
        config.evaluate_stages = False
        config.experiment_name = "pose-refinement"
        config.output_dir, config.timestamp = self.output_dir / "runs", f"{data.name}-{mode}"
        torch.manual_seed(config.machine.seed)
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        return trainer


@torch.no_grad()
def _refined_poses(trainer: StagedTrainer, dataset: PackedDataset) -> Float[np.ndarray, "n 4 4"]:
    """All poses of the session as the model sees them after training, metres."""
    centre, scale = scene_scaling(dataset.scene_box_m)
    poses = dataset.camera_to_worlds
    poses[:, :3, 3] = (poses[:, :3, 3] - centre) * scale
    # Double precision, for micrometres and thousandths of a degree.
    refinement = copy.deepcopy(trainer.pipeline.model.camera_optimizer).cpu().double()
    refined = refinement.corrected(torch.arange(len(poses)), torch.from_numpy(poses)).numpy()
    refined[:, :3, 3] = refined[:, :3, 3] / scale + centre
    return refined


def _cloud_m(trainer: StagedTrainer) -> Float[np.ndarray, "n 3"]:
    """Points of the learned surface, metres."""
    manager = trainer.pipeline.datamanager
    scene = manager.train_dataparser_outputs
    model, masks = trainer.pipeline.model, manager.train_pixel_sampler.masks
    renders = render_depth_maps(model, manager.train_dataset.cameras, masks, rays_per_batch=4096)
    box = scene.metadata["object_box"].cpu().numpy()
    cloud = sample_surface_points(model, renders, CLOUD_POINTS, rays_per_batch=4096, box=box)
    return cloud.points / scene.dataparser_scale - scene.dataparser_transform[:, 3].numpy()


if __name__ == "__main__":
    tyro.cli(PoseRefinementBenchmark).main()
