import pytest

from hsi_sc_nerf import paper
from hsi_sc_nerf.models.stages import (
    Stage,
    StageConfig,
    exponential_decay,
    full_frame_stage,
    masked_stage,
    plan_after,
    plan_stages,
    plan_within,
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
    assert plan.num_iterations == total == sum(lengths(plan))


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
    with pytest.raises(ValueError, match="exceed"):
        plan_stages((StageConfig("a", 0.5, num_iterations=10), StageConfig("b", 0.5)), 5)
    with pytest.raises(ValueError, match="fractions add up to 0"):
        plan_stages((StageConfig("a", 0.0), StageConfig("b", 0.0)), 5)
    with pytest.raises(ValueError, match="no iterations"):
        plan_stages((StageConfig("a", 1.0),), 0)


def test_every_step_belongs_to_the_stage_that_covers_it():
    plan = plan_stages((StageConfig("a", 0.5), StageConfig("b", 0.5)), 10)
    assert [plan.at(step).config.name for step in (0, 4, 5, 9, 99)] == ["a", "a", "b", "b", "b"]


def test_learning_rate_falls_exponentially_within_the_stage():
    stage = Stage(StageConfig("a", 1.0, lr_start=0.5, lr_end=0.005), start=10, end=111)
    assert [stage.lr_factor(step, "fields") for step in (10, 60, 110)] == pytest.approx([0.5, 0.05, 0.005])


def test_a_group_may_have_learning_rates_of_its_own():
    stage = Stage(StageConfig("a", 1.0, lr_end=1.0, group_lr={"camera_opt": (2.0, 0.02)}), start=10, end=111)
    assert [stage.lr_factor(step, "camera_opt") for step in (10, 60, 110)] == pytest.approx([2.0, 0.2, 0.02])
    assert stage.lr_factor(110, "fields") == 1.0


def test_released_schedule_hardly_decays_over_the_stages():
    """nerfacto's exponential decay to 1e-4 of 1e-2 over 200k steps, of which the paper runs 20k, then 20k again."""
    ends = [exponential_decay(0.01, 200_000, step) for step in (0, 20_000, 40_000)]
    assert ends == pytest.approx([1.0, 0.630957, 0.398107], rel=1e-5)
    first = Stage(StageConfig("a", 1.0, lr_start=ends[0], lr_end=ends[1]), start=0, end=20_001)
    assert first.lr_factor(7_000, "fields") == pytest.approx(exponential_decay(0.01, 200_000, 7_000))
    assert exponential_decay(0.01, 200_000, 300_000) == 0.01


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


def test_a_stage_sets_the_loss_weights_that_it_names():
    assert StageConfig("a", 1.0).loss_weights() == {}
    assert StageConfig("a", 1.0, angular_loss_mult=0.0).loss_weights() == {"angular_loss_mult": 0.0}


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"foreground_ray_fraction": 1.2}, "foreground-ray-fraction 1.2"),
        ({"boundary_ray_fraction": -0.1}, "boundary-ray-fraction -0.1"),
        ({"fraction": -0.5}, "fraction -0.5 is below 0"),
        ({"lr_end": 0.0}, "lr-end 0.0 is not above 0"),
        ({"group_lr": {"fields": (1.0, -1.0)}}, "group-lr of fields"),
        ({"frozen_groups": ("poses",)}, "no parameter group is named 'poses'; there are fields, camera_opt"),
        ({"learn_after": {"table": 0.1}}, "named 'table'"),
    ],
)
def test_impossible_stages_are_refused(fields, sentence):
    with pytest.raises(ValueError, match=f"late: .*{sentence}"):
        StageConfig("late", **({"fraction": 1.0, "learn_after": {}} | fields)).check(("fields", "camera_opt"))
    StageConfig("late", 1.0, foreground_ray_fraction=1.0).check(("fields", "camera_opt"))


def test_a_completed_stage_is_followed_by_the_next_however_long_it_was():
    plan = plan_stages((StageConfig("a", 1.0), StageConfig("b", 1.0), StageConfig("c", 1.0)), 30)
    for next_step in (4, 10, 25):
        after = plan_after(plan, "a", next_step)
        assert [(stage.config.name, stage.end) for stage in after.stages] == [
            ("a", next_step),
            ("b", next_step + 10),
            ("c", next_step + 20),
        ]
        assert after.at(next_step).config.name == "b"
    assert plan_after(plan, "a", 10) == plan
    assert plan_after(plan, "c", 12) == plan
    assert plan_after(plan, "gone", 12) == plan


def test_a_stage_that_began_elsewhere_stays_there():
    plan = plan_stages((StageConfig("a", 1.0), StageConfig("b", 1.0), StageConfig("c", 1.0)), 30)
    for start in (4, 25):
        within = plan_within(plan, "b", start)
        assert [(stage.config.name, stage.end) for stage in within.stages] == [
            *(("a", start), ("b", start + 10), ("c", start + 20))
        ]
        assert within.at(start).start == start
    assert plan_within(plan, "b", 10) == plan_within(plan, "d", 7) == plan


def test_every_step_has_random_numbers_of_its_own():
    seeds = {step_seed(seed, step) for seed in (0, 1) for step in range(1000)}
    assert len(seeds) == 2000
    assert step_seed(3, 7) == step_seed(3, 7)
