"""Regions of interest: which points of the surface a cloud keeps (scene units)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from torch.nn import functional

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import read_picture
from hsi_sc_nerf.findings import names_in_short
from hsi_sc_nerf.packed.dataset import PackedFrame
from hsi_sc_nerf.processing.visual_hull import silhouette_counts
from hsi_sc_nerf.surface.depth_renders import DepthRenders

MIN_MASK_FRACTION = 0.8
"""A point must be in the mask in this fraction of the frames that have it in the image: a few masks may be wrong."""
MASK_MARGIN_PX = 2
"""Masks are widened by this for the visual hull: boundaries are uncertain by a pixel or two."""

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Region:
    """Points to keep.

    Attributes:
        contains: which points, given with outward unit normals, lie in the region.
        bounds: minimum and maximum of a box around the region; the surface is sampled only near it.
    """

    contains: Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]], Bool[np.ndarray, "n"]]
    bounds: Float[np.ndarray, "2 3"] = field(default_factory=lambda: np.array([[-np.inf] * 3, [np.inf] * 3]))

    def __and__(self, other: Region) -> Region:
        """The intersection of two regions."""
        return Region(
            lambda points, normals: self.contains(points, normals) & other.contains(points, normals),
            np.stack([np.maximum(self.bounds[0], other.bounds[0]), np.minimum(self.bounds[1], other.bounds[1])]),
        )


EVERYWHERE = Region(lambda points, _: np.ones(len(points), bool))


def in_box(points: Float[np.ndarray, "n 3"], box: Float[np.ndarray, "2 3"]) -> Bool[np.ndarray, "n"]:
    """Which points lie in a box, given by its minimum and maximum, borders included."""
    return ((points >= box[0]) & (points <= box[1])).all(axis=1)


def box_region(box: Float[np.ndarray, "2 3"]) -> Region:
    """A box along the axes, given by its minimum and maximum."""
    return Region(lambda points, _: in_box(points, box), box)


def oriented_box_region(centre: Vector, roll_pitch_yaw: Vector, sides: Vector) -> Region:
    """nerfstudio's oriented box; angles in radians."""
    box = OrientedBox.from_params(centre, roll_pitch_yaw, sides)
    reach = np.abs(box.R.numpy()) @ np.divide(sides, 2.0)
    return Region(
        lambda points, _: box.within(torch.from_numpy(points).float()).numpy(),
        np.array(centre) + np.stack([-reach, reach]),
    )


def visual_hull_region(renders: DepthRenders) -> Region:
    """Points that fall on the object's mask in nearly all frames, seen or hidden (the visual hull, Laurentini 1994).

    The object always does. Floaters and points on the container do so only in frames where the object is before or
    behind them.
    """
    size = 2 * MASK_MARGIN_PX + 1
    masks = torch.cat([functional.max_pool2d(m[None].float(), size, 1, MASK_MARGIN_PX) > 0.0 for m in renders.masks])

    def contains(points: np.ndarray, _: np.ndarray) -> np.ndarray:
        positions = torch.from_numpy(points).float().to(masks.device)
        in_image, in_mask = silhouette_counts(positions, masks, renders.pixels_of)
        return (in_mask >= MIN_MASK_FRACTION * in_image).cpu().numpy()

    return Region(contains)


def painted_region(masks: dict[int, Bool[np.ndarray, "lines samples"]], renders: DepthRenders) -> Region:
    """Points inside painted masks in every frame of the masks that sees them, and seen in at least one.

    Args:
        masks: masks by index of the frame, as `read_roi_masks` gives them.
        renders: depth maps of all frames.
    """
    device = renders.masks.device
    painted = {frame: torch.from_numpy(mask).to(device) for frame, mask in masks.items()}

    def contains(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        inside, outside = torch.zeros(2, len(points), dtype=torch.bool, device=device)
        positions, outward = (torch.from_numpy(array).float().to(device) for array in (points, normals))
        for frame, mask in painted.items():
            view = renders.view(frame, positions, outward)
            on_mask = mask[view.pixels[:, 1], view.pixels[:, 0]]
            inside |= view.visible & on_mask
            outside |= view.visible & ~on_mask
        return (inside & ~outside).cpu().numpy()

    return Region(contains)


def read_roi_masks(
    folder: Path, frames: Sequence[PackedFrame], shape: tuple[int, int]
) -> dict[int, Bool[np.ndarray, "lines samples"]]:
    """Painted masks by the index of their frame: pictures named as the frames' own masks, white in the region.

    Raises:
        InputError: the folder holds no picture of these frames, or one that cannot be read or has another size.
    """
    masks = {}
    for index, frame in enumerate(frames):
        path = folder / frame.mask_path.name
        if not path.is_file():
            continue
        picture = read_picture(path, 1)
        if picture is None or picture.shape != shape:
            raise InputError(f"{path}: is no picture of {shape[1]} x {shape[0]} pixels; paint on a copy of the mask.")
        masks[index] = picture > 127
    if not masks:
        raise InputError(
            f"{folder}: holds no mask of a training frame; name the pictures like {frames[0].mask_path.name}."
        )
    used = {frames[index].mask_path.name for index in masks}
    if unused := sorted(path.name for path in folder.glob("*.png") if path.name not in used):
        names = escape(names_in_short(unused))
        CONSOLE.print(f"[yellow]{escape(str(folder))}: not used, because they are of no training frame: {names}")
    return masks
