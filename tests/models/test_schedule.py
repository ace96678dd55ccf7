"""Runs by iterations and by the clock, and clocks that pause."""

import numpy as np
import pytest
from clock_by_hand import Time, time_by_hand

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.schedule import Schedule, TrainingClock
from hsi_sc_nerf.models.stages import StageConfig, plan_stages

CONFIGS = (StageConfig("a", 1.0, learn_after={"camera_opt": 0.5}), StageConfig("b", 3.0, lr_start=0.5, lr_end=0.02))


@pytest.fixture
def timed(monkeypatch):
    """Makes schedules of eight seconds, whose clock is the returned one."""
    time = time_by_hand(monkeypatch)
    return time, lambda clock="wall": Schedule(plan_stages(CONFIGS, 8.0, timed=True), clock)


def steps(schedule, time, seconds, first=0):
    """Stage, position and learning-rate factor of each step, until the run is complete."""
    found, step = [], first
    while not schedule.complete:
        schedule.begin_step(step)
        found.append(
            (
                schedule.stage.config.name,
                schedule.position,
                schedule.stage.lr_factor(schedule.position, "fields"),
            )
        )
        time.now += seconds
        schedule.end_step(step)
        step += 1
    return found


def test_a_run_by_iterations_has_each_stage_of_its_length():
    schedule = Schedule(plan_stages(CONFIGS, 8))
    assert [name for name, *_ in steps(schedule, Time(), 5.0)] == ["a"] * 2 + ["b"] * 6


@pytest.mark.parametrize("clock", ["wall", "cpu"])
def test_stages_and_rates_of_a_timed_run_follow_the_clock(timed, clock):
    time, make = timed
    coarse, fine = (steps(make(clock), time, seconds) for seconds in (0.5, 0.125))
    assert [name for name, *_ in coarse] == ["a"] * 4 + ["b"] * 12
    # Four times as many steps, with the same rates at the same times.
    assert coarse == fine[::4]
    assert coarse[4][2] == pytest.approx(0.5)
    assert coarse[10][2] == pytest.approx((0.5 * 0.02) ** 0.5)


def test_the_part_of_the_last_stage_grows_from_its_start():
    schedule, parts = Schedule(plan_stages(CONFIGS, 8)), []
    for step in range(8):
        schedule.begin_step(step)
        parts.append(schedule.part_of_last_stage)
        schedule.end_step(step)
    assert parts[:2] == [None, None]
    assert parts[2:] == pytest.approx(np.arange(6) / 6)


def test_a_step_that_outlasts_a_stage_does_not_skip_the_next(timed):
    time, make = timed
    assert [name for name, *_ in steps(make(), time, 20.0)] == ["a", "b"]


def test_groups_begin_to_learn_by_the_clock():
    first = plan_stages(CONFIGS, 8.0, timed=True).stages[0]
    assert [first.learns("camera_opt", seconds) for seconds in (0.0, 0.99, 1.0, 1.9)] == [False, False, True, True]


def test_pauses_do_not_count(timed):
    time, make = timed
    schedule = make()
    schedule.begin_step(0)
    time.now += 1.0
    with schedule.clock.paused():
        time.now += 1000.0
        with schedule.clock.paused():
            time.now += 1000.0
    time.now += 0.5
    schedule.end_step(0)
    assert schedule.position == pytest.approx(1.5)


def test_the_clock_waits_for_the_gpu_before_and_after_a_pause():
    now, waits = {"wall": 100.0, "cpu": 50.0}, []
    clock = TrainingClock(lambda: waits.append(1), 0.0, lambda: now["wall"], lambda: now["cpu"])
    now.update(wall=110.0, cpu=65.0)
    with clock.paused() as seconds:
        now.update(wall=1000.0, cpu=900.0)
    assert seconds == (10.0, 15.0)
    now.update(wall=1002.0, cpu=903.0)
    assert clock.read() == (12.0, 18.0)
    assert len(waits) == 2


def test_a_resumed_run_goes_on_at_its_second(timed):
    time, make = timed
    schedule = make()
    for step in range(5):
        schedule.begin_step(step)
        time.now += 0.6
        schedule.end_step(step)
    state = schedule.state()
    time.now += 5000.0
    resumed = make()
    resumed.resume(state, 5)
    assert resumed.plan == schedule.plan
    found = steps(resumed, time, 0.6, first=5)
    assert found[0][:2] == ("b", pytest.approx(3.0))
    assert len(found) == 9


def test_a_stage_that_was_complete_is_followed_by_the_next(timed):
    time, make = timed
    schedule = make()
    schedule.begin_step(0)
    time.now += 2.5
    schedule.end_step(0)
    assert schedule.stage_complete
    longer = Schedule(plan_stages(CONFIGS, 16.0, timed=True), "wall")
    longer.resume(schedule.state(), 1)
    assert [name for name, *_ in steps(longer, time, 1.0, first=1)] == ["b"] * 12
    assert [(stage.start, stage.end) for stage in longer.plan.stages] == [(0.0, 2.5), (2.5, 14.5)]


def test_seconds_and_iterations_do_not_go_on_from_each_other(timed):
    _, make = timed
    by_iterations = Schedule(plan_stages(CONFIGS, 8))
    for one, other in ((make(), by_iterations), (by_iterations, make()), (make("cpu"), make("wall"))):
        with pytest.raises(InputError, match="--max-train-seconds"):
            other.resume(one.state(), 0)


def test_timed_plans_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="num-iterations"):
        plan_stages((StageConfig("a", 1.0, num_iterations=3),), 8.0, timed=True)
    with pytest.raises(InputError, match="add up to 0"):
        plan_stages((StageConfig("a", 0.0),), 8.0, timed=True)
    assert [
        stage.config.name for stage in plan_stages((StageConfig("a", 0.0), CONFIGS[1]), 8.0, timed=True).stages
    ] == ["b"]
