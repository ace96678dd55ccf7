import pytest

from hsi_sc_nerf import paper
from hsi_sc_nerf.models.stages import Stage, StageConfig, full_frame_stage, masked_stage, plan_stages


def lengths(plan):
    return [stage.end - stage.start for stage in plan.stages]


def test_defaults_are_the_papers_iterations():
    plan = plan_stages((full_frame_stage(), masked_stage()), sum(paper.STAGE_ITERATIONS))
    assert lengths(plan) == list(paper.STAGE_ITERATIONS)


@pytest.mark.parametrize("total", [1, 2, 7, 301])
def test_shares_always_add_up_to_the_total(total):
    plan = plan_stages((StageConfig("a", 0.3), StageConfig("b", 0.7)), total)
    assert plan.num_iterations == total == sum(lengths(plan))


def test_own_lengths_go_before_shares():
    configs = (StageConfig("a", 0.5), StageConfig("b", 0.5, num_iterations=30))
    assert lengths(plan_stages(configs, 100)) == [70, 30]
    both = (StageConfig("a", 0.5, num_iterations=10), StageConfig("b", 0.5, num_iterations=30))
    assert lengths(plan_stages(both, 1000)) == [10, 30]


def test_a_stage_of_no_steps_is_left_out():
    configs = (StageConfig("a", 0.5, num_iterations=0), StageConfig("b", 0.5))
    plan = plan_stages(configs, 5)
    assert [stage.config.name for stage in plan.stages] == ["b"]


def test_impossible_plans_are_refused():
    with pytest.raises(ValueError, match="exceed"):
        plan_stages((StageConfig("a", 0.5, num_iterations=10), StageConfig("b", 0.5)), 5)
    with pytest.raises(ValueError, match="no iterations"):
        plan_stages((StageConfig("a", 1.0),), 0)


def test_every_step_belongs_to_the_stage_that_covers_it():
    plan = plan_stages((StageConfig("a", 0.5), StageConfig("b", 0.5)), 10)
    assert [plan.at(step).config.name for step in (0, 4, 5, 9, 99)] == ["a", "a", "b", "b", "b"]


def test_learning_rate_falls_exponentially_within_the_stage():
    stage = Stage(StageConfig("a", 1.0, lr_start=0.5, lr_end=0.005), start=10, end=111)
    assert stage.lr_factor(10) == pytest.approx(0.5)
    assert stage.lr_factor(60) == pytest.approx(0.05)
    assert stage.lr_factor(110) == pytest.approx(0.005)


def test_warm_up_rises_from_nearly_nothing():
    stage = Stage(StageConfig("a", 1.0, lr_end=1.0, warmup_iterations=4), start=0, end=100)
    assert [stage.lr_factor(step) for step in (0, 1, 4, 50)] == pytest.approx([0.2, 0.4, 1.0, 1.0])


def test_poses_move_once_the_scene_has_a_shape():
    first = Stage(StageConfig("a", 1.0, poses_after=0.25), start=10, end=30)
    assert [step for step in range(10, 30) if first.refines_poses(step)] == list(range(15, 30))
    at_once = Stage(StageConfig("a", 1.0, poses_after=0.0), start=10, end=12)
    assert [at_once.refines_poses(step) for step in (10, 11)] == [True, True]
    never = Stage(StageConfig("b", 1.0, optimize_poses=False), start=30, end=50)
    assert not any(never.refines_poses(step) for step in range(30, 50))
