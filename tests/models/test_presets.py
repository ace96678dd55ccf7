"""Presets change what the user has not."""

import copy

import pytest
import yaml

from hsi_sc_nerf import paper
from hsi_sc_nerf.benchmark.configurations import training_config
from hsi_sc_nerf.config import hsi_sc_nerf, hsi_sc_nerf_paper
from hsi_sc_nerf.models.presets import ITERATIONS, PRESETS, RAYS, apply_preset


def of(words):
    config = training_config("hsi-sc-nerf", words)
    return config.max_num_iterations, config.pipeline.datamanager.train_num_rays_per_batch


@pytest.mark.parametrize(("device", "preset"), [("cpu", "fast"), ("cuda", "best")])
def test_a_preset_is_that_of_the_device(device, preset):
    expected = PRESETS[device][preset]
    assert of(("--preset", preset, "--machine.device-type", device)) == (expected[ITERATIONS], expected[RAYS])


def test_an_option_goes_before_the_preset():
    fast = PRESETS["cpu"]["fast"]
    words = ("--preset", "fast", "--machine.device-type", "cpu")
    balanced = PRESETS["cpu"]["balanced"][ITERATIONS]
    for iterations in (123, balanced):
        assert of((*words, "--max-num-iterations", str(iterations))) == (iterations, fast[RAYS])
    assert of((*words, "--pipeline.datamanager.train-num-rays-per-batch", "77")) == (fast[ITERATIONS], 77)


def test_balanced_is_the_default_and_applied_twice_is_applied_once():
    assert hsi_sc_nerf.config.preset == "balanced"
    assert of(()) == of(("--preset", "balanced"))
    config = copy.deepcopy(hsi_sc_nerf.config)
    config.preset = "fast"
    apply_preset(config)
    once = config.max_num_iterations
    apply_preset(config)
    assert config.max_num_iterations == once


def test_a_preset_is_written_as_plain_numbers():
    words = ("--preset", "fast", "--machine.device-type", "cpu")
    written = yaml.dump({"iterations": training_config("hsi-sc-nerf", words).max_num_iterations})
    assert yaml.safe_load(written) == {"iterations": 800}


def test_better_presets_take_longer():
    for presets in PRESETS.values():
        assert presets["fast"][ITERATIONS] < presets["balanced"][ITERATIONS] < presets["best"][ITERATIONS]


def test_the_published_method_takes_no_preset():
    config = copy.deepcopy(hsi_sc_nerf_paper.config)
    config.preset = "fast"
    with pytest.raises(SystemExit, match="has its own length"):
        apply_preset(config)


def test_the_published_method_has_its_own_length():
    assert hsi_sc_nerf_paper.config.preset is None
    assert training_config("hsi-sc-nerf-paper", ()).max_num_iterations == sum(paper.STAGE_ITERATIONS)
