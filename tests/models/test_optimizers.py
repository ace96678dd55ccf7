"""Steps that are not finite, Muon's step against its closed form, and which parameters it moves."""

import pytest
import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from small_trainer import trainer
from torch.amp.grad_scaler import GradScaler

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.optimizers import GuardedOptimizers, MuonOptimizerConfig

pytestmark = pytest.mark.usefixtures("quick_start")


def optimizers():
    groups = {name: [torch.nn.Parameter(torch.ones(3))] for name in ("fields", "camera_opt")}
    config = {name: {"optimizer": AdamOptimizerConfig(lr=0.1), "scheduler": None} for name in groups}
    return GuardedOptimizers(config, groups), groups


def step(optimizers, groups):
    optimizers.optimizer_scaler_step_some(GradScaler("cpu", enabled=False), list(groups))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_non_finite_gradient_changes_no_group_and_finite_ones_step(bad):
    guarded, groups = optimizers()
    groups["fields"][0].grad = torch.ones(3)
    groups["camera_opt"][0].grad = torch.tensor([0.0, bad, 0.0])
    step(guarded, groups)
    assert guarded.skipped_groups == ("camera_opt",)
    assert all((parameters[0] == 1.0).all() for parameters in groups.values())
    groups["camera_opt"][0].grad = None
    step(guarded, groups)
    assert guarded.skipped_groups == ()
    assert (groups["fields"][0] < 1.0).all()
    assert (groups["camera_opt"][0] == 1.0).all()


@pytest.mark.parametrize("shape", [(16, 64), (64, 20), (64, 64)])
def test_a_step_of_muon_has_the_gradients_directions_and_no_sizes(shape):
    """Of any gradient; its singular values are nearly all alike, and as large as the learning rate."""
    generator = torch.Generator().manual_seed(1)
    gradient = torch.randn(shape, generator=generator) @ torch.diag(torch.logspace(0, -2, shape[1]))
    weights = torch.nn.Parameter(torch.zeros(shape))
    weights.grad = 1e-3 * gradient
    MuonOptimizerConfig(lr=0.1).setup(params=[weights]).step()
    left, _, right = torch.linalg.svd(gradient, full_matrices=False)
    in_its_directions = left.T @ -weights.detach() @ right.T / (0.1 * max(1.0, shape[0] / shape[1]) ** 0.5)
    sizes = in_its_directions.diagonal()
    assert sizes[: len(sizes) // 2].min() > 0.6
    assert sizes.max() < 1.3
    assert (in_its_directions - torch.diag(sizes)).abs().max() < 0.1


@pytest.mark.slow
def test_muon_moves_the_networks_weights_alone(tiny_dataset, tmp_path):
    made = trainer(tiny_dataset, tmp_path)
    groups = made.pipeline.get_param_groups()
    assert all(parameter.ndim == 2 for parameter in groups["field_networks"])
    assert len(groups["field_networks"]) == 8
    grids = [p for name, p in made.pipeline.model.field.named_parameters() if name.endswith("hash_table")]
    assert {id(grid) for grid in grids} <= {id(parameter) for parameter in groups["fields"]}
    everything = [id(parameter) for group in groups.values() for parameter in group]
    assert len(everything) == len(set(everything))
    assert {id(p) for p in made.pipeline.model.field.parameters()} <= set(everything)


def test_settings_of_an_older_version_are_refused():
    guarded, groups = optimizers()
    with pytest.raises(InputError, match="field_networks"):
        GuardedOptimizers(guarded.config, {**groups, "field_networks": [torch.nn.Parameter(torch.ones(2, 2))]})
