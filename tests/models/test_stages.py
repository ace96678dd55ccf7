import pytest

from hsi_sc_nerf import paper
from hsi_sc_nerf.config import hsi_sc_nerf_paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.stages import (
    Stage,
    StageConfig,
    full_frame_stage,
    masked_stage,
    plan_stages,
    resumed_plan,
    step_seed,
)


def lengths(plan):
    return [stage.end - stage.start for stage in plan.stages]


def test_defaults_are_the_papers_iterations():
    plan = plan_stages((full_frame_stage(), masked_stage()), sum(paper.STAGE_ITERATIONS))
    assert lengths(plan) == list(paper.STAGE_ITERATIONS)


@pytest.mark.parametrize("total", [1, 2, 7, 301])
def test_fractions_add_up_to_the_total(total):
    plan = plan_stages((StageConfig("a", 0.3), StageConfig("b", 0.7)), total)
    assert plan.length == total == sum(lengths(plan))


def test_lengths_replace_fractions():
    configs = (StageConfig("a", 0.5), StageConfig("b", 0.5, num_iterations=30))
    assert lengths(plan_stages(configs, 100)) == [70, 30]
    both = (StageConfig("a", 0.5, num_iterations=10), StageConfig("b", 0.5, num_iterations=30))
    assert lengths(plan_stages(both, 1000)) == [10, 30]


def test_a_stage_of_no_steps_is_left_out():
    configs = (StageConfig("a", 0.5, num_iterations=0), StageConfig("b", 0.5))
    plan = plan_stages(configs, 5)
    assert [stage.config.name for stage in plan.stages] == ["b"]


def test_impossible_plans_are_refused():
    with pytest.raises(InputError, match="exceed"):
        plan_stages((StageConfig("a", 0.5, num_iterations=10), StageConfig("b", 0.5)), 5)
    with pytest.raises(InputError, match="fractions add up to 0"):
        plan_stages((StageConfig("a", 0.0), StageConfig("b", 0.0)), 5)
    with pytest.raises(InputError, match="nothing to train"):
        plan_stages((StageConfig("a", 1.0),), 0)
    assert lengths(plan_stages((StageConfig("a", 0.5, num_iterations=10), StageConfig("b", 0.0)), 10)) == [10]


def test_every_step_belongs_to_the_stage_that_covers_it():
    plan = plan_stages((StageConfig("a", 0.5), StageConfig("b", 0.5)), 10)
    assert [plan.at(step).config.name for step in (0, 4, 5, 9, 99)] == ["a", "a", "b", "b", "b"]


@pytest.mark.parametrize("timed", [False, True])
def test_a_surface_becomes_harder_in_three_fifths_of_its_stage(timed):
    stage = Stage(StageConfig("masked", 0.5, rise_length=0.03), 100, 200, timed)
    rises = [stage.rise_length(position) for position in (100, 130, 160, 200)]
    assert rises == pytest.approx([0.01, 0.02, 0.03, 0.03])
    assert Stage(full_frame_stage(), 0, 100).rise_length(50) == 0.0


def test_learning_rates_fall_exponentially_within_the_stage_and_a_group_may_have_its_own():
    stage = Stage(
        StageConfig("a", 1.0, lr_start=0.5, lr_end=0.005, group_lr={"camera_opt": (2.0, 0.02)}), 10, end=111
    )
    assert [stage.lr_factor(step, "fields") for step in (10, 60, 110)] == pytest.approx([0.5, 0.05, 0.005])
    assert [stage.lr_factor(step, "camera_opt") for step in (10, 60, 110)] == pytest.approx([2.0, 0.2, 0.02])


def test_released_schedule_hardly_decays_over_the_stages():
    """nerfacto's exponential decay to 1e-4 of 1e-2 over 200k steps, of which the paper runs 20k, then 20k again."""
    config = hsi_sc_nerf_paper.config
    ends = [config.full_frame.lr_start, config.full_frame.lr_end, config.masked.lr_start, config.masked.lr_end]
    assert ends == pytest.approx([1.0, 0.630957, 0.630957, 0.398107], rel=1e-5)


def test_poses_move_once_the_scene_has_a_shape():
    first = Stage(StageConfig("a", 1.0, learn_after={"camera_opt": 0.25}), start=10, end=30)
    assert [step for step in range(10, 30) if first.learns("camera_opt", step)] == list(range(15, 30))
    assert all(first.learns("fields", step) for step in range(10, 30))
    at_once = Stage(StageConfig("a", 1.0, learn_after={}), start=10, end=12)
    assert [at_once.learns("camera_opt", step) for step in (10, 11)] == [True, True]


def test_any_group_can_be_frozen():
    groups = ("camera_opt", "proposal_networks", "fields")
    stage = Stage(StageConfig("b", 1.0, frozen_groups=groups[:2]), start=30, end=50)
    assert [stage.learns(group, 49) for group in groups] == [False, False, True]
    assert Stage(masked_stage(), 0, 2).learns("camera_opt", 1) is False


ABC = plan_stages((StageConfig("a", 1.0), StageConfig("b", 1.0), StageConfig("c", 1.0)), 30)


def ends(plan):
    return [(stage.config.name, stage.end) for stage in plan.stages]


@pytest.mark.parametrize("boundary", [4, 25])
def test_a_stage_that_ended_or_began_elsewhere_is_followed_by_whole_stages(boundary):
    for plan in (resumed_plan(ABC, "a", 0, completed_at=boundary), resumed_plan(ABC, "b", boundary)):
        assert ends(plan) == [("a", boundary), ("b", boundary + 10), ("c", boundary + 20)]
        assert (plan.at(boundary).config.name, plan.at(boundary).start) == ("b", boundary)


def test_a_checkpoint_of_the_same_plan_changes_nothing():
    assert resumed_plan(ABC, "a", 0) == resumed_plan(ABC, "b", 10) == ABC
    assert resumed_plan(ABC, "a", 0, completed_at=10) == resumed_plan(ABC, "c", 20, completed_at=30) == ABC
    assert resumed_plan(ABC, "gone", 7) == resumed_plan(ABC, "gone", 7, completed_at=12) == ABC


def test_every_step_has_random_numbers_of_its_own():
    seeds = {step_seed(seed, step) for seed in (0, 1) for step in range(1000)}
    assert len(seeds) == 2000
    assert step_seed(3, 7) == step_seed(3, 7)
