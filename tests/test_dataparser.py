"""How frames are divided between training and evaluation, and where the scene lies for the model."""

import numpy as np
import pytest

from hsi_sc_nerf.data.dataparser import scene_scaling, split_frames
from hsi_sc_nerf.errors import InputError


@pytest.mark.parametrize("num_frames", [2, 3, 8, 10, 36, 60])
def test_frames_are_trained_on_or_held_out(num_frames):
    train, held_out = split_frames(num_frames, 0.9)
    assert sorted([*train, *held_out]) == list(range(num_frames))
    assert len(held_out) == max(1, num_frames // 10)


def test_held_out_frames_are_spread_evenly():
    gaps = np.diff(split_frames(60, 0.9)[1])
    assert gaps.min() >= 9
    assert gaps.max() <= 11


def test_a_split_without_held_out_frames_is_refused():
    with pytest.raises(InputError, match="leaves 10 of 10 frames to train on and 0 to evaluate"):
        split_frames(10, 1.0)


def test_the_scene_fills_the_models_cube():
    box = np.array([[-0.1, -0.2, 0.0], [0.3, 0.2, 0.1]])
    centre, scale = scene_scaling(box)
    np.testing.assert_allclose((box - centre) * scale, [[-1, -1, -0.25], [1, 1, 0.25]])
