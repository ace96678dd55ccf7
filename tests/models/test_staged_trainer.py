"""Stages, checkpoints and skipped steps of real, tiny training runs."""

import copy
import shutil
from unittest.mock import Mock

import pytest
import torch
from clock_by_hand import time_by_hand
from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.engine import trainer as nerfstudio_trainer
from nerfstudio.utils import profiler, writer
from scipy.ndimage import distance_transform_edt
from small_trainer import trainer

from hsi_sc_nerf.config import hsi_sc_nerf
from hsi_sc_nerf.models import staged_trainer
from hsi_sc_nerf.models.checkpoints import allow_nerfstudio_checkpoints
from hsi_sc_nerf.models.stages import StageConfig, full_frame_stage, masked_stage
from hsi_sc_nerf.packed.pixels import BOUNDARY_PX

pytestmark = pytest.mark.usefixtures("quick_start")


@pytest.mark.slow
def test_two_stages_run_in_one_go(tiny_dataset, tmp_path, device):
    made = trainer(tiny_dataset, tmp_path, device)
    seen = []
    original = made.pipeline.datamanager.next_train
    from_object = [distance_transform_edt(~mask) for mask in made.pipeline.datamanager.train_pixel_sampler.masks]

    def next_train(step):
        rays, batch = original(step)
        distances = [from_object[f][line, sample] for f, line, sample in batch["indices"].tolist()]
        beside = sum(0 < distance < BOUNDARY_PX + 1 for distance in distances)
        seen.append((made.pipeline.model.camera_optimizer.frozen, int(batch["mask"].sum()), beside))
        return rays, batch

    made.pipeline.datamanager.next_train = next_train
    twists = []
    step_before = made.optimizers.optimizer_scaler_step_some

    def step_some(*arguments):
        step_before(*arguments)
        twists.append(made.pipeline.model.camera_optimizer.camera_twist.detach().clone())

    made.optimizers.optimizer_scaler_step_some = step_some
    made.train()

    assert [row[:2] for row in seen] == [(False, 32)] * 3 + [(True, 48)] * 3  # 50 and 75 % of 64 rays
    # 20 and 80 % of the others pass just beside the object; of 26 rays drawn anywhere, one or two do by chance.
    assert all(6 <= beside <= 13 for *_, beside in seen[:3])
    assert all(13 <= beside <= 16 for *_, beside in seen[3:])
    assert twists[2].abs().sum() > 0
    torch.testing.assert_close(twists[2], twists[5], rtol=0, atol=0)  # kept, and frozen


@pytest.mark.slow
def test_what_a_stage_says_holds_in_it_alone(tiny_dataset, tmp_path, monkeypatch):
    """Frozen groups, learning rates, the grid's decay, samples a ray, opaque rises and the paper's rays, by stage."""
    first, second = full_frame_stage(), masked_stage()
    first.frozen_groups, first.group_lr = ("fields", "field_networks"), {"fields": (0.1, 0.1)}
    second.frozen_groups, second.foreground_ray_fraction = ("camera_opt",), 1.0
    first.grid_decay, second.grid_decay = 0.2, 3.0
    first.samples_per_ray = 5
    second.rise_length = 0.03
    made = trainer(tiny_dataset, tmp_path, full_frame=first, masked=second)
    rates, changed, shrunk, samples, rises = [], [], [], [], []
    sampler = made.pipeline.model.proposal_sampler
    sampler.register_forward_hook(lambda _, given, found: samples.append(found[0].frustums.shape[1]))
    monkeypatch.setattr(made.pipeline.model.field, "shrink_grid", shrunk.append)
    original = made.train_iteration

    def train_iteration(step):
        before = {name: [p.clone() for p in group] for name, group in made.optimizers.parameters.items()}
        result = original(step)
        for name, group in made.optimizers.parameters.items():
            if any(not torch.equal(a, b) for a, b in zip(before[name], group, strict=True)):
                changed.append((step, name))
        rates.append(made.optimizers.optimizers["fields"].param_groups[0]["lr"])
        rises.append(float(made.pipeline.model.field.rise_length))
        return result

    made.train_iteration = train_iteration
    made.train()
    assert rates[:3] == pytest.approx([0.1 * made.config.optimizers["fields"]["optimizer"].lr] * 3)
    assert {name for step, name in changed if step < 3} == {"camera_opt"}
    assert {name for step, name in changed if step >= 3} == {"fields", "field_networks"}
    assert shrunk == pytest.approx([3.0 * rate for rate in rates[3:]])  # the first stage does not learn the field
    assert samples[:6] == [5] * 3 + [8] * 3
    assert rises == pytest.approx([0.0] * 3 + [0.01, 0.01 + 0.02 / 1.8, 0.03])


@pytest.mark.slow
def test_a_run_in_the_folder_of_an_earlier_one_leaves_its_own_stages_alone(tiny_dataset, tmp_path):
    """Which stage ended when, and which checkpoint --load-dir takes, follow from the latest in the folder."""
    for steps in (6, 4):
        trainer(tiny_dataset, tmp_path, max_num_iterations=steps).train()
    found = {f"{path.parent.name}/{path.name}" for path in tmp_path.rglob("*.ckpt")}
    ends = {"full-frame": 1, "masked": 3}
    assert found == {
        *(f"stage-{name}/step-{step:09d}.ckpt" for name, step in ends.items()),
        "nerfstudio_models/step-000000003.ckpt",
    }


@pytest.mark.slow
def test_normals_are_predicted_where_an_occupancy_grid_places_the_samples(tiny_dataset, tmp_path):
    made = trainer(tiny_dataset, tmp_path, predict_normals=True, max_num_iterations=2)
    weights = made.pipeline.model.field.mlp_pred_normals.layers[0].weight
    before = weights.clone()
    made.train()
    assert not torch.equal(before, weights)
    assert torch.isfinite(weights).all()


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"max_num_iterations": 0}, "--max-num-iterations is 0"),
        ({"full_frame": StageConfig("a", 1.0, frozen_groups=("x",), learn_after={})}, "group 'x'"),
        ({"full_frame": StageConfig("a", 1.0, learn_after={"table": 0.1})}, "group 'table'"),
        ({"full_frame": StageConfig("a", 1.0, foreground_ray_fraction=1.2)}, "--full-frame.foreground-ray-fraction"),
        ({"masked": StageConfig("b", -0.5)}, "--masked.fraction is -0.5"),
        ({"masked": StageConfig("b", 1.0, group_lr={"fields": (0.0, 0.1)})}, "the b stage's group-lr of fields"),
        ({"masked": StageConfig("b", 1.0, lr_end=0.0)}, "--masked.lr-end is 0.0"),
        ({"machine": MachineConfig(num_devices=2)}, "trains on one device"),
        ({"machine": MachineConfig(num_machines=2)}, "trains on one device"),
    ],
)
def test_impossible_settings_are_one_sentence_before_anything_is_written(tmp_path, changes, told):
    config = copy.deepcopy(hsi_sc_nerf.config)
    config.output_dir, config.timestamp, config.experiment_name = tmp_path, "run", "x"
    for name, value in changes.items():
        setattr(config, name, value)
    for refused in (config.save_config, lambda: config.setup(local_rank=0, world_size=1).setup()):
        with pytest.raises(SystemExit, match=rf"^hsi-sc-nerf: [^\n]*{told}[^\n]*\.$"):
            refused()
    assert list(tmp_path.iterdir()) == []


def poison(made, bad_steps, factor=float("inf")):
    """Make the batch of some steps infinite, as a damaged cube would, or so many times too bright."""
    original = made.pipeline.datamanager.next_train

    def next_train(step):
        rays, batch = original(step)
        if step in bad_steps:
            batch["spectral"] = batch["spectral"] * factor
        return rays, batch

    made.pipeline.datamanager.next_train = next_train


@pytest.mark.slow
def test_a_poisoned_step_is_skipped_and_named(tiny_dataset, tmp_path, capsys):
    made = trainer(tiny_dataset, tmp_path)
    poison(made, {2})
    made.train()
    assert "step 2 skipped: loss hsi_loss" in capsys.readouterr().out
    assert all(torch.isfinite(parameter).all() for parameter in made.pipeline.model.parameters())


@pytest.mark.slow
def test_a_loss_that_is_not_finite_is_named_even_if_its_gradient_is(tiny_dataset, tmp_path, capsys):
    made = trainer(tiny_dataset, tmp_path, max_num_iterations=2)
    original = made.pipeline.model.get_loss_dict
    made.pipeline.model.get_loss_dict = lambda *words: original(*words) | {"odd_loss": torch.tensor(float("inf"))}
    made.train()
    assert "step 1 skipped: loss odd_loss" in capsys.readouterr().out


@pytest.mark.slow
def test_a_run_that_keeps_failing_stops_with_its_last_good_weights(tiny_dataset, tmp_path):
    made = trainer(tiny_dataset, tmp_path, max_num_iterations=30)
    poison(made, range(1, 30))
    with pytest.raises(SystemExit, match=r"step 20 skipped.*last good checkpoint"):
        made.train()
    (checkpoint,) = made.checkpoint_dir.glob("*.ckpt")
    allow_nerfstudio_checkpoints()
    state = torch.load(checkpoint)  # the safe loader
    assert all(torch.isfinite(value).all() for value in state["pipeline"].values() if value.is_floating_point())


@pytest.mark.slow
def test_a_run_whose_loss_rises_and_stays_there_stops_with_the_checkpoint_before(tiny_dataset, tmp_path):
    made = trainer(tiny_dataset, tmp_path, max_num_iterations=60, steps_per_save=5)
    poison(made, range(15, 60), factor=30.0)
    with pytest.raises(SystemExit, match=r"^hsi-sc-nerf: step 29: [^\n]*last good checkpoint [^\n]*\.$"):
        made.train()
    (checkpoint,) = made.checkpoint_dir.glob("*.ckpt")
    assert 10 <= torch.load(checkpoint)["step"] < 20
    assert not list(made.base_dir.glob("stage-*"))


@pytest.mark.slow
def test_ctrl_c_is_one_line_and_names_the_last_checkpoint(tiny_dataset, tmp_path, capsys):
    made = trainer(tiny_dataset, tmp_path, steps_per_save=2)
    original = made.train_iteration

    def interrupted(step):
        if step == 3:
            raise KeyboardInterrupt
        return original(step)

    made.train_iteration = interrupted
    profiler.PROFILER.append(Mock())  # nerfstudio prints its times at the end, as long as there is one
    with pytest.raises(SystemExit) as ended:
        made.train()
    assert ended.value.code == 130
    assert not profiler.PROFILER
    told = [line for line in capsys.readouterr().err.splitlines() if "stopped" in line]
    assert told == [f"hsi-sc-nerf: stopped; --load-dir {made.checkpoint_dir} goes on from the last checkpoint."]
    assert [path.name for path in made.checkpoint_dir.iterdir()] == ["step-000000002.ckpt"]


def full_disk(*_, **__):
    raise OSError(28, "No space left on device")


@pytest.mark.slow
def test_a_full_disk_leaves_the_earlier_checkpoint(tiny_dataset, tmp_path, monkeypatch):
    made = trainer(tiny_dataset, tmp_path)
    made.save_checkpoint(0)
    before = list(made.checkpoint_dir.iterdir())
    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(SystemExit, match="No space left"):
        made.save_checkpoint(1)
    assert list(made.checkpoint_dir.iterdir()) == before
    assert [path for path in made.base_dir.iterdir() if path.name.startswith(".")] == []


@pytest.mark.slow
@pytest.mark.parametrize("room_bytes", [0, 10_000])
def test_a_disk_that_fills_up_in_training_is_one_sentence(
    tiny_dataset, tmp_path, monkeypatch, limit_of_files, room_bytes
):
    """No file fits, or the beginning of the logs does."""
    monkeypatch.setattr(writer, "EVENT_WRITERS", [])  # what has failed once fails in the runs after it
    made = trainer(tiny_dataset, tmp_path)
    told = r"^hsi-sc-nerf: [^\n]*free some space[^\n]*\.$"
    with limit_of_files(room_bytes), pytest.raises(SystemExit, match=told):
        made.train()
    assert list(made.base_dir.rglob("*.ckpt")) == []


@pytest.mark.slow
def test_logs_that_cannot_be_written_end_a_run_in_one_sentence(tiny_dataset, tmp_path, monkeypatch):
    made = trainer(tiny_dataset, tmp_path, max_num_iterations=2)
    monkeypatch.setattr(staged_trainer, "flush_logs", full_disk)
    with pytest.raises(SystemExit, match=rf"^hsi-sc-nerf: {made.base_dir}: [^\n]*No space left[^\n]*--load-dir\.$"):
        made.train()
    assert list(made.checkpoint_dir.iterdir())


@pytest.mark.slow
def test_cubes_that_vanish_in_training_are_named_when_they_are_needed(tiny_dataset, tmp_path):
    """Those of training views are open; held-out views are read at the end of a stage."""
    data = shutil.copytree(tiny_dataset[0], tmp_path / "data")
    made = trainer((data, None), tmp_path, max_num_iterations=2, evaluate_stages=True)
    shutil.rmtree(data / "cubes")
    with pytest.raises(SystemExit, match=r"^hsi-sc-nerf: [^\n]*cubes/[^\n]*\.$"):
        made.train()


@pytest.mark.slow
def test_a_timed_run_ends_by_the_clock_and_goes_on_from_its_checkpoint(tiny_dataset, tmp_path, monkeypatch):
    time = time_by_hand(monkeypatch)

    def timed_trainer(name, **changes):
        """Of steps of an eighth of a second, with an evaluation of 100 s after each stage."""
        made = trainer(tiny_dataset, tmp_path / name, evaluate_stages=True, **changes)

        def step_of(step, next_train=made.pipeline.datamanager.next_train):
            time.now += 0.125
            return next_train(step)

        def evaluation(**options):
            time.now += 100.0
            return {"psnr": 20.0}

        made.pipeline.datamanager.next_train = step_of
        made.pipeline.get_average_eval_image_metrics = evaluation
        made.train()
        return made, torch.load(max(made.checkpoint_dir.glob("*.ckpt")))

    made, state = timed_trainer("first", max_train_seconds=1.0)
    assert {path.name for path in made.base_dir.glob("stage-*")} == {"stage-full-frame", "stage-masked"}
    assert state["training"]["position"] == 1.0
    assert state["step"] == made._trained_step == 7
    _, later = timed_trainer("longer", max_train_seconds=6.0, load_dir=made.checkpoint_dir)
    # The second stage began after half a second, and now takes three.
    assert later["training"]["position"] == 3.5
    assert later["training"]["completed_stage"] == "masked"
    assert later["step"] == 27
    with pytest.raises(SystemExit, match=r"hsi-sc-nerf: [^\n]*--max-num-iterations"):
        trainer(tiny_dataset, tmp_path / "other", load_dir=made.checkpoint_dir)


@pytest.mark.slow
def test_a_pause_in_the_viewer_does_not_shorten_a_timed_run(tiny_dataset, tmp_path, monkeypatch):
    time, made = time_by_hand(monkeypatch), trainer(tiny_dataset, tmp_path, max_train_seconds=1.0)
    original = made.pipeline.datamanager.next_train

    def next_train(step):
        time.now += 0.125
        if step in (2, 3):
            made.training_state = "paused"
        return original(step)

    def resumed(_):
        time.now += 1000.0
        made.training_state = "training"

    made.pipeline.datamanager.next_train = next_train
    monkeypatch.setattr(nerfstudio_trainer, "time", Mock(sleep=resumed))
    made.train()
    assert time.now > 2000.0
    assert (made._trained_step, made.schedule.position) == (7, 1.0)


@pytest.mark.slow
def test_single_steps_run_without_the_loop_of_nerfstudio(tiny_dataset, tmp_path):
    made = trainer(tiny_dataset, tmp_path, max_num_iterations=2)
    made._show_progress = lambda step, psnr_db: None
    for step in range(2):
        assert not made.stop_training
        made.train_iteration(step)
    assert made.stop_training
