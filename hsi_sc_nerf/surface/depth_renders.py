"""Depth maps that a trained model renders for its training cameras, and which frames see a point.

Lengths are in scene units.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from hsi_sc_nerf.data.dataparser import FRAME_INDEX
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, image_coordinates, in_camera_frame
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.surface.surface_depth import MIN_COSINE, MIN_OPACITY, camera_rays, surface_depth
from hsi_sc_nerf.terminal import progress_bar

MAX_DEPTH_RAYS = 300_000
"""Rays of all depth maps together. If the masks hold more pixels, cells of several pixels share a ray."""
MARGIN_CELLS = 5
"""Depth maps extend this far beyond the masks: rays beside the object show that the space there is empty. Without
them, parts thinner than the truncation distance would become thicker in the fused mesh."""
_DEPTH_TOLERANCE = 0.02
"""A point this far behind the depth map is still visible: about 2 mm."""
_SLOPE_TOLERANCE = 0.75
"""Within a cell the depth changes by half the cell's diagonal (0.71 of its side) times the surface's slope."""


@dataclass(frozen=True, eq=False)
class FrameView:
    """Visibility of points in one frame.

    Attributes:
        visible: whether the point is in the image and in the mask, faces the camera, and nothing occludes it.
        beside_mask: the same for points beside the mask.
        cosines: cosines of the angle between the point's normal and the direction to the camera.
        xy_px: image coordinates (x, y) from the upper left corner; undefined behind the camera.
        pixels: (sample, line) of the point; (0, 0) outside the image.
    """

    visible: Bool[Tensor, "n"]
    beside_mask: Bool[Tensor, "n"]
    cosines: Float[Tensor, "n"]
    xy_px: Float[Tensor, "n 2"]
    pixels: Int[Tensor, "n 2"]


@dataclass(frozen=True, eq=False)
class DepthRenders:
    """Poses and depth maps of frames; lengths in any one unit.

    Attributes:
        camera_to_world: refined poses (OpenGL axes).
        intrinsics: intrinsics of the one camera.
        distortion: k1, k2, p1, p2 (OpenCV).
        depths: distance from the camera to the surface at each cell's centre; infinite where a ray hits nothing, NaN
            where no ray was rendered.
        cell_px: side of the cells, pixels.
        masks: pixels in which points may be seen.
        points: hits of the rays within the masks.
    """

    camera_to_world: Float[Tensor, "frames 4 4"]
    intrinsics: PinholeIntrinsics
    distortion: tuple[float, float, float, float]
    depths: Float[Tensor, "frames cells_down cells_across"]
    cell_px: int
    masks: Bool[Tensor, "frames lines samples"]
    points: Float[np.ndarray, "hits 3"]

    def views(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Iterator[FrameView]:
        """Visibility of points with outward unit normals in each frame, in order."""
        return (self.view(frame, points, normals) for frame in range(len(self.depths)))

    def view(self, frame: int, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> FrameView:
        """Visibility of points with outward unit normals in one frame."""
        to_point, xy_px, inside, pixels = self._project(frame, points)
        distance = to_point.norm(dim=-1)
        cosines = -(normals * to_point).sum(dim=-1) / distance
        bounded = cosines.clamp_min(MIN_COSINE)
        slope = (1.0 - bounded.square()).clamp_min(0.0).sqrt() / bounded
        cell = distance * self.cell_px / min(self.intrinsics.fl_x, self.intrinsics.fl_y)
        tolerance = _DEPTH_TOLERANCE + _SLOPE_TOLERANCE * slope * cell
        seen = inside & (cosines > MIN_COSINE) & (distance <= self._depth_of(frame, pixels) + tolerance)
        in_mask = self.masks[frame, pixels[:, 1], pixels[:, 0]]
        return FrameView(seen & in_mask, seen & ~in_mask, cosines, xy_px, pixels)

    def most_frontal(
        self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
    ) -> tuple[Int[Tensor, "n"], Float[Tensor, "n 2"], Float[Tensor, "n"]]:
        """The frame that sees each point most from the front, its image coordinates, the cosine.

        The frame is -1 for points that no frame sees, and for those that most frames see beside their masks: points
        of the support close to the object.
        """
        balance = torch.zeros(len(points), dtype=torch.long, device=points.device)

        def cosines(_: int, view: FrameView) -> Float[Tensor, "n"]:
            balance.add_(view.visible.long() - view.beside_mask.long())
            return view.cosines

        frames, xy_px, best = self.best_views(points, normals, cosines)
        return torch.where(balance < 0, -1, frames), xy_px, best.clamp_min(MIN_COSINE)

    def best_views(
        self,
        points: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
        score_of: Callable[[int, FrameView], Float[Tensor, "n"]],
    ) -> tuple[Int[Tensor, "n"], Float[Tensor, "n 2"], Float[Tensor, "n"]]:
        """The frame that sees each point with the highest score or -1, image coordinates there, the score.

        Args:
            points: in the unit of the depth maps.
            normals: outward unit normals.
            score_of: scores of a frame's view; minus infinity for points that it shall not show.
        """
        best = points.new_full((len(points),), -torch.inf)
        frames = torch.full((len(points),), -1, device=points.device)
        xy_px = points.new_zeros(len(points), 2)
        for index, view in enumerate(self.views(points, normals)):
            score = score_of(index, view)
            better = view.visible & (score > best)
            best = torch.where(better, score, best)
            frames = torch.where(better, index, frames)
            xy_px = torch.where(better[:, None], view.xy_px, xy_px)
        return frames, xy_px, best

    def depth_at(self, frame: int, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Distances of points from a frame's camera, and the depth map at them.

        The depth is NaN where no ray was rendered, and behind a surface beside the mask, which is not the object's.
        """
        to_point, _, inside, pixels = self._project(frame, points)
        distances, depths = to_point.norm(dim=-1), self._depth_of(frame, pixels)
        in_mask = self.masks[frame, pixels[:, 1], pixels[:, 0]]
        return distances, torch.where(inside & (in_mask | (distances < depths)), depths, torch.nan)

    def pixels_of(self, frame: int, points: Float[Tensor, "n 3"]) -> tuple[Bool[Tensor, "n"], Int[Tensor, "n 2"]]:
        """Which points lie in a frame's image, hidden or not, and their pixels (sample, line); (0, 0) for others."""
        return self._project(frame, points)[2:]

    def _project(self, frame: int, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Vectors from the camera to points, image coordinates, whether these lie in the image, and pixels."""
        pose, intrinsics = self.camera_to_world[frame], self.intrinsics
        to_point = points - pose[:3, 3]
        rotation = pose[:3, :3].reshape(9).expand(len(points), 9)
        xy_px, forward = image_coordinates(in_camera_frame(to_point, rotation), intrinsics, self.distortion)
        inside = forward & ((xy_px >= 0.0) & (xy_px < xy_px.new_tensor([intrinsics.w, intrinsics.h]))).all(dim=-1)
        return to_point, xy_px, inside, torch.where(inside[:, None], xy_px, 0.0).long()

    def _depth_of(self, frame: int, pixels: Tensor) -> Tensor:
        cells = pixels // self.cell_px
        return self.depths[frame, cells[:, 1], cells[:, 0]]


@torch.no_grad()
def render_depth_maps(
    model: SpectralModel,
    cameras: Cameras,
    masks: Bool[np.ndarray, "frames lines samples"],
    rays_per_batch: int,
    max_rays: int = MAX_DEPTH_RAYS,
) -> DepthRenders:
    """Depth maps of training cameras in the cells that the masks touch, and ``MARGIN_CELLS`` beyond them.

    Args:
        model: trained model, in evaluation mode.
        cameras: the training cameras.
        masks: object's pixels in each camera's frame.
        rays_per_batch: rays rendered at a time.
        max_rays: more pixels than this are rendered in cells of several pixels.
    """
    from skimage.measure import block_reduce

    lines, samples = masks.shape[1:]
    cell_px = max(1, int(np.ceil(np.sqrt(masks.sum() / max_rays))))
    mask_cells = block_reduce(masks, (1, cell_px, cell_px), np.max)  # which fills up the last ones with False
    cells = np.argwhere(np.stack([dilate(mask, 2 * MARGIN_CELLS + 1) for mask in mask_cells]))
    depths = torch.full(mask_cells.shape, torch.nan, device=model.device)
    points = [np.zeros((0, 3), np.float32)]
    with progress_bar("rendering depth maps", "rays", len(cells)) as update:
        for start in range(0, len(cells), rays_per_batch):
            frame, line, sample = cells[start : start + rays_per_batch].T
            xy_px = np.minimum((np.stack([sample, line], axis=1) + 0.5) * cell_px, (samples - 0.5, lines - 0.5))
            rays = camera_rays(cameras, frame, xy_px, model.device)
            median, opacity = model.depth_and_opacity(rays)
            hit = (opacity > MIN_OPACITY)[:, 0]
            origins, directions = rays.origins[hit], rays.directions[hit]
            depth, _ = surface_depth(model, origins, directions, median[hit])
            of_rays = torch.full_like(opacity[:, 0], torch.inf)
            of_rays[hit] = depth[:, 0]
            depths[frame, line, sample] = of_rays
            in_mask = torch.from_numpy(mask_cells[frame, line, sample]).to(hit.device)[hit]
            points.append((origins + directions * depth)[in_mask].cpu().numpy())
            update(start + rays_per_batch)
    fx, fy, cx, cy = (float(getattr(cameras, name)[0, 0]) for name in ("fx", "fy", "cx", "cy"))
    k1, k2, _, _, p1, p2 = [0.0] * 6 if cameras.distortion_params is None else cameras.distortion_params[0].tolist()
    return DepthRenders(
        camera_to_world=refined_poses(model, cameras),
        intrinsics=PinholeIntrinsics(samples, lines, fx, fy, cx, cy),
        distortion=(k1, k2, p1, p2),
        depths=depths,
        cell_px=cell_px,
        masks=torch.from_numpy(masks).to(model.device),
        points=np.concatenate(points),
    )


@torch.no_grad()
def refined_poses(model: SpectralModel, cameras: Cameras) -> Float[Tensor, "frames 4 4"]:
    """Camera-to-world of training cameras after the model's refinement, scene units."""
    poses = torch.eye(4).repeat(len(cameras), 1, 1)
    poses[:, :3] = cameras.camera_to_worlds.cpu()
    assert cameras.metadata is not None
    frames = cameras.metadata[FRAME_INDEX][:, 0].long().to(model.device)
    return model.camera_optimizer.corrected(frames, poses.to(model.device))
