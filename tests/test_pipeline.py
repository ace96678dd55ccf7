"""The spread of the metrics over held-out views."""

import math

import pytest
from nerfstudio.pipelines.base_pipeline import VanillaPipeline

from hsi_sc_nerf.models.pipeline import SpectralPipeline


@pytest.mark.parametrize(("views", "expected"), [([0], 0.0), ([0, 1], math.nan)])
def test_spread_of_one_view_is_zero_and_nothing_else_is_touched(monkeypatch, views, expected):
    found = {"sam": 0.1, "sam_std": math.nan}
    monkeypatch.setattr(VanillaPipeline, "get_average_image_metrics", lambda *_: dict(found))
    metrics = SpectralPipeline.get_average_image_metrics(
        object.__new__(SpectralPipeline), views, "eval", get_std=True
    )
    assert metrics["sam"] == 0.1
    assert metrics["sam_std"] == pytest.approx(expected, nan_ok=True)
