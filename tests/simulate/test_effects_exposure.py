"""The simulator's own integration time of the white tarp, and its dead bands."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from hsi_sc_nerf import paper
from hsi_sc_nerf.simulate.effects import read_effects
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import load_scene, override

DARK = 120


def simulation(**effects):
    scene = override(load_scene("sphere"), size_px=24, bands=20, frames=2)
    return Simulation(dataclasses.replace(scene, effects=read_effects([{k: v} for k, v in effects.items()], "test")))


def test_tarp_of_its_own_integration_time():
    usual, changed = simulation(), simulation(tarp_exposure={"exposure_factor": 0.4})
    assert usual.white().integration_time_ms == usual.frame(0).integration_time_ms == paper.INTEGRATION_TIME_MS
    white, frame = changed.white(), changed.frame(1)
    assert white.integration_time_ms == pytest.approx(0.4 * paper.INTEGRATION_TIME_MS)
    assert frame.integration_time_ms == paper.INTEGRATION_TIME_MS
    np.testing.assert_array_equal(frame.counts, usual.frame(1).counts)
    signal, expected = white.counts - float(DARK), 0.4 * (usual.white().counts - float(DARK))
    # Each rounded on its own.
    assert np.abs(signal - expected).max() <= 0.5 + 0.4 * 0.5 + 1e-3
    np.testing.assert_array_equal(white.dark, usual.white().dark)


@pytest.mark.slow
def test_both_exposures_multiply():
    both = simulation(saturation={"exposure_factor": 2.0}, tarp_exposure={"exposure_factor": 0.5})
    np.testing.assert_array_equal(both.white().counts, simulation().white().counts)
    longer = simulation(saturation={"exposure_factor": 2.0})
    np.testing.assert_array_equal(both.frame(0).counts, longer.frame(0).counts)
    assert both.white().integration_time_ms == paper.INTEGRATION_TIME_MS
    assert both.frame(0).integration_time_ms == longer.white().integration_time_ms == 2.0 * paper.INTEGRATION_TIME_MS


def test_dead_bands_come_on_top_of_the_other_bad_pixels():
    strengths = {"dead_fraction": 0.05, "hot_fraction": 0.05}
    without = simulation(bad_pixels=strengths).detector_maps["bad_pixels"]
    changed = simulation(bad_pixels={**strengths, "dead_bands": 3})
    maps = changed.detector_maps["bad_pixels"]
    dead_bands = maps["dead"].all(axis=0)
    assert dead_bands.sum() == 3
    assert not maps["hot"][:, dead_bands].any()
    for name in ("dead", "hot"):
        np.testing.assert_array_equal(maps[name][:, ~dead_bands], without[name][:, ~dead_bands])
    for capture in (changed.white(), changed.frame(0)):
        assert (capture.counts[..., dead_bands] == DARK).all()
        assert (capture.dark[..., dead_bands] == DARK).all()
