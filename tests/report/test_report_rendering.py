"""What the report asks of a run, of a model that has learned nothing."""

from copy import deepcopy

import numpy as np
import pytest
import torch

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.report.build import ReportSources, write_report
from hsi_sc_nerf.report.held_out_views import PLACES, render_held_out


@pytest.fixture(scope="module")
def run(flagged_dataset):
    from hsi_sc_nerf.config import hsi_sc_nerf

    config = deepcopy(hsi_sc_nerf.config.pipeline)
    config.datamanager.data = config.datamanager.dataparser.data = flagged_dataset
    torch.manual_seed(0)
    pipeline = config.setup(device="cpu", test_mode="test")
    pipeline.eval()
    return TrainedRun(pipeline.model, pipeline.datamanager)


def test_views_are_scored_as_the_model_scores_them(run, flagged_dataset):
    (view,) = render_held_out(run, 1)
    assert len(run.manager.eval_dataset) == 1
    camera, batch = run.manager.fixed_indices_eval_dataloader.get_camera(0)
    with torch.no_grad():
        metrics, images = run.model.get_image_metrics_and_images(run.model.get_outputs_for_camera(camera), batch)
    assert view.scores.metrics == pytest.approx(metrics, rel=1e-5)
    pictured = np.concatenate([view.measured_rgb, view.rendered_rgb], axis=1) / 255.0
    np.testing.assert_allclose(pictured, images["img"].numpy(), atol=0.003)

    frame = next(f for f in open_packed(flagged_dataset).frames if f.capture == view.scores.name)
    measured, valid = unpack(frame.cube())
    assert len(view.places) == PLACES
    place = view.places[0]
    here = frame.mask() & (np.hypot(*(np.indices(frame.mask().shape).T - [place.line, place.sample]).T) <= 1.75)
    here_valid = valid[here].sum(0)
    np.testing.assert_allclose(place.measured, measured[here].sum(0) / here_valid, rtol=1e-5)


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"config\.yml"):
        write_report(tmp_path, tmp_path / "report.html", ReportSources())
