"""Short training runs in odd situations: each ends better than it began, or stops with one sentence.

    uv run python benchmarks/odd_runs.py

A small simulated pear with true poses and masks is changed as each case says, and trained. The root mean square error
of the reflectance at fixed training pixels is taken before and after; all weights must be finite.
"""

from __future__ import annotations

import copy
import dataclasses
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from results_table import RESULTS, write_results

from hsi_sc_nerf.config import hsi_sc_nerf
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.packed.cube import pack, write_packed_cube
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame, write_transforms
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth

COLUMNS = ["case", "RMSE before", "RMSE after", "skipped steps", "ends"]
FRAMES, SIZE_PX, BANDS = 8, 48, 12
RAYS = 256


@dataclass
class OddScene:
    """A dataset in memory; NaN is a flagged value."""

    reflectance: np.ndarray
    masks: np.ndarray
    poses: np.ndarray
    wavelengths_nm: np.ndarray
    intrinsics: Any
    box_m: np.ndarray


@dataclass(frozen=True)
class Case:
    """A situation: what it changes in the scene, in the settings, and in the trainer that is set up by them."""

    name: str
    data: Callable[[OddScene], None] = lambda scene: None
    settings: Callable[[Any], None] = lambda config: None
    trainer: Callable[[Any], None] = lambda trainer: None


@dataclass(frozen=True)
class Ended:
    """How a run ended.

    Attributes:
        before, after: root mean square errors; NaN where the run did not begin or end.
        skipped: steps that were not finite.
        message: the sentence that it stopped with; empty for none.
    """

    before: float
    after: float
    skipped: int
    message: str

    @property
    def is_good(self) -> bool:
        """Whether it ended better than it began, or with one sentence."""
        return (self.message != "" and "\n" not in self.message) or self.after < self.before


def simulated(folder: Path) -> OddScene:
    """The pear that all cases are made from."""
    scene = override(load_scene("pear"), frames=FRAMES, size_px=SIZE_PX, bands=BANDS, effects=[])
    truth = load_truth(simulate_session(scene, folder / "session", progress=False))
    vertices = truth.mesh().vertices
    return OddScene(
        np.stack([truth.reflectance(name) for name in truth.captures]),
        np.stack([truth.object_coverage(name) > 0.5 for name in truth.captures]),
        np.array(truth.camera_to_world),
        truth.wavelengths_nm,
        truth.intrinsics,
        np.stack([vertices.min(axis=0), vertices.max(axis=0)]),
    )


def _write(scene: OddScene, root: Path) -> None:
    frames = []
    for i, (cube, mask, pose) in enumerate(zip(scene.reflectance, scene.masks, scene.poses, strict=True)):
        paths = [root / kind / f"f{i}.png" for kind in ("images", "masks", "flags")]
        header = root / "cubes" / f"f{i}.hdr"
        write_packed_cube(header, pack(cube), scene.wavelengths_nm)
        shown = np.nan_to_num(cube[..., [len(scene.wavelengths_nm) // 2] * 3])
        write_png(paths[0], np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8))
        write_png(paths[1], 255 * mask.astype(np.uint8))
        write_png(paths[2], 4 * np.isnan(cube).any(-1).astype(np.uint8))
        frames.append(PackedFrame(f"f{i}", paths[0], paths[1], header, paths[2], 0.0, None, pose))
    chamber = scene.reflectance[~scene.masks]
    background = np.nan_to_num(np.nanmedian(chamber, axis=0)) if len(chamber) else np.zeros(len(scene.wavelengths_nm))
    around = np.array([[-0.12, -0.12, 0.0], [0.12, 0.12, 0.25]])
    nm = scene.wavelengths_nm
    write_transforms(
        PackedDataset(
            *(root, scene.intrinsics, np.zeros(4), nm, nm[[-1, len(nm) // 2, 0]], "pear"),
            *(around, scene.box_m, background, None, tuple(frames)),
            flagged_values=int(np.isnan(scene.reflectance).sum()),
        )
    )


def train(case: Case, scene: OddScene, folder: Path, steps: int) -> Ended:
    """Train a case."""
    scene = dataclasses.replace(scene, reflectance=scene.reflectance.copy(), masks=scene.masks.copy())
    case.data(scene)
    _write(scene, folder / "data")
    config = copy.deepcopy(hsi_sc_nerf.config)
    config.pipeline.datamanager.data = folder / "data"
    config.pipeline.datamanager.train_num_rays_per_batch = RAYS
    model = config.pipeline.model
    model.match_resolution, model.num_levels, model.log2_hashmap_size, model.max_res = False, 6, 12, 128
    config.output_dir, config.timestamp, config.vis = folder / "runs", "run", "tensorboard"
    config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
    config.max_num_iterations, config.evaluate_stages = steps, False
    before = after = float("nan")
    skipped = 0
    try:
        case.settings(config)
        torch.manual_seed(config.machine.seed)  # as ns-train does: it draws the weights
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        case.trainer(trainer)
        before = _error(trainer)
        guarded = trainer._guard.record

        def record(step: int, names: Any, groups: Any) -> Any:
            nonlocal skipped
            skipped += bool(names or groups)
            return guarded(step, names, groups)

        trainer._guard.record = record
        trainer.train()
        after = _error(trainer)
    except (SystemExit, InputError) as error:
        return Ended(before, after, skipped, str(error))
    if not all(parameter.isfinite().all() for parameter in trainer.pipeline.parameters()):
        raise RuntimeError(f"{case.name}: the run ended with weights that are not finite")
    return Ended(before, after, skipped, "")


def _error(trainer: Any) -> float:
    """Root mean square error at fixed training pixels, half of them on the object."""
    manager, model = trainer.pipeline.datamanager, trainer.pipeline.model
    fraction = 0.5 if manager.train_pixel_sampler.masks.any() else None
    batch = manager.train_pixel_sampler.sample(10**6, fraction)
    tensors = {name: torch.from_numpy(values) for name, values in batch.items()}
    rays = manager._train_rays(tensors["indices"])
    model.eval()
    with torch.no_grad():
        found = model(rays.to(model.device))["spectral"]
    model.train()
    squares = (found - tensors["spectral"].to(found.device)).square()
    valid = tensors.get("valid")
    return float((squares if valid is None else squares[valid.to(found.device)]).mean().sqrt())


def _keep_frames(*kept: int) -> Callable[[OddScene], None]:
    def change(scene: OddScene) -> None:
        rows = list(kept)
        scene.reflectance, scene.masks, scene.poses = scene.reflectance[rows], scene.masks[rows], scene.poses[rows]

    return change


def _bands(count: int) -> Callable[[OddScene], None]:
    def change(scene: OddScene) -> None:
        nm = np.linspace(400.0, 1000.0, count) if count > 1 else np.array([700.0])
        at = np.clip(np.searchsorted(scene.wavelengths_nm, nm), 0, len(scene.wavelengths_nm) - 1)
        scene.reflectance, scene.wavelengths_nm = scene.reflectance[..., at], nm

    return change


def _values(change: Callable[[np.ndarray, np.ndarray], Any]) -> Callable[[OddScene], Any]:
    return lambda scene: change(scene.reflectance, scene.masks)


def _flag_highlight(values: np.ndarray, masks: np.ndarray) -> None:
    for cube, mask in zip(values, masks, strict=True):
        lines, samples = np.nonzero(mask)
        cube[lines.mean().astype(int) :][:6, samples.mean().astype(int) :][:, :6] = np.nan


def _one_pixel(values: np.ndarray, masks: np.ndarray) -> None:
    masks[1] = False
    masks[1, SIZE_PX // 2, SIZE_PX // 2] = True


def _upper_half(values: np.ndarray, masks: np.ndarray) -> None:
    for mask in masks:
        mask[int(np.nonzero(mask)[0].mean()) :] = False


def _rates(factor: float) -> Callable[[Any], None]:
    def change(config: Any) -> None:
        for optimizer in config.optimizers.values():
            optimizer["optimizer"].lr *= factor

    return change


def _set(path: str, value: Any) -> Callable[[Any], None]:
    *holders, name = path.split(".")

    def change(config: Any) -> None:
        for holder in holders:
            config = getattr(config, holder)
        setattr(config, name, value)

    return change


def _weights(hsi: float, angular: float) -> Callable[[Any], None]:
    def change(config: Any) -> None:
        config.pipeline.model.hsi_loss_mult, config.pipeline.model.angular_loss_mult = hsi, angular

    return change


CASES = (
    Case("nothing odd"),
    Case("two dead bands", _values(lambda values, masks: values[..., 3:5].fill(np.nan))),
    Case("bands of constant 0", _values(lambda values, masks: values[..., 3:5].fill(0.0))),
    Case(
        "a fifth of the values flagged",
        _values(lambda v, m: np.copyto(v, np.nan, where=np.random.default_rng(0).random(v.shape) < 0.2)),
    ),
    Case("a saturated highlight", _values(_flag_highlight)),
    Case("a mask of one pixel in a frame", _values(_one_pixel)),
    Case("a mask of none in a frame", _values(lambda values, masks: masks[1].fill(False))),
    Case("all masks empty", _values(lambda values, masks: masks.fill(False))),
    Case("masks of the upper half: the hull misses the rest", _values(_upper_half)),
    Case("black object", _values(lambda values, masks: np.copyto(values, 0.0, where=masks[..., None]))),
    Case("white object", _values(lambda values, masks: np.copyto(values, 1.0, where=masks[..., None]))),
    Case("reflectance up to 1.3", _values(lambda values, masks: np.multiply(values, 1.3 / values.max(), out=values))),
    Case("one frame", _keep_frames(0)),
    # The last but one of two frames, and the middle one of three, are held out.
    Case("one training view", _keep_frames(0, FRAMES // 2)),
    Case("two training views, 180 degrees apart", _keep_frames(0, FRAMES // 4, FRAMES // 2)),
    Case("1 band", _bands(1)),
    Case("3 bands", _bands(3)),
    Case("204 bands", _bands(204)),
    Case("1000 bands", _bands(1000)),
    Case("mixed precision", settings=_set("mixed_precision", True)),
    # nerfstudio has none on a processor, where PyTorch would take bfloat16.
    Case("mixed precision, bfloat16", trainer=_set("mixed_precision", True)),
    Case("learning rates times 10", settings=_rates(10.0)),
    Case("learning rates times 100", settings=_rates(100.0)),
    Case("loss weights 0 and 1", settings=_weights(0.0, 1.0)),
    Case("loss weights 1 and 0", settings=_weights(1.0, 0.0)),
    Case("first stage empty", settings=_set("full_frame.fraction", 0.0)),
    Case("second stage empty", settings=_set("masked.fraction", 0.0)),
)


def main(steps: int = 300, only: str = "", results: Path = RESULTS) -> None:
    """Train every case and write the table.

    Args:
        steps: of each run.
        only: part of the names of the cases to run; the other rows of the table are kept.
        results: folder of the table.
    """
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        scene = simulated(Path(temporary))
        for number, case in enumerate(case for case in CASES if only in case.name):
            try:
                ended = train(case, scene, Path(temporary) / str(number), steps)
            except Exception as error:  # the table shows that a case ends in what it should not
                ended = Ended(float("nan"), float("nan"), 0, f"NOT one sentence: {type(error).__name__}: {error}")
            outcome = ended.message or ("better than it began" if ended.is_good else "NOT better than it began")
            outcome = " ".join(outcome.replace(temporary, "").split())[:160]
            rows.append([case.name, f"{ended.before:.4f}", f"{ended.after:.4f}", str(ended.skipped), outcome])
            print(*rows[-1], sep=" | ", flush=True)
    write_results("odd_runs", COLUMNS, rows, keys=1, seed=f"0, {steps} steps", folder=results)


if __name__ == "__main__":
    tyro.cli(main)
