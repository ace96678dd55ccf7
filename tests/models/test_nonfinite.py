import pytest
import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from torch.amp.grad_scaler import GradScaler

from hsi_sc_nerf.models.nonfinite import GuardedOptimizers, NonFiniteGuard, TrainingDivergedError, non_finite_names


def optimizers():
    groups = {name: [torch.nn.Parameter(torch.ones(3))] for name in ("fields", "camera_opt")}
    config = {name: {"optimizer": AdamOptimizerConfig(lr=0.1), "scheduler": None} for name in groups}
    return GuardedOptimizers(config, groups), groups


def step(optimizers, groups):
    optimizers.optimizer_scaler_step_some(GradScaler("cpu", enabled=False), list(groups))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_non_finite_gradient_changes_no_group(bad):
    guarded, groups = optimizers()
    groups["fields"][0].grad = torch.ones(3)
    groups["camera_opt"][0].grad = torch.tensor([0.0, bad, 0.0])
    step(guarded, groups)
    assert guarded.skipped_groups == ("camera_opt",)
    assert all((parameters[0] == 1.0).all() for parameters in groups.values())


def test_finite_gradients_step():
    guarded, groups = optimizers()
    groups["fields"][0].grad = torch.ones(3)
    step(guarded, groups)
    assert guarded.skipped_groups == ()
    assert (groups["fields"][0] < 1.0).all()
    assert (groups["camera_opt"][0] == 1.0).all()


def test_names_of_non_finite_terms():
    losses = {"hsi_loss": torch.tensor(1.0), "angular_loss": torch.tensor(float("nan"))}
    assert non_finite_names(losses) == ["angular_loss"]
    assert non_finite_names({}) == []


def test_guard_names_the_step_and_stops_after_the_limit_in_a_row():
    guard = NonFiniteGuard(limit=3)
    assert guard.record(0, [], []) is None
    assert "step 1 skipped: loss hsi_loss" in guard.record(1, ["hsi_loss"], ["fields"])
    assert "gradient of fields" in guard.record(2, [], ["fields"])
    assert guard.record(3, [], []) is None
    guard.record(4, ["hsi_loss"], [])
    guard.record(5, ["hsi_loss"], [])
    with pytest.raises(TrainingDivergedError, match="step 6"):
        guard.record(6, ["hsi_loss"], [])


def test_mixed_precision_counts_the_steps_that_a_small_scale_skips():
    """A large scale overflows by design; one below 1 does not."""
    guarded, groups = optimizers()
    scaler = GradScaler("cpu", init_scale=4.0)
    scaler.scale(torch.zeros(()))
    noticed = []
    for bad in (float("inf"),) * 5 + (1.0,) * 3:
        groups["fields"][0].grad = torch.full((3,), bad)
        guarded.optimizer_scaler_step_some(scaler, ["fields"])
        scaler.update()
        noticed.append(guarded.skipped_groups)
    # 4, 2, 1, 1/2, 1/4, 1/8: the third, fourth and fifth skipped steps, each told at the step after it.
    assert noticed == [(), (), (), ("fields",), ("fields",), ("fields",), (), ()]
    assert (groups["fields"][0] < 1.0).all()
