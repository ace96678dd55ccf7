"""Every mode of pose refinement through both stages: what becomes of it, and that its checkpoints load."""

import pytest
import torch
from small_trainer import STEPS, trainer

from hsi_sc_nerf.config import hsi_sc_nerf

pytestmark = pytest.mark.usefixtures("quick_start")


def state(model):
    return {name: value.clone() for name, value in model.camera_optimizer.state_dict().items()}


def held_out_positions(pipeline):
    """Where the rays of a held-out view start, as evaluation renders it."""
    camera, _ = next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))
    rays = camera.generate_rays(camera_indices=0, keep_shape=True)
    measured = rays.origins.clone()
    pipeline.model.camera_optimizer.apply_to_raybundle(rays)
    return rays.origins, measured


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["off", "turntable", "free-discarded"])
def test_a_mode_through_both_stages(tiny_dataset, tmp_path, monkeypatch, mode):
    monkeypatch.setattr(hsi_sc_nerf.config.pipeline.model.camera_optimizer, "mode", mode)
    whole = trainer(tiny_dataset, tmp_path / "whole")
    whole.config.save_config()
    whole.train()
    after_first = torch.load(next((whole.base_dir / "stage-full-frame").glob("*.ckpt")))["pipeline"]
    first = {
        name: value
        for name, value in after_first.items()
        if name.endswith(("camera_twist", "frame_angles", "pose_adjustment"))
    }
    final = state(whole.pipeline.model)
    assert (len(first) > 0) == (mode != "off")
    for name, value in first.items():
        assert value.any()
        kept = torch.zeros_like(value) if mode == "free-discarded" else value
        torch.testing.assert_close(final[name.split(".")[-1]], kept, rtol=0, atol=0)

    # Go on from the first stage's end: the same corrections hold in the second.
    resumed = trainer(tiny_dataset, tmp_path / "resumed", load_dir=whole.base_dir / "stage-full-frame")
    assert resumed._start_step == STEPS // 2
    resumed.train()
    torch.testing.assert_close(state(resumed.pipeline.model), final, rtol=0, atol=0)

    from nerfstudio.utils.eval_utils import eval_setup  # which takes seconds to import

    # What ns-eval does: held-out views are seen from where the frozen corrections put them.
    _, pipeline, checkpoint, _ = eval_setup(whole.base_dir / "config.yml")
    assert checkpoint.parent == whole.checkpoint_dir
    torch.testing.assert_close(state(pipeline.model), final, rtol=0, atol=0)
    positions, measured = held_out_positions(pipeline)
    assert torch.equal(positions, measured) == (mode in ("off", "free-discarded"))
