"""Held-out views: scores, points and rendering; training curves and settings of a run."""

import weakref
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from small_trainer import untrained_pipeline

from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.report.held_out_views import (
    POINTS,
    inner_points,
    object_angles,
    point_spectra,
    render_held_out,
    sample_mean_and_sd,
    score_view,
)
from hsi_sc_nerf.report.run_sections import (
    flat_settings,
    read_scalars,
    settings_section,
    shortened,
    stage_ends,
    training_section,
)


def test_a_view_that_is_off_by_a_constant(device):
    measured = torch.rand(6, 5, 4, generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(6, 5, dtype=torch.bool)
    mask[1:4, 2:] = True
    rendered = measured.clone()
    rendered[mask] += 0.1
    valid = torch.ones_like(measured, dtype=torch.bool)
    valid[..., 2] = False
    view = score_view("a", *(t.to(device) for t in (rendered, measured, mask, valid)))
    np.testing.assert_allclose(view.rmse, [0.1, 0.1, np.nan, 0.1], atol=1e-6)
    np.testing.assert_allclose(view.psnr_db, [20.0, 20.0, np.nan, 20.0], atol=1e-3)
    assert np.isnan(view.ssim).tolist() == [False, False, True, False]
    assert view.metrics["rmse"] == pytest.approx(0.1, abs=1e-6)
    assert view.metrics["full_rmse"] == pytest.approx(0.1 * np.sqrt(9 / 30), abs=1e-6)
    np.testing.assert_allclose(view.error, np.where(mask, 0.1, 0.0), atol=1e-6)
    assert len(object_angles([view, view])) == 18
    assert object_angles([view]).mean() == pytest.approx(view.metrics["sam"], abs=1e-6)


def test_a_view_says_how_far_its_noise_turns_spectra(device):
    generator = torch.Generator().manual_seed(0)
    rendered = 0.2 + 0.6 * torch.rand(30, 30, 50, generator=generator)
    noise_std = torch.linspace(0.002, 0.02, 50)
    measured = rendered + noise_std * torch.randn(rendered.shape, generator=generator)
    mask, valid = torch.ones(30, 30, dtype=torch.bool), torch.ones_like(rendered, dtype=torch.bool)
    view = score_view("a", *(t.to(device) for t in (rendered, measured, mask, valid, noise_std)))
    assert view.noise_angle_rad == pytest.approx(view.metrics["sam"], rel=0.02)
    assert np.isnan(score_view("a", rendered, measured, mask, valid).noise_angle_rad)
    empty = torch.zeros_like(mask)
    assert np.isnan(score_view("a", rendered, measured, empty, valid, noise_std).noise_angle_rad)


def test_mean_and_deviation_over_the_views_that_have_a_band():
    mean, sd = sample_mean_and_sd(np.array([[1.0, np.nan, 5.0], [3.0, np.nan, np.nan]]))
    np.testing.assert_allclose(mean, [2.0, np.nan, 5.0])
    np.testing.assert_allclose(sd, [np.sqrt(2.0), np.nan, 0.0])


def test_spectra_around_a_point_are_those_of_its_valid_pixels():
    rng = np.random.default_rng(0)
    measured = 0.5 + 0.02 * rng.normal(size=(40, 40, 3))
    rendered = np.full((40, 40, 3), 0.4)
    mask = np.zeros((40, 40), bool)
    mask[:, :20] = True
    measured[~mask] = 9.0
    measured[..., 1] = np.nan
    measured[18, :, 2] = np.nan
    (point,) = point_spectra(measured, rendered, mask, [(20, 18)], 6.0)
    lines, samples = np.indices(mask.shape)
    inside = ((lines - 20) ** 2 + (samples - 18) ** 2 <= 36) & mask
    assert point.pixels == inside.sum()
    np.testing.assert_allclose(point.measured[0], measured[inside, 0].mean())
    np.testing.assert_allclose(point.measured_sd[0], measured[inside, 0].std(ddof=1))
    np.testing.assert_allclose(point.measured[2], measured[inside & (lines != 18), 2].mean())
    np.testing.assert_allclose(point.rendered, [0.4, np.nan, 0.4])
    assert np.isnan(point.measured_sd).tolist() == [False, True, False]


def test_points_lie_well_inside_the_object():
    mask = np.zeros((60, 60), bool)
    mask[10:50, 20:45] = True
    points = inner_points(mask, 4, 5)
    assert len(set(points)) == 4
    assert all(14 <= line < 46 and 24 <= sample < 41 for line, sample in points)
    assert len(inner_points(np.pad(np.ones((1, 3), bool), 4), 2, 5)) == 2
    assert inner_points(np.zeros((5, 5), bool), 3, 2) == []


def test_curves_of_a_resumed_run_have_one_value_a_step(tmp_path):
    from torch.utils.tensorboard import SummaryWriter

    assert read_scalars(tmp_path) == {}
    for part, steps in enumerate((range(5), range(3, 8))):
        with SummaryWriter(str(tmp_path), filename_suffix=str(part)) as writer:
            for step in steps:
                writer.add_scalar("Train Loss", 1.0 / (step + 1), step)
    steps, values = read_scalars(tmp_path)["Train Loss"]
    np.testing.assert_array_equal(steps, np.arange(8))
    np.testing.assert_allclose(values, 1.0 / (steps + 1), rtol=1e-6)


def test_steps_that_were_not_finite_leave_the_others_in_the_charts_and_the_finding():
    steps, values = np.arange(40.0), np.full(40, 30.0)
    values[38] = np.inf
    tags = ("Train Loss", "Train Loss Dict/hsi_loss", "Train Metrics Dict/psnr")
    section = training_section({tag: (steps, values if "hsi" not in tag else np.ones(40)) for tag in tags}, {})
    assert [*section.blocks[0].pictures] == ["Loss of training batches", "Peak signal-to-noise ratio"]
    assert [finding.level for finding in section.findings] == ["green"]


def test_long_curves_are_shortened_to_means():
    steps = np.arange(1000.0)
    short_steps, short_values = shortened(steps, 3.0 * steps, 100)
    np.testing.assert_allclose(short_steps, np.arange(100) * 10 + 4.5)
    np.testing.assert_allclose(short_values, 3.0 * short_steps)
    assert shortened(steps, steps, 2000)[0] is steps


def test_stages_in_the_order_of_their_ends(tmp_path):
    for name, step in (("masked", 99), ("full-frame", 49)):
        (tmp_path / f"stage-{name}").mkdir()
        (tmp_path / f"stage-{name}" / f"step-{step:09d}.ckpt").touch()
    assert stage_ends(tmp_path) == {"full-frame": 50, "masked": 100}


@dataclass
class Inner:
    _target: type = dict
    rate: float = 0.1


@dataclass
class Outer:
    inner: Inner = field(default_factory=Inner)
    groups: dict = field(default_factory=lambda: {"fields": Inner()})
    empty: dict = field(default_factory=dict)


def test_settings_by_their_dotted_names_and_those_that_were_changed():
    settings = flat_settings(Outer(inner=Inner(rate=0.2)))
    assert settings == {"inner.rate": "0.2", "groups.fields.rate": "0.1", "empty": "{}"}
    first, *_ = settings_section(settings | {"new": "1"}, flat_settings(Outer()), {}).blocks
    assert first.rows == [("inner.rate", "0.2", "0.1"), ("new", "1", "-")]


@pytest.fixture(scope="module")
def run(flagged_dataset):
    pipeline = untrained_pipeline(flagged_dataset)
    pipeline.eval()
    return TrainedRun(pipeline.model, pipeline.datamanager)


def test_the_cubes_of_a_view_are_freed_before_the_next_is_rendered():
    cubes = []

    def cube():
        made = torch.rand(16, 16, 4)
        cubes.append(weakref.ref(made))
        return made

    def batch(index):
        assert not any(one() is not None for one in cubes)
        return None, {"spectral": cube(), "mask": torch.ones(16, 16, 1)}

    model = SimpleNamespace(rgb_bands=[2, 1, 0], get_outputs_for_camera=lambda camera: {"spectral": cube()})
    frames = [SimpleNamespace(capture=f"ball_{number}") for number in range(3)]
    manager = SimpleNamespace(
        eval_dataset=SimpleNamespace(frames=frames), fixed_indices_eval_dataloader=SimpleNamespace(get_camera=batch)
    )
    run = SimpleNamespace(model=model, manager=manager, dataset=SimpleNamespace(typical_uncertainty=None))
    assert len(list(render_held_out(run, 3))) == 3
    assert len(cubes) == 6


@pytest.mark.slow
def test_views_are_scored_as_the_model_scores_them(run, flagged_dataset):
    (view,) = render_held_out(run, 1)
    assert len(run.manager.eval_dataset) == 1
    camera, batch = run.manager.fixed_indices_eval_dataloader.get_camera(0)
    with torch.no_grad():
        metrics, images = run.model.get_image_metrics_and_images(run.model.get_outputs_for_camera(camera), batch)
    assert view.scores.metrics == pytest.approx(metrics, rel=1e-5)
    pictured = np.concatenate([view.measured_rgb, view.rendered_rgb], axis=1).clip(0.0, 1.0)
    np.testing.assert_allclose(pictured, images["img"].numpy(), atol=0.003)

    frame = next(f for f in open_packed(flagged_dataset).frames if f.capture == view.scores.name)
    measured, valid = unpack(frame.cube())
    assert len(view.points) == POINTS
    point = view.points[0]
    here = frame.mask() & (np.hypot(*(np.indices(frame.mask().shape).T - [point.line, point.sample]).T) <= 1.75)
    here_valid = valid[here].sum(0)
    np.testing.assert_allclose(point.measured, measured[here].sum(0) / here_valid, rtol=1e-5)
