"""The spread of the metrics over held-out views, and what becomes of values that are no measurements."""

import copy
import math
import shutil
import types
from dataclasses import replace

import numpy as np
import pytest
import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from small_trainer import shrink

from hsi_sc_nerf.config import hsi_sc_nerf
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.models.pipeline import SpectralPipeline, digest_of_frames
from hsi_sc_nerf.packed.cube import FLAGGED
from hsi_sc_nerf.packed.dataset import open_packed, write_transforms

pytestmark = pytest.mark.usefixtures("quick_start")


def view(pixels, valid=None):
    shown = torch.zeros(2, 2, 1)
    shown.view(-1)[:pixels] = 1.0
    flags = {} if valid is None else {"valid": torch.full((2, 2, 3), valid)}
    return None, {"mask": shown} | flags


@pytest.fixture
def average(monkeypatch):
    """`get_average_image_metrics` of a pipeline in which nerfstudio's gives the number of views as ``sam``."""

    def mean(self, views, *_):
        seen = list(views)
        return {"sam": float(len(seen)), "sam_std": math.nan if len(seen) == 1 else 0.5, "ssim": math.nan}

    monkeypatch.setattr(VanillaPipeline, "get_average_image_metrics", mean)

    def averaged(views, test_mode="val"):
        pipeline = object.__new__(SpectralPipeline)
        torch.nn.Module.__init__(pipeline)
        pipeline.test_mode = test_mode
        return pipeline.get_average_image_metrics(views, "eval", get_std=True)

    return averaged


@pytest.mark.parametrize(("number", "std"), [(1, 0.0), (2, 0.5)])
def test_spread_of_one_view_is_zero_and_what_has_no_value_is_left_out(average, capsys, number, std):
    assert average([view(1)] * number) == {"sam": number, "sam_std": std}
    assert capsys.readouterr().out == ""


def test_views_that_show_nothing_that_was_measured_are_left_out_of_the_mean(average, capsys):
    found = average([view(0), view(2), view(1, valid=False), view(4, valid=True), view(0, valid=True)])
    assert found == {"sam": 2.0, "sam_std": 0.5}
    assert "2 of 5 held-out views" in " ".join(capsys.readouterr().out.split())


def test_no_view_to_judge_is_one_sentence_and_does_not_end_a_training(average, capsys):
    views = [view(0), view(1, valid=False)]
    assert average(views) == {}
    assert "none of 2 held-out views" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(SystemExit, match=r"^hsi-sc-nerf: none of 2 held-out views [^\n]*\.$"):
        average(views, test_mode="test")


def pipeline_config(data):
    """Of a small model."""
    config = copy.deepcopy(hsi_sc_nerf.config.pipeline)
    config.datamanager.data = data
    config.datamanager.train_num_rays_per_batch = 256
    shrink(config.model)
    return config


@pytest.fixture(scope="module")
def pipeline(flagged_dataset) -> SpectralPipeline:
    return pipeline_config(flagged_dataset).setup(device="cpu")


@pytest.mark.slow
def test_training_does_not_see_flagged_values(pipeline):
    rays, batch = pipeline.datamanager.next_train(0)
    frame, line, sample = batch["indices"].T
    cubes = [frame.cube() for frame in pipeline.datamanager.train_dataset.frames]
    flagged = np.array([cubes[f][y, x] == FLAGGED for f, y, x in zip(frame, line, sample, strict=True)])
    np.testing.assert_array_equal(batch["valid"], ~flagged)
    assert flagged.any(axis=0).sum() > 1

    torch.manual_seed(0)
    outputs = pipeline.model(rays)
    outputs["spectral"].retain_grad()
    found = []
    for anything in (0.0, 7.0, float("nan")):
        batch["spectral"][~batch["valid"]] = anything
        metrics = pipeline.model.get_metrics_dict(outputs, batch)
        losses = pipeline.model.get_loss_dict(outputs, batch, metrics)
        found.append([losses["hsi_loss"].item(), losses["angular_loss"].item(), metrics["psnr"].item()])
    assert found[0] == found[1] == found[2]
    (losses["hsi_loss"] + losses["angular_loss"]).backward()
    assert not outputs["spectral"].grad[~batch["valid"]].any()
    assert outputs["spectral"].grad[batch["valid"]].any()


@pytest.mark.slow
@pytest.mark.parametrize("supersample", [True, False])
def test_training_gives_outline_pixels_four_rays_and_draws_them_half_as_often(flagged_dataset, supersample):
    config = pipeline_config(flagged_dataset)
    config.model.supersample_outline = supersample
    manager = config.setup(device="cpu").datamanager
    manager.foreground_ray_fraction, manager.boundary_ray_fraction = 0.6, 0.5
    rays, batch = manager.next_train(0)
    fractions = (0, 0.6, 0.5)
    _, on_outline = manager.train_pixel_sampler.draw(*fractions)
    assert on_outline > 20
    assert len(batch["indices"]) == 256
    expected = 256 + 3 * round(on_outline / 2) if supersample else 256
    assert len(rays) == pytest.approx(expected, abs=3 * supersample)
    manager.foreground_ray_fraction = None  # whole frames
    assert len(manager.next_train(0)[0]) == 256


@pytest.mark.slow
def test_held_out_views_are_judged_by_their_measurements(pipeline):
    _, batch = next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))
    height, width, _ = batch["spectral"].shape
    generator = torch.Generator().manual_seed(0)
    outputs = {
        "spectral": torch.rand(batch["spectral"].shape, generator=generator),
        "accumulation": torch.ones(height, width, 1),
        "depth": torch.ones(height, width, 1),
    }
    found = []
    for anything in (0.0, 7.0):
        batch["spectral"][~batch["valid"]] = anything
        metrics, images = pipeline.model.get_image_metrics_and_images(outputs, batch)
        assert all(image.isfinite().all() for image in images.values())
        found.append(metrics)
    assert found[0] == found[1]
    del batch["valid"]
    assert pipeline.model.get_image_metrics_and_images(outputs, batch)[0]["rmse"] > 1.5 * found[0]["rmse"]


@pytest.mark.slow
def test_a_view_without_its_object_is_not_judged(flagged_dataset, tmp_path):
    data = shutil.copytree(flagged_dataset, tmp_path / "data")
    config = pipeline_config(data)
    config.datamanager.dataparser.train_split_fraction = 0.7
    held_out = config.setup(device="cpu").datamanager.eval_dataset.frames
    assert len(held_out) == 3
    for frame in held_out[:2]:
        write_png(frame.mask_path, np.zeros_like(frame.mask(), np.uint8))
    pipeline = config.setup(device="cpu")
    _, alone = list(pipeline.datamanager.fixed_indices_eval_dataloader)[2]
    found = pipeline.get_average_eval_image_metrics(get_std=True)
    pipeline.eval()
    camera = pipeline.datamanager.eval_dataset.cameras[2:3]
    expected, _ = pipeline.model.get_image_metrics_and_images(pipeline.model.get_outputs_for_camera(camera), alone)
    assert {name: found[name] for name in expected} == pytest.approx(expected)
    assert found["sam_std"] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "of", "told"),
    [
        (lambda value: 1.01 * value, "field.aabb", "is not the dataset"),
        (lambda value: value[..., :-1], "mlp_head", "is not the dataset"),
        (None, "field.aabb", "other settings of the model"),
        (None, "gains", "another version"),  # of a version whose brightness had another gain, which it did not keep
    ],
)
def test_weights_of_another_dataset_or_model_are_refused(pipeline, change, of, told):
    state = {name: value.clone() for name, value in pipeline.state_dict().items()}
    pipeline.load_pipeline(state, 0)
    for name in [name for name in state if of in name]:
        value = state.pop(name)
        if change is not None:
            state[name] = change(value)
    with pytest.raises(SystemExit, match=told):
        pipeline.load_pipeline(state, 0)


@pytest.mark.slow
def test_a_dataset_from_which_a_frame_was_removed_is_refused(flagged_dataset, tmp_path):
    data = shutil.copytree(flagged_dataset, tmp_path / "data")
    config = pipeline_config(data)
    config.model.effects = "none"  # nothing in the model has the frames' number
    state = config.setup(device="cpu").state_dict()
    dataset = open_packed(data)
    write_transforms(replace(dataset, frames=dataset.frames[1:]))
    changed = config.setup(device="cpu", test_mode="test")
    with pytest.raises(SystemExit, match=r"^hsi-sc-nerf: [^\n]*data has other frames than [^\n]*\.$"):
        changed.load_pipeline(state, 0)
    del state["frames"]  # as earlier versions
    changed.load_pipeline(state, 0)


def test_frames_are_told_by_their_names_their_order_and_those_that_are_held_out():
    def told(frames, trained):
        every, some = ([types.SimpleNamespace(capture=name) for name in names] for names in (frames, trained))
        metadata = {"dataset": types.SimpleNamespace(frames=every), "frames": some}
        outputs = types.SimpleNamespace(metadata=metadata)
        return tuple(digest_of_frames(types.SimpleNamespace(train_dataparser_outputs=outputs)).tolist())

    assert told("abc", "ac") == told("abc", "ac")
    assert (
        len({told(*case) for case in (("abc", "ac"), ("abx", "ax"), ("ac", "ac"), ("bac", "ac"), ("abc", "ab"))}) == 5
    )


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"head": "basis"}, "head direct"),
        ({"head": "direct", "num_proposal_iterations": 0}, "num-proposal-iterations"),
    ],
)
def test_a_basis_and_an_occupancy_grid_have_no_last_sample_behind_the_object(flagged_dataset, changes, told):
    config = pipeline_config(flagged_dataset).model
    with pytest.raises(SystemExit, match=rf"--pipeline\.model\.{told}"):
        replace(config, background="last-sample", **changes)


@pytest.mark.slow
def test_nerfstudios_rgba_pictures_are_opaque(pipeline):
    rgb = torch.rand(3, 4, 3)
    rgba = pipeline.model.get_rgba_image({"rgb": rgb, "accumulation": torch.zeros(3, 4, 1)})
    torch.testing.assert_close(rgba, torch.cat([rgb, torch.ones(3, 4, 1)], -1))


def test_floating_matter_and_caps_are_cleared_now_and_then_in_the_last_stage_of_a_model_with_a_grid(monkeypatch):
    floating, caps, prepared = [], [], []
    module = "hsi_sc_nerf.models.pipeline"
    monkeypatch.setattr(f"{module}.clear_floating_matter", lambda *words: floating.append(words[2]))
    monkeypatch.setattr(f"{module}.clear_cap", lambda *words: caps.append(words[2]))
    model = types.SimpleNamespace(prepare_step=prepared.append, occupancy=object())
    pipeline = types.SimpleNamespace(model=model, datamanager=None)
    for step in (0, 99, 100, 250, 300):
        SpectralPipeline.prepare_step(pipeline, step, part_of_last_stage=step / 400)
        SpectralPipeline.prepare_step(pipeline, step, part_of_last_stage=None)
    model.occupancy = None
    SpectralPipeline.prepare_step(pipeline, 400, part_of_last_stage=1.0)
    assert floating == [100, 300]
    assert caps == [300]
    assert prepared == [0, 0, 99, 99, 100, 100, 250, 250, 300, 300, 400]
