import numpy as np
import pytest

from hsi_sc_nerf.data.pixels import PixelSampler, gather_spectra


@pytest.fixture
def frames():
    rng = np.random.default_rng(0)
    cubes = [rng.integers(0, 65536, (5, 7, 4)).astype(np.uint16) for _ in range(3)]
    masks = np.zeros((3, 5, 7), bool)
    masks[:, 2:4, 1:3] = True
    return cubes, masks


def test_gather_equals_indexing_one_by_one(frames):
    cubes, _ = frames
    indices = np.array([[2, 4, 6], [0, 0, 0], [2, 1, 3], [1, 2, 2], [0, 4, 0]])
    expected = [cubes[f][line, sample] / 65535 for f, line, sample in indices]
    np.testing.assert_allclose(gather_spectra(cubes, indices, 65535.0), expected, rtol=1e-6)


def test_a_step_always_gives_the_same_batch_and_another_step_another(frames):
    sampler = PixelSampler(*frames, 65535.0, num_rays_per_batch=64, seed=3)
    first, again, other = sampler.sample(7), sampler.sample(7), sampler.sample(8)
    for key in first:
        np.testing.assert_array_equal(first[key], again[key])
    assert (first["indices"] != other["indices"]).any()


def test_foreground_share_is_kept(frames):
    sampler = PixelSampler(*frames, 65535.0, num_rays_per_batch=200, seed=0)
    batch = sampler.sample(0, foreground_share=0.75)
    frame, line, sample = batch["indices"].T
    np.testing.assert_array_equal(batch["mask"][:, 0], frames[1][frame, line, sample])
    assert batch["mask"].sum() == 150


def test_whole_frames_are_drawn_evenly(frames):
    sampler = PixelSampler(*frames, 65535.0, num_rays_per_batch=20_000, seed=0)
    batch = sampler.sample(0)
    counts = np.zeros((3, 5, 7))
    np.add.at(counts, tuple(batch["indices"].T), 1)
    expected = 20_000 / counts.size
    assert abs(counts - expected).max() < 6 * np.sqrt(expected)


def test_nothing_but_the_sampled_frames_is_touched(frames):
    cubes, _ = frames

    class Untouchable:
        shape = cubes[1].shape

        def __getitem__(self, key):
            raise AssertionError("read a frame that was not sampled")

    gather_spectra([cubes[0], Untouchable(), cubes[2]], np.array([[0, 1, 1], [2, 2, 2]]), 1.0)
