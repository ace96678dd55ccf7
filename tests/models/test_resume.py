"""A run that is killed and resumed comes to the very weights of one that was not; stages leave their results."""

import copy
import json
import shutil
from unittest.mock import Mock

import pytest
import torch
from nerfstudio.configs.base_config import MachineConfig
from small_trainer import trainer

from hsi_sc_nerf.models import checkpoints
from hsi_sc_nerf.models.pipeline import SpectralPipeline
from hsi_sc_nerf.models.run_settings import read_config
from hsi_sc_nerf.models.stages import full_frame_stage

pytestmark = pytest.mark.usefixtures("quick_start")

SWITCH, STEPS = 8, 20
EVALUATIONS = {"steps_per_eval_batch": 5, "steps_per_eval_image": 13}


class Killed(BaseException):
    """Stands for the end of a process."""


def longer(tiny_dataset, folder, switch=SWITCH, **changes):
    """A run long enough for the proposal networks to learn at some steps only."""
    first = full_frame_stage()
    first.num_iterations, first.learn_after = switch, {"camera_opt": 0.5}
    options = {"full_frame": first, "max_num_iterations": STEPS, "steps_per_save": 3}
    torch.manual_seed(99 if "load_dir" in changes else 0)  # ns-train seeds the weights; a checkpoint replaces them
    made = trainer(tiny_dataset, folder, **(options | changes))
    model = made.pipeline.model.config
    model.proposal_warmup, model.proposal_update_every = 1, 4
    return made


def fail_in(made, part, method, when):
    original = getattr(part, method)

    def failing(*arguments, **options):
        if when(*arguments, **options):
            raise Killed
        return original(*arguments, **options)

    setattr(part, method, failing)
    with pytest.raises(Killed):
        made.train()


def differences(first, second, path=""):
    """Places in two checkpoints whose contents differ by so much as a bit."""
    if isinstance(first, torch.Tensor):
        return [] if torch.equal(first, second) else [path]
    if isinstance(first, dict):
        keys = sorted(map(str, first.keys() ^ second.keys()))
        return keys + [
            d for key in first.keys() & second for d in differences(first[key], second[key], f"{path}/{key}")
        ]
    if isinstance(first, list | tuple):
        pairs = enumerate(zip(first, second, strict=True))
        return [d for i, pair in pairs for d in differences(*pair, f"{path}/{i}")]
    return [] if first == second else [path]


def checkpoint(folder):
    return torch.load(max(folder.glob("*.ckpt")))


@pytest.fixture(scope="module")
def whole(tiny_dataset, tmp_path_factory):
    """A run from beginning to end that evaluates on the way."""
    made = longer(tiny_dataset, tmp_path_factory.mktemp("whole"), evaluate_stages=True, **EVALUATIONS)
    made.train()
    return made


@pytest.mark.slow
def test_the_same_seed_gives_the_same_weights_and_another_does_not(tiny_dataset, tmp_path):
    usual, weights = torch.get_num_threads(), []
    for number, seed in enumerate((3, 3, 4)):
        machine = MachineConfig(seed=seed, device_type="cpu")
        options = {"switch": 1, "max_num_iterations": 2, "machine": machine}
        made = longer(tiny_dataset, tmp_path / str(number), **options)
        torch.set_num_threads(2)  # what is summed by several could depend on which is first
        try:
            made.train()
        finally:
            torch.set_num_threads(usual)
        weights.append(checkpoint(made.checkpoint_dir))
        torch.rand(7)  # what was drawn before does not matter
    assert differences(weights[0], weights[1]) == []
    assert len(differences(weights[0], weights[2])) > 10


@pytest.mark.slow
@pytest.mark.parametrize("killed_at", [5, SWITCH, 15])
def test_killed_and_resumed(tiny_dataset, tmp_path, whole, killed_at):
    made = longer(tiny_dataset, tmp_path)
    fail_in(made, made.pipeline.datamanager, "next_train", lambda step: step == killed_at)
    torch.rand(7)  # another process has other random numbers
    resumed = longer(tiny_dataset, tmp_path, load_dir=made.checkpoint_dir)
    assert 0 < resumed._start_step <= killed_at
    resumed.train()
    first, second = checkpoint(whole.checkpoint_dir), checkpoint(resumed.checkpoint_dir)
    assert first["step"] == STEPS - 1
    assert differences(first, second) == []


@pytest.mark.slow
def test_both_stages_leave_their_held_out_metrics(whole):
    made = whole
    for name, step in (("full-frame", SWITCH - 1), ("masked", STEPS - 1)):
        folder = made.base_dir / f"stage-{name}"
        assert {path.name for path in folder.iterdir()} == {f"step-{step:09d}.ckpt", f"step-{step:09d}.json"}
        found = json.loads((folder / f"step-{step:09d}.json").read_text())
        assert (found["stage"], found["step"]) == (name, step)
        assert {"sam", "rmse", "ssim", "psnr", "full_sam", "full_psnr", "psnr_std"} <= found["results"].keys()
    # What stands there is what ns-eval gives with the stage's checkpoint: the last one's weights are still there.
    again = made.pipeline.get_average_eval_image_metrics(get_std=True)
    assert again["psnr"] == pytest.approx(found["results"]["psnr"], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["full-frame", "masked"])
def test_killed_while_a_stage_is_evaluated(tiny_dataset, tmp_path, monkeypatch, stage):
    values = {f"{prefix}{name}": 0.5 for prefix in ("", "full_") for name in ("sam", "rmse", "ssim", "psnr")}
    monkeypatch.setattr(SpectralPipeline, "get_average_eval_image_metrics", lambda *_, **__: values)
    made = longer(tiny_dataset, tmp_path / "killed", max_num_iterations=SWITCH + 1, evaluate_stages=True)
    last = SWITCH - (stage == "full-frame")
    fail_in(made, made.pipeline, "get_average_eval_image_metrics", lambda step, **_: step == last)
    assert not (made.base_dir / f"stage-{stage}").exists()

    options = {"load_dir": made.checkpoint_dir, "max_num_iterations": SWITCH + 1, "evaluate_stages": True}
    resumed = longer(tiny_dataset, tmp_path / "resumed", **options)
    resumed.train()
    for name in {stage, "masked"}:
        assert {path.suffix for path in (resumed.base_dir / f"stage-{name}").iterdir()} == {".ckpt", ".json"}


@pytest.mark.slow
def test_a_first_stage_of_any_length_is_followed_by_the_second(tiny_dataset, tmp_path, whole):
    made = longer(tiny_dataset, tmp_path, switch=15, load_dir=whole.base_dir / "stage-full-frame")
    seen = []
    original = made.pipeline.datamanager.next_train

    def next_train(step):
        rays, batch = original(step)
        seen.append((step, batch["mask"].float().mean().item()))
        return rays, batch

    made.pipeline.datamanager.next_train = next_train
    made.train()
    assert not (made.base_dir / "stage-full-frame").exists()  # the first run has kept it
    assert seen == [(step, 0.75) for step in range(SWITCH, SWITCH + STEPS - 15)]
    assert checkpoint(made.checkpoint_dir)["training"]["completed_stage"] == "masked"


@pytest.mark.slow
def test_a_second_stage_after_another_runs_first_is_resumed_where_it_was(tiny_dataset, tmp_path, whole):
    """The settings alone would put its steps back into the first stage."""
    made = longer(tiny_dataset, tmp_path / "killed", switch=15, load_dir=whole.base_dir / "stage-full-frame")
    fail_in(made, made.pipeline.datamanager, "next_train", lambda step: step == SWITCH + 3)
    resumed = longer(tiny_dataset, tmp_path / "resumed", switch=15, load_dir=made.checkpoint_dir)
    assert SWITCH < resumed._start_step <= SWITCH + 3
    assert resumed.schedule.plan == made.schedule.plan
    assert resumed.schedule.plan.at(resumed._start_step).config.name == "masked"


@pytest.mark.slow
def test_a_finished_run_that_is_extended_stays_in_its_last_stage(tiny_dataset, tmp_path, whole):
    """Though its last step may be where the first stage of the longer run would end."""
    made = longer(tiny_dataset, tmp_path, switch=STEPS, max_num_iterations=2 * STEPS, load_dir=whole.checkpoint_dir)
    assert made.schedule.plan.at(STEPS).config.name == "masked"
    assert made.schedule.plan.length == SWITCH + STEPS
    made._keep_stage_of(made._loaded)
    assert not list(made.base_dir.glob("stage-*"))


@pytest.mark.slow
def test_a_finished_run_has_nothing_left_to_train(tiny_dataset, tmp_path, whole):
    with pytest.raises(SystemExit, match="max-num-iterations"):
        longer(tiny_dataset, tmp_path, load_dir=whole.checkpoint_dir).train()


@pytest.mark.slow
def test_unusable_checkpoints_are_refused_in_a_sentence_and_leave_no_run(tiny_dataset, tmp_path, whole):
    new, damaged = tmp_path / "new", tmp_path / "step-000000003.ckpt"

    def begin(config):
        """As ns-train does."""
        config.save_config()
        config.setup(local_rank=0, world_size=1).setup()

    def refuse(told):
        config = copy.deepcopy(whole.config)
        config.output_dir, config.load_dir = new, tmp_path
        with pytest.raises(SystemExit, match=rf"^hsi-sc-nerf: [^\n]*{told}[^\n]*\.$"):
            begin(config)
        assert [path for path in new.rglob("*") if not path.is_dir() or path.name == "run"] == []

    refuse("holds no checkpoint; --load-dir takes")
    (tmp_path / "step-best.ckpt").write_bytes(b"")
    refuse("holds no checkpoint; --load-dir takes")
    good = max(whole.checkpoint_dir.glob("*.ckpt")).read_bytes()
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 1
    for content in (good[:1000], flipped):
        damaged.write_bytes(content)
        refuse("step-000000003.ckpt: is not a readable checkpoint")
    known = checkpoint(whole.checkpoint_dir)
    torch.save({"step": 3}, damaged)
    refuse("is not a checkpoint that hsi-sc-nerf can continue from")
    torch.save(known | {"training": 0}, damaged)
    refuse("step-000000003.ckpt: holds no state of a training")
    torch.save(known | {"training": {}}, damaged)
    refuse("step-000000003.ckpt: holds no state of a training")
    correction = {"_model.background.correction": torch.zeros(2, 2, 12)}
    torch.save(known | {"pipeline": known["pipeline"] | correction}, damaged)
    refuse("other settings of the model")


@pytest.mark.slow
def test_a_run_that_went_on_from_a_step_is_evaluated_at_its_last(tiny_dataset, tmp_path, whole, monkeypatch):
    """nerfstudio's evaluation takes ``load_step`` of config.yml for the step to evaluate. It is read once."""
    read = Mock(side_effect=checkpoints.require_whole)
    monkeypatch.setattr(checkpoints, "require_whole", read)
    step = checkpoint(whole.checkpoint_dir)["step"]
    earlier = tmp_path / "earlier"
    shutil.copytree(whole.checkpoint_dir, earlier)
    (earlier / "step-000000099.ckpt").write_bytes(b"damaged")
    made = longer(tiny_dataset, tmp_path, load_dir=earlier, load_step=step)
    assert made._start_step == step + 1
    assert read.call_count == 1
    saved = read_config(made.base_dir / "config.yml")
    assert (saved.load_dir, saved.load_step) == (earlier, None)
