"""Stages, checkpoints and skipped steps of real, tiny training runs."""

import copy

import pytest
import torch

from hsi_sc_nerf.config import hsi_sc_nerf
from hsi_sc_nerf.models.checkpoints import allow_nerfstudio_checkpoints

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]
STEPS = 6


def trainer(tiny_dataset, folder, device="cpu", **changes):
    config = copy.deepcopy(hsi_sc_nerf.config)
    config.pipeline.datamanager.data = tiny_dataset[0]
    config.pipeline.datamanager.train_num_rays_per_batch = 64
    model = config.pipeline.model
    model.num_levels, model.log2_hashmap_size, model.max_res = 4, 10, 32
    model.num_proposal_samples_per_ray, model.num_nerf_samples_per_ray = (16, 8), 8
    config.output_dir, config.timestamp, config.vis = folder, "run", "tensorboard"
    config.machine.device_type = device
    config.max_num_iterations = STEPS
    for key, value in changes.items():
        setattr(config, key, value)
    made = config.setup(local_rank=0, world_size=1)
    made.setup()
    return made


@pytest.mark.parametrize("device", DEVICES)
def test_two_stages_run_in_one_go(tiny_dataset, tmp_path, device):
    made = trainer(tiny_dataset, tmp_path, device)
    seen = []
    original = made.pipeline.datamanager.next_train

    def next_train(step):
        rays, batch = original(step)
        seen.append((made.pipeline.model.camera_optimizer.frozen, batch["mask"].float().mean().item()))
        return rays, batch

    made.pipeline.datamanager.next_train = next_train
    twists = []
    step_before = made.optimizers.optimizer_scaler_step_some

    def step_some(*arguments):
        step_before(*arguments)
        twists.append(made.pipeline.model.camera_optimizer.camera_twist.detach().clone())

    made.optimizers.optimizer_scaler_step_some = step_some
    made.train()

    assert [frozen for frozen, _ in seen] == [False] * 3 + [True] * 3
    assert all(share < 0.5 for _, share in seen[:3])
    assert all(share == 0.75 for _, share in seen[3:])
    assert twists[2].abs().sum() > 0
    torch.testing.assert_close(twists[2], twists[5], rtol=0, atol=0)  # kept, and frozen


def test_stage_one_alone_can_be_continued(tiny_dataset, tmp_path):
    first = trainer(tiny_dataset, tmp_path / "first")
    first.train()
    kept = first.base_dir / "stage-full-frame"
    assert {path.name for path in kept.iterdir()} == {"step-000000002.ckpt", "step-000000002.json"}

    second = trainer(tiny_dataset, tmp_path / "second", load_dir=kept)
    assert second._start_step == 3
    second.train()
    assert second.step == STEPS - 1
    assert second._stage.config.name == "masked"


def test_a_finished_run_has_nothing_left_to_train(tiny_dataset, tmp_path):
    made = trainer(tiny_dataset, tmp_path)
    made.train()
    again = trainer(tiny_dataset, tmp_path / "again", load_dir=made.checkpoint_dir)
    with pytest.raises(SystemExit, match="max-num-iterations"):
        again.train()


def poison(made, bad_steps):
    """Make the batch of some steps infinite, as a damaged cube would."""
    original = made.pipeline.datamanager.next_train

    def next_train(step):
        rays, batch = original(step)
        if step in bad_steps:
            batch["spectral"] = batch["spectral"] * float("inf")
        return rays, batch

    made.pipeline.datamanager.next_train = next_train


def test_a_poisoned_step_is_skipped_and_named(tiny_dataset, tmp_path, capsys):
    made = trainer(tiny_dataset, tmp_path)
    poison(made, {2})
    made.train()
    assert "step 2 skipped: loss hsi_loss" in capsys.readouterr().out
    assert all(torch.isfinite(parameter).all() for parameter in made.pipeline.model.parameters())


def test_a_run_that_keeps_failing_stops_with_its_last_good_weights(tiny_dataset, tmp_path):
    made = trainer(tiny_dataset, tmp_path, max_nonfinite_steps=2)
    poison(made, {1, 2, 3, 4, 5})
    with pytest.raises(SystemExit, match=r"step 2 skipped.*last good checkpoint"):
        made.train()
    (checkpoint,) = made.checkpoint_dir.glob("*.ckpt")
    allow_nerfstudio_checkpoints()
    state = torch.load(checkpoint)  # the safe loader
    assert all(torch.isfinite(value).all() for value in state["pipeline"].values() if value.is_floating_point())


def test_a_full_disk_leaves_the_earlier_checkpoint(tiny_dataset, tmp_path, monkeypatch):
    made = trainer(tiny_dataset, tmp_path)
    made.save_checkpoint(0)
    before = list(made.checkpoint_dir.iterdir())

    def full_disk(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(SystemExit, match="No space left"):
        made.save_checkpoint(1)
    assert list(made.checkpoint_dir.iterdir()) == before
    assert [path for path in made.base_dir.iterdir() if path.name.startswith(".")] == []
