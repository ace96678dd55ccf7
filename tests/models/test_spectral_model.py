import json
import shutil

import pytest
import torch
from small_trainer import untrained_pipeline

from hsi_sc_nerf.models.compositing import BasisDecoder

pytestmark = pytest.mark.usefixtures("quick_start")


def test_decoding_commutes_with_compositing(device):
    generator = torch.Generator().manual_seed(0)
    decoder = BasisDecoder(
        torch.randn(204, 8, generator=generator),
    ).to(device)
    coefficients = torch.randn(16, 24, 8, generator=generator).to(device)
    weights = torch.rand(16, 24, 1, generator=generator).softmax(1).to(device)
    once = decoder((weights * coefficients).sum(-2))
    torch.testing.assert_close(once, (weights * decoder(coefficients)).sum(-2), rtol=1e-5, atol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_free_space_counts_only_above_a_support_of_known_height(known, tiny_dataset, tmp_path):
    data = tmp_path / "data"
    shutil.copytree(tiny_dataset[0], data)
    content = json.loads((data / "transforms.json").read_text())
    content["container"] = content["container"] if known else None
    (data / "transforms.json").write_text(json.dumps(content))
    pipeline = untrained_pipeline(data).train()
    model, manager = pipeline.model, pipeline.datamanager
    parsed = manager.train_dataparser_outputs
    model.prepare_step(0)  # begins with a solid hull, which is wider than the masks
    manager.test_mode, manager.foreground_ray_fraction, manager.boundary_ray_fraction = "val", 0.5, 0.8
    rays, batch = manager.next_train(0)
    outputs = model(rays)
    losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
    assert ("free_space_loss" in losses) == known
    if known:
        assert losses["free_space_loss"] > 0.0
        lid = parsed.metadata["object_box"][0, 2].item()
        assert model.support_height == pytest.approx(lid + 0.002 * parsed.dataparser_scale)
