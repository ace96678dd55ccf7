from dataclasses import replace

import numpy as np
import pytest
from capture_factory import packed_frame

from hsi_sc_nerf.data.background_image import (
    MAX_FRAMES,
    cell_pixels,
    estimate_static_background,
    inpaint,
    median_over_frames,
    wiener_filter,
)
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, pixel_rays, turntable_camera_to_world
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, pack, write_packed_cube
from hsi_sc_nerf.packed.dataset import Container, PackedDataset
from hsi_sc_nerf.processing.chamber import turntable_cylinders, turntable_silhouette

LENS = PinholeIntrinsics(48, 40, 70.0, 70.0, 24.0, 20.0)
FIRST_POSE = look_at([0.5, 0.0, 0.35], [0.0, 0.0, 0.05])
BANDS = 3


def wall(lens=LENS, bands=BANDS):
    """A linear ramp across the image, another one a band: bilinear look-up and Laplace's equation keep it exactly."""
    y, x = np.mgrid[: lens.h, : lens.w] + 0.5
    return 0.3 + 0.3 * (x / lens.w)[..., None] + 0.02 * (y / lens.h)[..., None] * np.arange(bands)


def turning_block(k, lens=LENS):
    """A blob that goes to and fro before the wall, half its width to each side."""
    mask = np.zeros((lens.h, lens.w), bool)
    left = lens.w // 2 - 4 + 4 * (k % 2)
    mask[: lens.h // 3, left : left + 6] = True
    return mask


def write_dataset(root, cubes, masks, lens=LENS, container=None):
    frames = []
    for k, (cube, mask) in enumerate(zip(cubes, masks, strict=True)):
        pose = turntable_camera_to_world(FIRST_POSE, 30.0 * k)
        frame = packed_frame(root, f"f{k}", pose, angle_deg=30.0 * k)
        write_packed_cube(frame.cube_path, cube, np.linspace(400, 1000, cube.shape[-1]))
        write_png(frame.mask_path, mask.astype(np.uint8) * 255)
        frames.append(frame)
    return PackedDataset(
        root=root,
        intrinsics=lens,
        distortion=np.zeros(4),
        wavelengths_nm=np.linspace(400, 1000, cubes[0].shape[-1]),
        pseudo_rgb_nm=np.zeros(3),
        object_name="block",
        scene_box_m=np.array([[-0.09, -0.09, -0.005], [0.09, 0.09, 0.2]]),
        object_box_m=np.array([[-0.03, -0.03, 0.03], [0.03, 0.03, 0.2]]),
        background_reflectance=np.full(cubes[0].shape[-1], 0.77),
        container=container,
        frames=tuple(frames),
    )


@pytest.fixture
def session(tmp_path):
    """Eight frames of the ramp with a black block before it and a turntable that changes from frame to frame."""
    rng = np.random.default_rng(0)
    masks = [turning_block(k) for k in range(8)]
    dataset = write_dataset(tmp_path, [pack(wall())] * 8, masks)
    cubes = []
    for frame, mask in zip(dataset.frames, masks, strict=True):
        cube = wall()
        cube[mask] = 0.0
        table = turntable_silhouette(dataset, frame.camera_to_world)
        cube[table] = rng.random((table.sum(), BANDS))
        cubes.append(pack(cube))
    return write_dataset(tmp_path, cubes, masks)


def times_shown(dataset):
    """In how many frames each pixel shows the chamber, well beside what turns."""
    turning = [frame.mask() | turntable_silhouette(dataset, frame.camera_to_world) for frame in dataset.frames]
    return sum(~dilate(mask, 3) for mask in turning)


def test_the_wall_is_found_and_its_hidden_part_inpainted(session):
    found, cell_px = estimate_static_background(session, session.frames)
    assert found.dtype == np.float32
    assert cell_px == 1
    known = times_shown(session) >= 2
    assert 0.4 < known.mean() < 0.9
    assert not known[4, 24:26].any()
    np.testing.assert_allclose(found[known], wall()[known], atol=1.1 / REFLECTANCE_SCALE)
    # The block's hidden core lies between walls, what the turntable hides goes on to the image's border.
    assert np.abs(found - wall())[:10].max() < 0.02
    assert 0.3 - 0.05 < found.min() < found.max() < 0.65 + 0.05


def test_flagged_values_count_nowhere(session):
    cubes = [np.array(frame.cube()) for frame in session.frames]
    for k, cube in enumerate(cubes):
        cube[:25, 10, 1] = FLAGGED
        cube[:25, 4, 2] = FLAGGED if k < 5 else cube[:25, 4, 2]
    dataset = write_dataset(session.root, cubes, [frame.mask() for frame in session.frames])
    found, _ = estimate_static_background(dataset, dataset.frames)
    np.testing.assert_allclose(found[:20, :15], wall()[:20, :15], atol=2e-4)


def test_a_band_measured_nowhere_takes_the_given_spectrum(session):
    cubes = [np.array(frame.cube()) for frame in session.frames]
    for cube in cubes:
        cube[..., 2] = FLAGGED
    dataset = write_dataset(session.root, cubes, [frame.mask() for frame in session.frames])
    found, _ = estimate_static_background(dataset, dataset.frames)
    np.testing.assert_array_equal(found[..., 2], np.float32(0.77))
    assert (found[..., :2] < 0.7).all()


def test_cells_of_several_pixels(tmp_path):
    """The median over frames of other pixels of the cell is the cell's middle on a ramp."""
    lens = PinholeIntrinsics(300, 70, 400.0, 400.0, 150.0, 35.0)
    dataset = write_dataset(tmp_path, [pack(wall(lens))] * 12, [np.zeros((lens.h, lens.w), bool)] * 12, lens)
    found, size = estimate_static_background(dataset, dataset.frames)
    assert size == 3
    assert found.shape == (24, 100, BANDS)
    y, x = (np.minimum(size * np.arange(n) + size / 2, side) for n, side in zip(found.shape, (70, 300), strict=False))
    middle = 0.3 + 0.3 * (x / lens.w)[None, :, None] + 0.02 * (y / lens.h)[:, None, None] * np.arange(BANDS)
    known = times_shown(dataset)[1::3, 1::3][:23] > 0
    difference = (found - middle)[:23][known]
    assert np.abs(difference).max() < 0.7 * 0.3 * size / lens.w
    assert abs(difference.mean()) < 0.2 * 0.3 * size / lens.w


def test_reads_no_more_frames_than_it_may(tmp_path):
    empty = [np.zeros((LENS.h, LENS.w), bool)] * (2 * MAX_FRAMES)
    dataset = write_dataset(tmp_path, [pack(wall())] * len(empty), empty)
    for frame in dataset.frames[::2]:
        frame.mask_path.unlink()
    estimate_static_background(dataset, dataset.frames)


def test_pixels_of_cells_fill_the_cells():
    seen = np.zeros((10, 9), int)
    for index in range(16):
        y, x = cell_pixels(10, 9, 4, index)
        np.testing.assert_array_equal([y // 4, x // 4], [[0, 1, 2], [0, 1, 2]])
        seen[np.ix_(y, x)] += 1
    assert (seen[:8, :8] > 0).mean() > 0.7
    assert seen.max() <= 12


def test_silhouette_of_the_turntable_is_where_rays_meet_it(tmp_path):
    lens = PinholeIntrinsics(160, 120, 220.0, 230.0, 78.0, 63.0)
    empty = np.zeros((lens.h, lens.w), bool)
    container = Container(0.06, 0.05)
    dataset = write_dataset(tmp_path, [np.zeros((lens.h, lens.w, 1), np.uint16)], [empty], lens, container)
    pose = dataset.frames[0].camera_to_world
    silhouette = turntable_silhouette(dataset, pose)
    y, x = np.mgrid[: lens.h, : lens.w] + 0.5
    origin, directions = pixel_rays(lens, pose, np.stack([x, y], -1))
    steps = np.linspace(0.35, 0.8, 450)
    met = np.zeros_like(silhouette)
    for t in steps:
        p = origin + t * directions
        radius = np.hypot(p[..., 0], p[..., 1])
        met |= (radius < 0.09) & (p[..., 2] > -0.005) & (p[..., 2] < 0.0)
        met |= (radius < 0.03 / np.cos(np.pi / 6)) & (p[..., 2] > 0.0) & (p[..., 2] < 0.05)
    assert 0.1 < met.mean() < 0.9
    assert not (met & ~dilate(silhouette, 5)).any()
    assert not (silhouette & ~dilate(met, 5)).any()


def test_everything_below_the_object_turns_where_the_container_is_not_known(tmp_path):
    dataset = write_dataset(tmp_path, [np.zeros((LENS.h, LENS.w, 1), np.uint16)], [np.zeros((LENS.h, LENS.w), bool)])
    (rims,) = turntable_cylinders(dataset)
    np.testing.assert_allclose(np.hypot(rims[:, 0], rims[:, 1]), 0.09)
    np.testing.assert_allclose([rims[:, 2].min(), rims[:, 2].max()], [-0.005, 0.03])
    pose = dataset.frames[0].camera_to_world
    barrel = replace(dataset, distortion=np.array([-0.8, 0.0, 0.0, 0.0]))
    assert turntable_silhouette(barrel, pose).sum() < 0.97 * turntable_silhouette(dataset, pose).sum()


def test_median_over_frames_agrees_with_numpy():
    rng = np.random.default_rng(1)
    counts = rng.integers(0, 50_000, (9, 40, 4), dtype=np.uint16)
    counts[rng.random(counts.shape) < 0.3] = FLAGGED
    free = rng.random((9, 40)) < 0.7
    median, variance = median_over_frames(counts, free, min_frames=2)
    for cell in range(40):
        for band in range(4):
            value = counts[free[:, cell], cell, band]
            value = value[value != FLAGGED] / REFLECTANCE_SCALE
            if len(value) < 2:
                assert np.isnan([median[cell, band], variance[cell, band]]).all()
                continue
            assert median[cell, band] == pytest.approx(np.median(value), rel=1e-5)
            mad = np.median(np.abs(value - np.median(value)))
            assert variance[cell, band] == pytest.approx(np.pi / 2 * (1.4826 * mad) ** 2 / len(value), rel=1e-4)
    assert np.isnan(median).any()


def test_wiener_filter_averages_noise_and_keeps_edges():
    rng = np.random.default_rng(3)
    clean = np.full((60, 60, 2), 0.4)
    clean[:, 30:] = 0.8
    noisy = (clean + 0.01 * rng.standard_normal(clean.shape)).astype(np.float32)
    filtered = wiener_filter(noisy, np.full(clean.shape, 1e-4, np.float32), 5)
    far = np.abs(np.arange(60) - 29.5) > 4
    assert np.sqrt(np.mean((filtered - clean)[:, far] ** 2)) < 0.35 * 0.01
    assert np.abs(filtered - clean)[:, ~far].max() < 0.05


def test_wiener_filter_keeps_an_image_without_noise_and_values_that_are_not_measured():
    rng = np.random.default_rng(4)
    image = rng.random((20, 20, 2)).astype(np.float32)
    image[5:9, 5:9, 0] = np.nan
    np.testing.assert_allclose(wiener_filter(image, np.zeros_like(image), 5), image, atol=1e-6)
    bands = np.broadcast_to(np.float32([0.0, 1.0, 0.0]), (12, 12, 3))  # are not mixed
    np.testing.assert_allclose(wiener_filter(bands, np.full_like(bands, 0.01), 5), bands, atol=1e-6)
    lonely = np.full((9, 9, 1), np.nan, np.float32)
    lonely[4, 4] = 0.25
    np.testing.assert_allclose(wiener_filter(lonely, np.ones_like(lonely), 3), lonely, atol=1e-6)


def test_inpainting_keeps_a_ramp_and_every_inpainted_cell_is_its_neighbours_mean():
    y, x = np.mgrid[:20, :24]
    ramp = np.stack([x + 2.0 * y, np.ones_like(x, float), -0.5 * x], -1)
    image = ramp.copy()
    image[5:15, 6:18] = np.nan
    image[2, 3, 1] = np.nan
    np.testing.assert_allclose(inpaint(image, np.zeros(3)), ramp, rtol=1e-5, atol=1e-5)

    rng = np.random.default_rng(5)
    image = rng.random((12, 10, 1))
    hidden = rng.random((12, 10)) < 0.5
    image[hidden] = np.nan
    filled = inpaint(image, np.zeros(1))[..., 0]
    np.testing.assert_allclose(filled[~hidden], image[~hidden, 0], rtol=1e-6)
    for i, j in np.argwhere(hidden):
        near = [(i + a, j + b) for a, b in ((0, 1), (1, 0), (0, -1), (-1, 0)) if 0 <= i + a < 12 and 0 <= j + b < 10]
        assert filled[i, j] == pytest.approx(np.mean([filled[cell] for cell in near]), abs=1e-5)
