"""Boxes of the object by masks that were painted, beside those that `process` made."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ball_run import write_ball_dataset
from painted_stem import paint_stem

from hsi_sc_nerf.fields.occupancy_grid import bounds_from_masks
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.processing.painted_masks import painted_box, with_object_box
from hsi_sc_nerf.processing.visual_hull import object_box, voted_hull


@pytest.fixture
def ball(tmp_path):
    """A dataset with the box that `process` gives it."""
    dataset = open_packed(write_ball_dataset(tmp_path / "data"))
    masks = np.stack([frame.mask() for frame in dataset.frames])
    box_m = object_box(voted_hull(masks, dataset.camera_to_worlds, dataset.intrinsics))
    return replace(dataset, object_box_m=box_m)


def test_masks_of_process_leave_the_box_as_it_is_also_saved_anew(ball):
    assert painted_box(ball) is None
    for frame in ball.frames:
        cv2.imwrite(str(frame.mask_path), frame.mask().astype(np.uint8) * 200)
    assert painted_box(ball) is None


def test_masks_that_are_as_noted_are_not_looked_at(ball):
    too_small = replace(ball, object_box_m=0.5 * ball.object_box_m)
    assert painted_box(too_small) is None
    next(ball.root.glob(".cache/masks*")).unlink()
    assert painted_box(too_small) is not None


def test_what_is_painted_away_does_not_make_the_box_smaller(ball):
    for frame in ball.frames:
        mask = frame.mask()
        mask[: mask.shape[0] // 2] = False
        write_png(frame.mask_path, mask.astype(np.uint8) * 255)
    assert painted_box(ball) is None
    for frame in ball.frames:
        write_png(frame.mask_path, np.zeros_like(mask, np.uint8))
    assert painted_box(ball) is None


def test_matter_may_be_where_a_stem_was_painted(ball):
    top_m, cell_m = paint_stem(ball), 0.004
    box_m = painted_box(ball)
    assert ball.object_box_m[1, 2] < top_m - 0.01
    assert top_m < box_m[1, 2] < top_m + 0.03
    grown = with_object_box(ball, box_m)
    shape = tuple(np.ceil(np.diff(grown.scene_box_m, axis=0)[0] / cell_m).astype(int))
    for dataset, holds_stem in ((ball, False), (grown, True)):
        matter, _ = bounds_from_masks(dataset, dataset.frames, shape, grown.scene_box_m[0], cell_m)
        highest_m = grown.scene_box_m[0, 2] + cell_m * (np.flatnonzero(matter.any(axis=(0, 1)))[-1] + 1)
        assert (highest_m > top_m) == holds_stem
