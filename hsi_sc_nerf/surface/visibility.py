"""Which frames see which points of a surface: inside the picture, from the front, with nothing before them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.geometry.ray_projection import image_coordinates, in_camera_frame

MIN_COSINE = 0.17
"""Faces that a camera sees at more than 80 degrees from their normal are smeared over its pixels: not seen."""
_SLOPE_SLACK = 0.75
"""Depth changes within a cell of a depth map by its half diagonal (0.71 of its side) times the surface's slope."""


@dataclass(frozen=True, eq=False)
class DepthMaps:
    """The frames' poses and what each of them sees; lengths in any one unit.

    Attributes:
        camera_to_world: poses (OpenGL axes), refined.
        intrinsics: of the one camera.
        distortion: k1, k2, p1, p2 (OpenCV).
        depths: distance from the camera to what it sees in the middle of each cell; infinite where it sees nothing,
            NaN where nobody looked.
        cell_px: side of the cells, pixels.
        masks: pixels in which points may be seen.
        tolerance: a point this far behind what the camera sees still counts as that.
    """

    camera_to_world: Float[Tensor, "frames 4 4"]
    intrinsics: PinholeIntrinsics
    distortion: tuple[float, float, float, float]
    depths: Float[Tensor, "frames cells_down cells_across"]
    cell_px: int
    masks: Bool[Tensor, "frames lines samples"]
    tolerance: float

    def seen(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Iterator[FrameView]:
        """What each frame, in order, sees of points with outward unit normals."""
        for frame in range(len(self.depths)):
            yield self.seen_in(frame, points, normals)

    def seen_in(self, frame: int, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> FrameView:
        """What one frame sees of points with outward unit normals."""
        to_point, distance, places, inside, pixels = self._projected(frame, points)
        inside &= self.masks[frame, pixels[:, 1], pixels[:, 0]]
        cosines = -(normals * to_point).sum(dim=-1) / distance
        cosine = cosines.clamp_min(MIN_COSINE)
        slope = (1.0 - cosine.square()).clamp_min(0.0).sqrt() / cosine
        lens = self.intrinsics
        slack = self.tolerance + _SLOPE_SLACK * slope * distance * self.cell_px / min(lens.fl_x, lens.fl_y)
        visible = inside & (cosines > MIN_COSINE) & (distance <= self._depths_at(frame, pixels) + slack)
        return FrameView(visible, cosines, places, pixels)

    def depth_behind(self, frame: int, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Distances of points from a frame's camera, and the depth in their cells; NaN where nobody looked."""
        _, distance, _, inside, pixels = self._projected(frame, points)
        return distance, torch.where(inside, self._depths_at(frame, pixels), torch.nan)

    def pixels_of(self, frame: int, points: Float[Tensor, "n 3"]) -> tuple[Bool[Tensor, "n"], Int[Tensor, "n 2"]]:
        """Which points lie in a frame's picture, hidden or not, and their pixels (sample, line); else (0, 0)."""
        *_, inside, pixels = self._projected(frame, points)
        return inside, pixels

    def _projected(self, frame: int, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Vectors from the camera, their lengths, places in the picture, which lie in it, their pixels."""
        pose, lens = self.camera_to_world[frame], self.intrinsics
        to_point = points - pose[:3, 3]
        rotation = pose[:3, :3].reshape(9).expand(len(points), 9)
        places, forward = image_coordinates(in_camera_frame(to_point, rotation), lens, self.distortion)
        inside = forward & ((places >= 0.0) & (places < places.new_tensor([lens.w, lens.h]))).all(dim=-1)
        pixels = torch.where(inside[:, None], places, 0.0).long()
        return to_point, to_point.norm(dim=-1), places, inside, pixels

    def _depths_at(self, frame: int, pixels: Tensor) -> Tensor:
        cells = pixels // self.cell_px
        return self.depths[frame, cells[:, 1], cells[:, 0]]


@dataclass(frozen=True, eq=False)
class FrameView:
    """What one frame sees of points.

    Attributes:
        visible: which of them.
        cosines: of the angle between their normals and the way to the camera.
        places: where they are in the picture, (x, y) in pixels from its corner; means nothing behind the camera.
        pixels: (sample, line) that they fall into, (0, 0) outside the picture.
    """

    visible: Bool[Tensor, "n"]
    cosines: Float[Tensor, "n"]
    places: Float[Tensor, "n 2"]
    pixels: Int[Tensor, "n 2"]


def most_frontal(
    maps: DepthMaps, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n 2"], Float[Tensor, "n"]]:
    """The frame that sees each point most from the front (-1 if none does), its place (x, y) there, and how much.

    The last is the cosine of the angle between normal and view, at least ``MIN_COSINE``.
    """
    best = torch.full((len(points),), MIN_COSINE, dtype=points.dtype, device=points.device)
    frames = torch.full((len(points),), -1, device=points.device)
    places = points.new_zeros(len(points), 2)
    for index, view in enumerate(maps.seen(points, normals)):
        better = view.visible & (view.cosines > best)
        best = torch.where(better, view.cosines, best)
        frames = torch.where(better, index, frames)
        places = torch.where(better[:, None], view.places, places)
    return frames, places, best
