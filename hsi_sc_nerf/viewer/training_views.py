"""The training views in the viewer: positions of their cameras and measured spectra along rays."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hsi_sc_nerf.data.datamanager import SpectralDataset
from hsi_sc_nerf.evaluation.spectral_metrics import spectral_angle_map
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, image_coordinates, in_camera_frame
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import PackedDataset

SAME_POSITION = 1e-4
"""Largest distance (scene units) at which the viewer's camera counts as that of a view."""


class TrainingViews:
    """The training frames of a run with their measured poses.

    A camera at the position of a view has the rays of that view, whatever its orientation and field of view.
    """

    def __init__(self, dataset: SpectralDataset) -> None:
        self.dataset = dataset
        self._packed: PackedDataset = dataset.metadata["dataset"]
        cameras = dataset.cameras.to("cpu")
        self.rotations: Float[Tensor, "views 3 3"] = cameras.camera_to_worlds[:, :, :3]
        self.centres: Float[Tensor, "views 3"] = cameras.camera_to_worlds[:, :, 3]

    def at(self, position: Float[Tensor, "3"]) -> int | None:
        """The view whose camera is at a position (scene units); None if there is none."""
        distances = (self.centres - position.to(self.centres)).norm(dim=-1)
        view = int(distances.argmin())
        return view if distances[view] <= SAME_POSITION else None

    def metadata(self, view: int, device: torch.device | str) -> dict[str, Float[Tensor, "1 ..."]]:
        """Metadata that assign rays to this view in the model."""
        metadata = self.dataset.cameras[view : view + 1].metadata
        assert metadata is not None
        return {name: values.to(device) for name, values in metadata.items()}

    def distance(self, view: int) -> float:
        """Depth of the object's centre in front of a view's camera, scene units."""
        to_object = self.dataset.metadata["object_box"].mean(dim=0) - self.centres[view]
        return float(-to_object @ self.rotations[view][:, 2])

    def vertical_fov(self, aspect: float) -> float:
        """Vertical field of view (radians) of a window of the aspect ratio width / height that contains a view."""
        lens = self._packed.intrinsics
        half_height = max(lens.h / 2.0 / lens.fl_y, lens.w / 2.0 / lens.fl_x / aspect)
        return 2.0 * float(np.arctan(half_height))

    def measured(
        self, view: int, directions: Float[Tensor, "*rays 3"]
    ) -> tuple[Float[Tensor, "n bands"], Bool[Tensor, "n bands"], Bool[Tensor, "*rays"]]:
        """Measured spectra of a view along rays from its camera's centre.

        Returns:
            Reflectance of the nearest pixels of the rays within the view, which of its values are valid, and which of
            the rays are within the view.
        """
        packed = self._packed
        distortion = tuple(packed.distortion.tolist())
        pixels, seen = frame_pixels(directions.cpu(), self.rotations[view], packed.intrinsics, distortion)
        lines, samples = pixels[seen].numpy().T
        reflectance, valid = unpack(self.dataset.frames[view].cube()[lines, samples])
        device = directions.device
        return torch.from_numpy(reflectance).to(device), torch.from_numpy(valid).to(device), seen.to(device)


def frame_pixels(
    directions: Float[Tensor, "*rays 3"],
    rotation: Float[Tensor, "3 3"],
    intrinsics: PinholeIntrinsics,
    distortion: tuple[float, float, float, float],
) -> tuple[Int[Tensor, "*rays 2"], Bool[Tensor, "*rays"]]:
    """The pixels (line, sample) of a frame that rays from its camera's centre pass through, and which rays do.

    Args:
        directions: in the world.
        rotation: the frame's camera-to-world rotation, OpenGL axes.
        intrinsics: intrinsics of the frame.
        distortion: k1, k2, p1, p2 (OpenCV).
    """
    turned = in_camera_frame(directions, rotation.reshape(9).expand(*directions.shape[:-1], 9))
    points_px, forward = image_coordinates(turned, intrinsics, distortion)
    pixels = points_px.flip(-1).floor().long()
    size = pixels.new_tensor([intrinsics.h, intrinsics.w])
    return pixels, forward & ((pixels >= 0) & (pixels < size)).all(dim=-1)


def angle_to_measured(
    rendered: Float[Tensor, "h w bands"],
    measured: Float[Tensor, "n bands"],
    valid: Bool[Tensor, "n bands"],
    seen: Bool[Tensor, "h w"],
) -> Float[Tensor, "h w"]:
    """Spectral angle (radians) between a rendering and what was measured of the ``seen`` pixels, in their order.

    NaN elsewhere, and where too few bands are valid.
    """
    angles = torch.full(seen.shape, torch.nan, dtype=torch.float32, device=rendered.device)
    angles[seen] = spectral_angle_map(rendered[seen][:, None], measured[:, None], valid[:, None])[:, 0]
    return angles
