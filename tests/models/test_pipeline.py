"""The spread of the metrics over held-out views, and what becomes of values that are no measurements."""

import copy
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from small_trainer import shrink

from hsi_sc_nerf.config import hsi_sc_nerf
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.models.pipeline import SpectralPipeline
from hsi_sc_nerf.packed.cube import FLAGGED


@pytest.mark.parametrize(("views", "expected"), [([0], 0.0), ([0, 1], math.nan)])
def test_spread_of_one_view_is_zero_and_nothing_else_is_touched(monkeypatch, views, expected):
    found = {"sam": 0.1, "sam_std": math.nan}
    monkeypatch.setattr(VanillaPipeline, "get_average_image_metrics", lambda *_: dict(found))
    metrics = SpectralPipeline.get_average_image_metrics(
        object.__new__(SpectralPipeline), views, "eval", get_std=True
    )
    assert metrics["sam"] == 0.1
    assert metrics["sam_std"] == pytest.approx(expected, nan_ok=True)


def pipeline_config(data):
    """Of a small model."""
    config = copy.deepcopy(hsi_sc_nerf.config.pipeline)
    config.datamanager.data = data
    config.datamanager.train_num_rays_per_batch = 256
    shrink(config.model)
    return config


@pytest.fixture
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
    """It would score as perfect."""
    data = shutil.copytree(flagged_dataset, tmp_path / "data")
    config = pipeline_config(data)
    config.datamanager.dataparser.train_split_fraction = 0.7
    held_out = config.setup(device="cpu").datamanager.eval_dataset.frames
    assert len(held_out) == 3
    write_png(held_out[1].mask_path, np.zeros_like(held_out[1].mask(), np.uint8))
    loader = config.setup(device="cpu").datamanager.fixed_indices_eval_dataloader
    assert [batch["image_idx"] for _, batch in loader] == [0, 2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "told"),
    [("field.aabb", "is not the dataset"), ("mlp_head", "is not the dataset"), (None, "other settings of the model")],
)
def test_weights_of_another_dataset_or_model_are_refused(pipeline, changed, told):
    state = {name: value.clone() for name, value in pipeline.state_dict().items()}
    pipeline.load_pipeline(state, 0)
    if changed is None:
        del state["_model.field.aabb"]
    for name in [name for name in state if changed is not None and changed in name]:
        state[name] = state[name] * 1.01 if "aabb" in name else state[name][..., :-1]
    with pytest.raises(SystemExit, match=told):
        pipeline.load_pipeline(state, 0)


def test_a_basis_has_no_spectrum_at_the_last_sample(flagged_dataset):
    config = pipeline_config(flagged_dataset).model
    with pytest.raises(SystemExit, match=r"--pipeline\.model\.head direct"):
        replace(config, head="basis", background="last-sample")


@pytest.mark.slow
def test_nerfstudios_rgba_pictures_are_opaque(pipeline):
    rgb = torch.rand(3, 4, 3)
    rgba = pipeline.model.get_rgba_image({"rgb": rgb, "accumulation": torch.zeros(3, 4, 1)})
    torch.testing.assert_close(rgba, torch.cat([rgb, torch.ones(3, 4, 1)], -1))
