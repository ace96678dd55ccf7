"""Our renderer against Mitsuba 3; skipped where that is not installed."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("mitsuba", reason="Mitsuba is not installed")

import mitsuba_agreement
import mitsuba_rendering

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate.materials import Plain
from hsi_sc_nerf.simulate.scene import load_scene, override

RAYS = 72  # a multiple of the bands
REPEATS = 4


def small(name, size_px=24):
    scene = override(load_scene(name), size_px=size_px, bands=6, effects=())
    return dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, supersampling=16))


def agreement(scene, transport, effects=(), frame=2):
    ours = mitsuba_agreement.render_ours(override(scene, effects=effects), frame)
    return mitsuba_agreement.compare(scene, frame, transport, ours, RAYS, REPEATS)


@pytest.mark.slow
def test_matte_scene_in_even_light_agrees_within_monte_carlo_error():
    found = agreement(small("pear"), "even")
    # The pear's skin, blush and pale dots meet in single triangles: fractions of three materials are right as well.
    assert found.rms < 1.15 * found.expected
    assert found.expected < 0.015
    for bias, error in (found.bias, *found.bias_of_material.values()):
        assert abs(bias) < 4.0 * error + 2e-4


@pytest.mark.slow
def test_shading_and_one_bounce_agree():
    found = agreement(small("sphere"), "one_bounce", ["chamber_shading", "inter_reflection"])
    # Light at points a few mm apart is less sharp than Mitsuba's at the foot of things.
    assert found.rms < 1.5 * found.expected
    for bias, error in (found.bias, found.bias_of_material["matte_white"]):
        assert abs(bias) < 4.0 * error + 2e-3


@pytest.mark.slow
def test_unseen_chamber_has_its_own_spectrum_in_even_light_and_is_the_lamp_otherwise():
    scene = small("sphere", size_px=8)
    level = mitsuba_agreement.render_ours(scene, 0).radiance[0, 0]
    for transport, expected in (("even", level), ("chamber", np.ones(6))):
        corner = mitsuba_rendering.render(scene, 0, transport, rays_per_pixel=RAYS)[:1, :1]
        np.testing.assert_allclose(corner.mean(axis=(0, 1)), expected, atol=1e-3)


@pytest.mark.slow
def test_white_furnace():
    """What absorbs nothing cannot be seen in an even white chamber, once all bounces are followed."""
    white = dict.fromkeys(("disc", "container_plastic", "paper", "marker_ink"), Plain(1.0))
    scene = dataclasses.replace(small("sphere"), materials=white)
    levels = [
        mitsuba_rendering.render(scene, 0, transport, rays_per_pixel=RAYS).mean()
        for transport in ("chamber", "one_bounce", "many_bounces")
    ]
    assert levels[0] < levels[1] - 0.02 < levels[2] - 0.03
    assert levels[2] == pytest.approx(1.0, abs=2e-3)


def test_an_effect_that_mitsuba_does_not_render_is_refused():
    scene = override(small("sphere"), effects=["photon_noise"])
    with pytest.raises(InputError, match="photon_noise cannot be rendered with Mitsuba"):
        mitsuba_rendering.render(scene, 0, "even", rays_per_pixel=RAYS)
