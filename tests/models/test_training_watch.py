"""Steps that are not finite; what TensorBoard is given, read back with its own reader."""

import errno
import threading

import numpy as np
import pytest
import torch
from small_trainer import STEPS, trainer
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.schedule import Schedule
from hsi_sc_nerf.models.stages import Stage, StagePlan, full_frame_stage, masked_stage
from hsi_sc_nerf.models.training_watch import (
    LOSS_STEPS,
    MAX_RISEN_IN_A_ROW,
    MAX_SKIPPED_IN_A_ROW,
    NonFiniteGuard,
    RisenLossGuard,
    TrainingDivergedError,
    files_of_run,
    non_finite_names,
    stage_summary,
)

pytestmark = pytest.mark.usefixtures("quick_start")


def test_names_of_non_finite_terms():
    losses = {"hsi_loss": torch.tensor(1.0), "angular_loss": torch.tensor(float("nan"))}
    assert non_finite_names(losses) == ["angular_loss"]
    assert non_finite_names({}) == []


def test_guard_names_the_step_and_stops_after_the_limit_in_a_row():
    guard = NonFiniteGuard()
    assert guard.record(0, [], []) is None
    assert "step 1 skipped: loss hsi_loss" in guard.record(1, ["hsi_loss"], ["fields"])
    assert "gradient of fields" in guard.record(2, [], ["fields"])
    assert guard.record(3, [], []) is None
    for number in range(1, MAX_SKIPPED_IN_A_ROW):
        guard.record(number, ["hsi_loss"], [])
    with pytest.raises(TrainingDivergedError, match="step 99"):
        guard.record(99, ["hsi_loss"], [])


STAGES = Stage(full_frame_stage(), 0, 1000), Stage(masked_stage(), 1000, 2000)


def risen_steps(losses):
    """How long the loss had risen after each step, until the run is stopped."""
    guard, schedule, found = RisenLossGuard(), Schedule(StagePlan(STAGES)), []
    for step, loss in enumerate(losses):
        schedule.begin_step(step)
        schedule.end_step(step)
        try:
            guard.record(step, schedule, loss)
        except TrainingDivergedError:
            return [*found, "stopped"]
        found.append(guard.risen_in_a_row)
    return found


def test_a_loss_that_stays_far_above_its_least_stops_the_run():
    falls = list(np.geomspace(1.0, 0.01, 50))
    after = LOSS_STEPS // 2  # so many raise the median of a window
    found = risen_steps(falls + [0.5] * 200)
    assert found[-1] == "stopped"
    assert len(found) == 50 + after + MAX_RISEN_IN_A_ROW - 1
    assert max(risen_steps(falls + [0.05] * 200)) == 0
    assert max(risen_steps(falls + ([5.0] * 4 + [0.01] * 12) * 20)) == 0  # single spikes
    back = risen_steps(falls + [0.5] * (MAX_RISEN_IN_A_ROW - LOSS_STEPS) + [0.01] * 200)
    assert MAX_RISEN_IN_A_ROW - LOSS_STEPS <= max(back) < MAX_RISEN_IN_A_ROW
    assert back[-1] == 0


def test_a_run_that_is_lost_from_its_second_step_on_is_compared_with_its_first():
    assert risen_steps([0.1] + [50.0] * 200)[-1] == "stopped"
    assert risen_steps([0.1] + [50.0, float("nan")] * 200)[-1] == "stopped"
    assert max(risen_steps([float("nan")] + [50.0] * 200)) == 0


def test_each_stage_has_a_loss_of_its_own_and_must_not_end_with_a_risen_one():
    assert max(risen_steps([0.01] * 1000 + [0.5] * 500)) == 0
    assert risen_steps([0.01] * 990 + [0.5] * 10)[-1] == "stopped"
    assert len(risen_steps([0.01] * 990 + [0.5] * 10)) == 1000


@pytest.fixture
def events(tiny_dataset, tmp_path, monkeypatch):
    """Everything that a small run logs."""
    # Neither the writers of other runs in this process, nor what a run that was stopped left to be written.
    monkeypatch.setattr("nerfstudio.utils.writer.EVENT_WRITERS", [])
    monkeypatch.setattr("nerfstudio.utils.writer.EVENT_STORAGE", [])
    made = trainer(tiny_dataset, tmp_path, evaluate_stages=True, steps_per_eval_batch=4, steps_per_eval_image=4)
    made.config.logging.steps_per_log = 1
    made.config.full_frame.learn_after = {}
    made.train()
    accumulator = EventAccumulator(str(made.base_dir), size_guidance={"scalars": 0, "images": 0})
    accumulator.Reload()
    return accumulator


@pytest.mark.slow
def test_events_of_a_run(events):
    tags = events.Tags()
    losses = ["hsi_loss", "angular_loss", "free_space_loss", "distortion_loss"]
    metrics = ["sam", "rmse", "psnr", "camera_opt_translation", "camera_opt_rotation_deg", "camera_opt_angle_max_deg"]
    expected = {
        *(f"Train Loss Dict/{name}" for name in [*losses, "camera_opt_regularizer"]),
        *(f"Train Metrics Dict/{name}" for name in metrics),
        *(f"learning_rate/{group}" for group in ("fields", "camera_opt")),
        *(f"Eval Images Metrics/{name}" for name in ("sam", "rmse", "psnr", "full_sam", "full_rmse", "full_psnr")),
        *("Eval Images Metrics Dict (all images)/sam", "Eval Metrics Dict/psnr", "Train Rays / Sec"),
    }
    assert expected <= set(tags["scalars"])
    assert {f"Eval Images/{name}" for name in ("img", "spectral_angle", "error")} <= set(tags["images"])

    rates = [event.value for event in events.Scalars("learning_rate/fields")]
    factors = [1, 0.5**0.5, 0.5, 0.5, 0.1, 0.02]  # both stages, 3 steps each
    assert rates == pytest.approx([1.5e-2 * factor for factor in factors])
    assert [event.step for event in events.Scalars("Train Loss")] == list(range(STEPS))
    ends = [event.step for event in events.Scalars("Eval Images Metrics Dict (all images)/sam")]
    assert ends == [STEPS // 2 - 1, STEPS - 1]


def test_summary_names_both_readings():
    values = {"sam": 0.0292, "rmse": 0.0305, "ssim": 0.888, "psnr": 29.14}
    metrics = values | {f"full_{name}": 2 * value for name, value in values.items()}
    assert stage_summary("masked", metrics) == (
        "masked stage, held-out views: object SAM 0.0292 rad, RMSE 0.0305, SSIM 0.888, PSNR 29.1 dB; "
        "whole frame SAM 0.0584 rad, RMSE 0.0610, SSIM 1.776, PSNR 58.3 dB"
    )


def test_a_file_that_the_system_refuses_is_told_once(tmp_path, monkeypatch):
    """The thread that writes TensorBoard's logs fails of a full disk, and the main thread with the same error."""
    seen = []
    monkeypatch.setattr(threading, "excepthook", lambda raised: seen.append(raised.exc_value))

    def fail_in_thread(error):
        def fail():
            raise error

        thread = threading.Thread(target=fail)
        thread.start()
        thread.join()

    def run_on_a_full_disk():
        full = OSError(errno.ENOSPC, "No space left on device")
        with files_of_run(tmp_path):
            fail_in_thread(full)
            raise full

    with pytest.raises(InputError, match=rf"^{tmp_path}: cannot be .*No space left.*--load-dir\.$"):
        run_on_a_full_disk()
    assert seen == []
    with files_of_run(tmp_path):
        fail_in_thread(fault := ValueError("something else"))
    assert seen == [fault]
