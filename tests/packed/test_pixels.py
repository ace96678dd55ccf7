import gc
import os
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt

from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.morphology import beside
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, unpack, write_packed_cube
from hsi_sc_nerf.packed.pixels import BOUNDARY_PX, PixelReader, PixelSampler, spread_over

SHAPE = (5, 7, 4)
INDICES = np.array([[2, 4, 6], [0, 0, 0], [2, 1, 3], [1, 2, 2], [0, 4, 0]])


@pytest.fixture
def counts() -> np.ndarray:
    return np.random.default_rng(0).integers(0, FLAGGED, (3, *SHAPE)).astype(np.uint16)


@pytest.fixture
def masks() -> np.ndarray:
    masks = np.zeros((3, *SHAPE[:2]), bool)
    masks[:, 2:4, 1:3] = True
    masks[1, 0, 0] = masks[2, 4, 6] = True
    return masks


def reader_of(folder: Path, counts: np.ndarray) -> PixelReader:
    for i, cube in enumerate(counts):
        write_packed_cube(folder / f"{i}.hdr", cube, np.arange(400.0, 404.0))
    return PixelReader([open_cube(folder / f"{i}.hdr").memmap() for i in range(len(counts))])


@pytest.fixture
def sampler(tmp_path, counts, masks):
    def make(num_rays: int, seed: int = 0, has_flagged: bool = False) -> PixelSampler:
        return PixelSampler(reader_of(tmp_path, counts), masks, num_rays, seed, has_flagged=has_flagged)

    return make


def test_pixels_lie_behind_a_headers_offset(tmp_path, counts):
    (tmp_path / "offset.bip").write_bytes(b"header" + counts[0].tobytes())
    cube = np.memmap(tmp_path / "offset.bip", np.uint16, "r", offset=6, shape=SHAPE)
    read = PixelReader([cube]).read(INDICES * [0, 1, 1])
    np.testing.assert_array_equal(read, [counts[0, line, sample] for _, line, sample in INDICES])


def test_a_cube_that_becomes_shorter_is_one_sentence(tmp_path, counts):
    reader = reader_of(tmp_path, counts)
    (tmp_path / "2.bip").write_bytes(b"")
    with pytest.raises(InputError, match="a cube became shorter"):
        reader.read(INDICES)
    np.testing.assert_array_equal(reader.read(np.array([[0, 1, 1]])), [counts[0, 1, 1]])


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="counts the process's files in /proc")
def test_a_reader_holds_one_file_a_frame_until_it_is_closed(tmp_path):
    reader_of(tmp_path, np.zeros((20, *SHAPE), np.uint16)).close()
    gc.collect()  # what earlier tests left
    before, maps = open_files(), []

    def cubes():
        for i in range(20):
            cube = open_cube(tmp_path / f"{i}.hdr").memmap()
            maps.append(weakref.ref(cube))
            assert sum(earlier() is not None for earlier in maps) <= 2
            yield cube

    reader = PixelReader(cubes())
    assert open_files() == before + 20
    reader.close()
    assert open_files() == before


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the process's memory from /proc")
def test_memory_does_not_grow_with_the_pixels_that_were_read(tmp_path):
    shape = (512, 512, 204)

    def resident_mib() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20

    cubes = []
    for i in range(3):
        with (tmp_path / f"{i}.bip").open("wb") as file:  # sparse: holes read as zeros
            file.truncate(2 * 512 * 512 * 204)
        cubes.append(np.memmap(tmp_path / f"{i}.bip", np.uint16, "r", shape=shape))
    reader = PixelReader(cubes)
    rng = np.random.default_rng(0)
    reader.read(rng.integers(0, (3, 512, 512), (4096, 3)))
    before = resident_mib()
    for _ in range(10):
        reader.read(rng.integers(0, (3, 512, 512), (4096, 3)))
    # The pages of these pixels hold 200 MiB and more.
    assert resident_mib() < before + 50


def test_batches_tell_which_values_are_measurements_only_where_some_are_not(sampler, counts):
    assert "valid" not in sampler(64).sample(0)
    counts[:, ::2, :, 1] = FLAGGED
    batch = sampler(64, has_flagged=True).sample(0)
    frame, line, sample = batch["indices"].T
    np.testing.assert_array_equal(batch["valid"], counts[frame, line, sample] != FLAGGED)
    assert not batch["valid"].all()
    assert not batch["spectral"][~batch["valid"]].any()
    np.testing.assert_array_equal(batch["spectral"], unpack(counts[frame, line, sample])[0])


def test_a_step_always_gives_the_same_batch_and_another_step_another(sampler):
    pixels = sampler(64, seed=3)
    first, again, other = pixels.sample(7), pixels.sample(7), pixels.sample(8)
    for key in first:
        np.testing.assert_array_equal(first[key], again[key])
    assert (first["indices"] != other["indices"]).any()


def test_a_fraction_of_the_background_lies_on_the_boundary(tmp_path):
    masks = np.zeros((2, 20, 30), bool)
    masks[0, 8:12, 10:15] = masks[1, 0, 0] = True
    counts = np.zeros((*masks.shape, 4), np.uint16)
    pixels = PixelSampler(reader_of(tmp_path, counts), masks, 4000, 0, has_flagged=False)
    from_object = np.stack([distance_transform_edt(~mask) for mask in masks])
    frame, line, sample = pixels.sample(0, foreground_ray_fraction=0.5, boundary_ray_fraction=0.75)["indices"].T
    distances = from_object[frame, line, sample]
    assert (distances == 0).sum() == 2000
    near, rest = (distances > 0) & (distances < BOUNDARY_PX + 1.0), distances >= BOUNDARY_PX + 1.0
    assert 1500 <= near.sum() < 1700
    assert near.sum() + rest.sum() == 2000
    assert distances.max() > 10.0
    # Every pixel within the boundary's width.
    drawn = np.unique(np.stack([frame, line, sample])[:, near], axis=1).shape[1]
    assert drawn >= ((from_object > 0) & (from_object <= BOUNDARY_PX)).sum()


@pytest.mark.parametrize("fraction", [None, 0.0, 0.5, 1.0])
def test_pixels_are_drawn_evenly(sampler, masks, fraction):
    drawn = 20_000
    batch = sampler(drawn).sample(0, fraction)
    counts = np.zeros(masks.shape)
    np.add.at(counts, tuple(batch["indices"].T), 1)
    if fraction is None:
        expected = np.full(masks.shape, drawn / masks.size)
    else:
        expected = drawn * np.where(masks, fraction / masks.sum(), (1.0 - fraction) / (~masks).sum())
    assert (abs(counts - expected) <= 6 * np.sqrt(expected)).all()


@pytest.mark.parametrize(
    ("fraction", "covered", "sentence"),
    [
        (0.75, False, "are empty"),
        (1.0, False, "are empty"),
        (0.75, True, "cover whole im"),
        (0.0, True, "cover whole"),
    ],
)
def test_without_an_object_or_anything_else_there_is_nothing_to_train_on(
    tmp_path, counts, masks, fraction, covered, sentence
):
    pixels = PixelSampler(reader_of(tmp_path, counts), np.full_like(masks, covered), 8, 0, has_flagged=False)
    with pytest.raises(InputError, match=f"masks of all training frames {sentence}"):
        pixels.sample(0, fraction, boundary_ray_fraction=0.5)
    assert (pixels.sample(0, float(covered))["mask"] == covered).all()


def test_a_restricted_background_is_drawn_from_alone(sampler, masks):
    pixels = np.zeros(masks.shape, bool)
    pixels[:, 1:3] = True
    pixel_sampler = sampler(64)
    pixel_sampler.restrict_background(pixels)
    drawn = np.concatenate([pixel_sampler.draw(step, 0.25)[0] for step in range(20)])
    background = drawn[~masks[tuple(drawn.T)]]
    drawn_from = pixels & ~masks & ~np.stack([beside(mask, 1) for mask in masks])
    assert drawn_from[tuple(background.T)].all()
    assert len(np.unique(background, axis=0)) == drawn_from.sum()


@pytest.mark.parametrize("density", [1.0, 0.5])
def test_the_last_pixels_are_those_on_the_outline_as_many_in_every_step(tmp_path, density):
    masks = np.zeros((2, 20, 30), bool)
    masks[0, 5:15, 10:22] = masks[1, 2:9, 3:9] = True
    counts = np.zeros((*masks.shape, 4), np.uint16)
    pixels = PixelSampler(reader_of(tmp_path, counts), masks, 4000, 0, has_flagged=False)
    pixels.restrict_background(np.ones_like(masks))
    inside = np.stack([binary_erosion(mask) for mask in masks])
    outside = np.stack([binary_dilation(mask) for mask in masks])
    batches = [pixels.draw(step, 0.6, 0.5, density) for step in range(3)]
    assert len({on_outline for _, on_outline in batches}) == 1
    for drawn, on_outline in batches:
        outline = drawn[-on_outline:]
        assert ((outside & ~inside)[tuple(outline.T)]).all()
        assert not ((outside & ~inside)[tuple(drawn[:-on_outline].T)]).any()
        of_object = masks[tuple(drawn.T)]
        assert of_object.sum() == 2400
        rim = masks[tuple(outline.T)].sum()
        assert rim == pytest.approx(2400 * density * (masks & ~inside).sum() / masks.sum(), abs=1)
    everywhere = np.concatenate([pixels.draw(step, 0.6, 0.5, density)[0] for step in range(20)])
    seen = np.zeros_like(masks)
    seen[tuple(everywhere.T)] = True
    assert (seen | ~(outside & ~inside)).all()
    assert pixels.draw(0)[1] == 0


def test_fixed_pixels_are_spread_over_the_object(masks):
    flat = [np.ravel_multi_index(tuple(pixel), masks.shape) for pixel in spread_over(masks, 3)]
    foreground = np.flatnonzero(masks)  # 14 pixels
    assert flat == foreground[[2, 7, 11]].tolist()
    assert len(spread_over(masks, 99)) == len(foreground)
    assert spread_over(np.zeros_like(masks), 3).shape == (0, 3)


def test_a_pixel_beside_the_object_is_not_free_of_it(tmp_path, counts, masks):
    """A single foreground pixel: its four neighbours may hold a part of the object, its diagonal ones do not."""
    masks = np.zeros_like(masks)
    masks[0, 2, 2] = True
    pixels = PixelSampler(reader_of(tmp_path, counts), masks, 1, 0, has_flagged=False)
    lines = [2, 1, 2, 3, 2, 1, 2]
    samples = [2, 2, 1, 2, 3, 1, 2]
    batch = pixels.at(np.array([[0] * 6 + [1], lines, samples]).T)
    assert batch["free"][:, 0].tolist() == [False] * 5 + [True] * 2


def test_given_pixels_are_read_in_their_order(sampler, counts, masks):
    batch = sampler(1).at(INDICES)
    np.testing.assert_array_equal(batch["indices"], INDICES)
    np.testing.assert_array_equal(batch["mask"][:, 0], [masks[tuple(pixel)] for pixel in INDICES])
    np.testing.assert_allclose(batch["spectral"], [counts[tuple(p)] / REFLECTANCE_SCALE for p in INDICES], rtol=1e-6)
