"""Masks of a whole session under the chamber's uneven light, where the fruit's underside lies in its own shade."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.processing.masks import MaskConfig
from hsi_sc_nerf.processing.process import ProcessConfig, process_session
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth


@pytest.fixture(scope="module")
def shaded_session(tmp_path_factory) -> Path:
    effects = ("photon_noise", "read_noise", "chamber_shading")
    scene = override(load_scene("apple"), frames=8, size_px=128, bands=24, effects=effects)
    return simulate_session(scene, tmp_path_factory.mktemp("shaded") / "session", progress=False)


def mean_overlap(session: Path, data: Path, config: MaskConfig) -> float:
    """Mean over frames of the masks' intersection over union with what the object covers."""
    truth = load_truth(session)
    dataset = open_packed(process_session(session, data, ProcessConfig(masks=config), progress=False))
    overlaps = []
    for frame in dataset.frames:
        mask, covered = frame.mask(), truth.object_coverage(frame.capture) > 0.5
        overlaps.append((mask & covered).sum() / (mask | covered).sum())
    return float(np.mean(overlaps))


def test_the_shaded_underside_is_the_objects(shaded_session, tmp_path):
    found = mean_overlap(shaded_session, tmp_path / "found", MaskConfig())
    assert found > 0.985
    assert mean_overlap(shaded_session, tmp_path / "plain", MaskConfig(shaded_share=None)) < found - 0.015
