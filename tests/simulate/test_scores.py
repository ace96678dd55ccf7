"""The score of a processed session, on a dataset that was given errors of known size."""

from dataclasses import replace

import numpy as np
import pytest

from hsi_sc_nerf.packed.cube import pack, unpack, write_packed_cube
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.simulate.scores import score_processing
from hsi_sc_nerf.simulate.truth import load_truth


@pytest.fixture
def dataset_and_truth(tiny_dataset):
    """A dataset whose poses and focal length are exactly the truth's."""
    data, session = tiny_dataset
    dataset, truth = open_packed(data), load_truth(session)
    frames = [replace(f, camera_to_world=c) for f, c in zip(dataset.frames, truth.camera_to_world, strict=True)]
    return replace(dataset, frames=tuple(frames), intrinsics=truth.intrinsics), truth


def test_the_worst_frame_and_the_focal_length_count(dataset_and_truth):
    dataset, truth = dataset_and_truth
    c, s = np.cos(np.radians(0.3)), np.sin(np.radians(0.3))
    frames, turned = list(dataset.frames), dataset.frames[3].camera_to_world.copy()
    turned[:3, :3] = turned[:3, :3] @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    turned[:3, 3] += [0.0, 0.003, 0.004]
    frames[3] = replace(frames[3], camera_to_world=turned)
    longer = replace(dataset.intrinsics, fl_x=1.02 * dataset.intrinsics.fl_x)
    score = score_processing(replace(dataset, frames=tuple(frames), intrinsics=longer), truth)
    assert score.focal_length_percent == pytest.approx(2.0)
    assert score.rotation_deg == pytest.approx(0.3, rel=1e-4)
    assert score.position_m == pytest.approx(0.005)


def test_frames_are_matched_by_capture_and_not_by_place(dataset_and_truth):
    dataset, truth = dataset_and_truth
    expected = score_processing(dataset, truth)
    assert score_processing(replace(dataset, frames=dataset.frames[::-1]), truth).position_m < 1e-9
    # A dataset without its first frame is compared with the others' truth.
    assert score_processing(replace(dataset, frames=dataset.frames[1:]), truth).mask_iou >= expected.mask_iou


def test_reflectance_and_masks_of_another_frame_are_seen(dataset_and_truth):
    dataset, truth = dataset_and_truth
    honest = score_processing(dataset, truth)
    frames = list(dataset.frames)
    frames[0] = replace(frames[0], cube_path=frames[5].cube_path, mask_path=frames[5].mask_path)
    mixed = score_processing(replace(dataset, frames=tuple(frames)), truth)
    assert mixed.reflectance_rmse > 3 * honest.reflectance_rmse
    assert mixed.mask_iou < honest.mask_iou


def with_cubes(dataset, folder, change):
    """The dataset with its cubes' reflectance and validity changed, in another folder."""
    frames = []
    for frame in dataset.frames:
        reflectance, valid = unpack(frame.cube())
        change(reflectance, valid)
        path = folder / frame.cube_path.name
        write_packed_cube(path, pack(np.where(valid, reflectance, np.nan)), dataset.wavelengths_nm)
        frames.append(replace(frame, cube_path=path))
    return replace(dataset, frames=tuple(frames))


def test_flagged_values_are_counted_and_not_judged(dataset_and_truth, tmp_path):
    dataset, truth = dataset_and_truth
    honest = score_processing(dataset, truth)
    assert honest.flagged_fraction == 0.0

    def flag(reflectance, valid):
        valid[:28, :, ::2] = False  # a quarter of 112 lines, half of the bands

    score = score_processing(with_cubes(dataset, tmp_path, flag), truth)
    assert score.flagged_fraction == pytest.approx(1 / 8)
    assert score.reflectance_rmse == pytest.approx(honest.reflectance_rmse, rel=0.2)

    def flag_all(reflectance, valid):
        valid[:] = False

    assert np.isnan(score_processing(with_cubes(dataset, tmp_path, flag_all), truth).reflectance_rmse)


def test_reflectance_is_compared_with_the_truth_of_its_bands_clipped_likewise(dataset_and_truth, tmp_path):
    dataset, truth = dataset_and_truth
    bright = replace(truth, endmembers=4.0 * truth.endmembers)

    def lit(reflectance, valid):
        reflectance[:] = np.clip(4.0 * reflectance, 0.0, 1.0)

    honest, clipped = score_processing(dataset, truth), with_cubes(dataset, tmp_path, lit)
    assert score_processing(clipped, bright).reflectance_rmse < 4.0 * honest.reflectance_rmse

    kept = [1, 4, 5]
    frames = []
    for frame in dataset.frames:
        write_packed_cube(
            tmp_path / f"kept_{frame.capture}.hdr", frame.cube()[..., kept], dataset.wavelengths_nm[kept]
        )
        frames.append(replace(frame, cube_path=tmp_path / f"kept_{frame.capture}.hdr"))
    fewer = replace(dataset, frames=tuple(frames), wavelengths_nm=dataset.wavelengths_nm[kept])
    assert score_processing(fewer, truth).reflectance_rmse < 2.0 * honest.reflectance_rmse
