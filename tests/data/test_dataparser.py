"""How frames are divided between training and evaluation, where the scene lies for the model, what an item holds."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from ball_run import write_ball_dataset
from capture_factory import write_session
from painted_stem import paint_stem

from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.config import hsi_sc_nerf
from hsi_sc_nerf.data.datamanager import SpectralDataset
from hsi_sc_nerf.data.dataparser import (
    SpectralDataParserConfig,
    processed_dir,
    require_data,
    scene_scaling,
    split_frames,
)
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.run_settings import read_config
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE
from hsi_sc_nerf.packed.dataset import open_packed, write_transforms
from hsi_sc_nerf.processing.frames import session_fingerprint
from hsi_sc_nerf.processing.painted_masks import note_masks


@pytest.mark.parametrize("num_frames", [2, 3, 8, 10, 36, 60])
def test_frames_are_trained_on_or_held_out(num_frames):
    train, held_out = split_frames(num_frames, 0.9)
    assert sorted([*train, *held_out]) == list(range(num_frames))
    assert len(held_out) == max(1, num_frames // 10)


def test_held_out_frames_are_spread_evenly():
    gaps = np.diff(split_frames(60, 0.9)[1])
    assert gaps.min() >= 9
    assert gaps.max() <= 11


@pytest.mark.parametrize(
    ("frames", "fraction", "told"),
    [
        (10, 1.0, "--train-split-fraction is 1.0"),
        (10, -0.1, "--train-split-fraction is -0.1"),
        (1, 0.9, "one frame"),
    ],
)
def test_a_split_without_training_or_held_out_frames_is_refused(frames, fraction, told):
    with pytest.raises(InputError, match=told):
        split_frames(frames, fraction)


def test_data_is_refused_before_a_run_has_a_folder_and_a_damaged_dataset_is_no_session(tmp_path):
    """A dataset has ENVI cubes, as a session has."""
    config = copy.deepcopy(hsi_sc_nerf.config)
    config.output_dir, config.experiment_name, config.timestamp = tmp_path / "runs", "x", "run"
    (tmp_path / "data" / "cubes").mkdir(parents=True)
    (tmp_path / "data" / "cubes" / "a.hdr").write_text("ENVI")
    (tmp_path / "data" / "transforms.json").write_text('{"frames": [')
    for data, told in ((tmp_path / "nowhere", "no packed dataset"), (tmp_path / "data", "not a JSON object")):
        config.pipeline.datamanager.data = data
        with pytest.raises(SystemExit, match=rf"^hsi-sc-nerf: [^\n]*transforms.json: [^\n]*{told}[^\n]*\.$"):
            config.save_config()
        with pytest.raises(SystemExit, match=told):
            SpectralDataParserConfig(data=data).setup().get_dataparser_outputs("train")
    assert not config.output_dir.exists()


def test_what_painted_masks_add_is_inside_the_boxes_of_the_run_alone(tmp_path):
    data = write_ball_dataset(tmp_path / "data")
    processed, before = open_packed(data), (data / "transforms.json").read_bytes()
    top_m = paint_stem(processed)
    config = copy.deepcopy(hsi_sc_nerf.config)
    config.output_dir, config.experiment_name, config.timestamp = tmp_path / "runs", "x", "run"
    config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = data
    config.save_config()
    assert (data / "transforms.json").read_bytes() == before
    stored = read_config(config.get_base_dir() / "config.yml").pipeline.datamanager.dataparser
    for parser in (config.pipeline.datamanager.dataparser, stored):  # of the training, and of what is done afterwards
        dataset = parser.setup().get_dataparser_outputs("train").metadata["dataset"]
        assert dataset.object_box_m[1, 2] > top_m
        assert dataset.scene_box_m[1, 2] > dataset.object_box_m[1, 2]
    assert np.ptp(dataset.object_box_m[:, :2]) == pytest.approx(np.ptp(processed.object_box_m[:, :2]), abs=0.02)
    # Another training, of masks that count as those of `process`.
    note_masks(processed)
    config.save_config()
    assert config.pipeline.datamanager.dataparser.object_box_m is None


def test_painted_masks_of_a_dataset_that_is_made_anew_have_no_box(tmp_path, capsys):
    """The session has changed since: masks, poses and scale will be others."""
    session_dir, config = write_session(tmp_path / "s"), copy.deepcopy(hsi_sc_nerf.config)
    manager = config.pipeline.datamanager
    manager.data = manager.dataparser.data = session_dir
    fingerprint = session_fingerprint(open_session(session_dir), manager.dataparser.process)
    dataset = open_packed(write_ball_dataset(processed_dir(session_dir)))
    write_transforms(replace(dataset, fingerprint=fingerprint, metric=False))
    for name in ("calibration.json", "poses.json"):  # without them it would not be whole
        (dataset.root / name).write_text("{}")
    top_m = paint_stem(dataset)
    require_data(manager)
    assert manager.dataparser.object_box_m[1][2] > top_m
    assert " mm" not in capsys.readouterr().out  # nothing gives the scale
    (session_dir / "session.json").write_text('{"object": "pear"}')
    require_data(manager)
    assert manager.dataparser.object_box_m is None


def test_the_scene_fills_the_models_cube():
    box = np.array([[-0.1, -0.2, 0.0], [0.3, 0.2, 0.1]])
    centre, scale = scene_scaling(box)
    np.testing.assert_allclose((box - centre) * scale, [[-1, -1, -0.25], [1, 1, 0.25]])


def held_out(data) -> SpectralDataset:
    return SpectralDataset(SpectralDataParserConfig(data=data).setup().get_dataparser_outputs("test"))


@pytest.mark.parametrize("flagged", [False, True])
def test_a_held_out_view_holds_what_was_measured(tiny_dataset, flagged_dataset, flagged):
    dataset = held_out(flagged_dataset if flagged else tiny_dataset[0])
    item, counts = dataset[0], np.asarray(dataset.frames[0].cube())
    assert dataset.has_flagged == ("valid" in item) == flagged
    if flagged:
        np.testing.assert_array_equal(item["valid"], counts != FLAGGED)
        assert not item["valid"].all()
    expected = np.where(counts == FLAGGED, 0, counts) / np.float32(REFLECTANCE_SCALE)
    torch.testing.assert_close(item["spectral"], torch.from_numpy(expected))
    np.testing.assert_array_equal(item["mask"][..., 0], dataset.frames[0].mask())
