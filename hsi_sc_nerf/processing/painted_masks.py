"""The boxes of a dataset whose masks were painted after `process` had made it: they hold what was added."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.processing.visual_hull import OBJECT_MARGIN_M, SCENE_MARGIN_M, object_box, voted_hull

_NOTE = Path(".cache") / "masks.sha256"


def painted_box(dataset: PackedDataset) -> Float[np.ndarray, "2 3"] | None:
    """The object's box where painted masks show more than the dataset's box holds, object frame; None elsewhere.

    Masks that are still those of `process` (`note_masks`) are not looked at, which would take a second or two. What
    was taken away does not make the box smaller: the visual hull, which is inside it, excludes that.

    Raises:
        InputError: a mask cannot be read, or has another size than the dataset's.

    Example:
        >>> dataset = open_packed("apple_01-data")
        >>> box_m = painted_box(dataset)
        >>> dataset = dataset if box_m is None else with_object_box(dataset, box_m)
    """
    note = dataset.root / _NOTE
    if note.is_file() and note.read_bytes() == _digest(dataset):
        return None
    lid_z_m = None if dataset.container is None else dataset.container.height_m
    masks = np.stack([dataset.mask_of(frame) for frame in dataset.frames])
    hull = voted_hull(masks, dataset.camera_to_worlds, dataset.intrinsics, lid_z_m)
    if not len(hull.core):
        return None
    (low, high), (shown_low, shown_high) = dataset.object_box_m, object_box(hull, lid_z_m)
    # A hull of the same masks, which `process` has trimmed, differs by less.
    if max((low - shown_low).max(), (shown_high - high).max()) <= OBJECT_MARGIN_M:
        return None
    return np.stack([np.minimum(low, shown_low), np.maximum(high, shown_high)])


def note_masks(dataset: PackedDataset) -> None:
    """Keep what the masks are, so that painted ones are known from them, also in a copy of the dataset.

    Raises:
        InputError: the operating system refused to write.
    """
    with atomic_write(dataset.root / _NOTE) as (temporary,):
        temporary.write_bytes(_digest(dataset))


def _digest(dataset: PackedDataset) -> bytes:
    digest = hashlib.sha256()
    for frame in dataset.frames:
        digest.update(frame.mask_path.read_bytes())
    return digest.hexdigest().encode()


def with_object_box(dataset: PackedDataset, object_box_m: Float[np.ndarray, "2 3"]) -> PackedDataset:
    """The dataset with another box of the object; the box of everything that turns grows if it has to."""
    low, high = dataset.scene_box_m
    reach = max(high[:2].max(), np.abs(object_box_m[:, :2]).max() + SCENE_MARGIN_M)
    lowest = min(low[2], object_box_m[0, 2] - SCENE_MARGIN_M)
    highest = max(high[2], object_box_m[1, 2] + SCENE_MARGIN_M)
    scene_box_m = np.array([[-reach, -reach, lowest], [reach, reach, highest]])
    return replace(dataset, object_box_m=object_box_m, scene_box_m=scene_box_m)
