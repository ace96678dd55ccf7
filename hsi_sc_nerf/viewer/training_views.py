"""The training views as the viewer meets them: where their cameras stand, and what they measured along a ray."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hsi_sc_nerf.data.datamanager import SpectralDataset
from hsi_sc_nerf.evaluation.spectral_metrics import spectral_angle_map
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.geometry.ray_projection import image_coordinates, in_camera_frame
from hsi_sc_nerf.packed.cube import unpack

SAME_PLACE = 1e-4
"""A camera this near to a view's (scene units, of which the scene box has two) sees what the view sees."""


class TrainingViews:
    """The frames that a run is trained on, with the poses that were measured.

    Who looks from where a view's camera stands sees the view's rays, whichever way and however wide he looks.
    """

    def __init__(self, dataset: SpectralDataset) -> None:
        self.dataset = dataset
        cameras = dataset.cameras.to("cpu")
        self.rotations: Float[Tensor, "views 3 3"] = cameras.camera_to_worlds[:, :, :3]
        self.centres: Float[Tensor, "views 3"] = cameras.camera_to_worlds[:, :, 3]

    def at(self, place: Float[Tensor, "3"]) -> int | None:
        """The view whose camera stands at a place, in scene units; None for none."""
        distances = (self.centres - place.to(self.centres)).norm(dim=-1)
        view = int(distances.argmin())
        return view if distances[view] <= SAME_PLACE else None

    def name(self, view: int) -> str:
        """The capture that a view was made from."""
        return self.dataset.frames[view].capture

    def metadata(self, view: int, device: torch.device | str) -> dict[str, Float[Tensor, "1 ..."]]:
        """What tells the model that rays are this view's."""
        metadata = self.dataset.cameras[view : view + 1].metadata
        assert metadata is not None
        return {name: values.to(device) for name, values in metadata.items()}

    def distance(self, view: int) -> float:
        """How far before a view's camera the object's middle lies, scene units."""
        to_object = self.dataset.metadata["object_box"].mean(dim=0) - self.centres[view]
        return float(-to_object @ self.rotations[view][:, 2])

    def vertical_fov(self, view: int, aspect: float) -> float:
        """Vertical field of view (radians) of a window, ``aspect`` times as wide as high, that shows a whole view."""
        lens, _ = self._lens(view)
        half_height = max(lens.h / 2.0 / lens.fl_y, lens.w / 2.0 / lens.fl_x / aspect)
        return 2.0 * float(np.arctan(half_height))

    def measured(
        self, view: int, directions: Float[Tensor, "*rays 3"]
    ) -> tuple[Float[Tensor, "n bands"], Bool[Tensor, "n bands"], Bool[Tensor, "*rays"]]:
        """What a view measured along rays from its camera's centre.

        Args:
            view: which.
            directions: of the rays, in the scene.

        Returns:
            Reflectance of the nearest pixels, which of its values are measurements, and which rays the view saw: the
            first two are theirs, in order.
        """
        pixels, seen = frame_pixels(directions.cpu(), self.rotations[view], *self._lens(view))
        lines, samples = pixels[seen].numpy().T
        reflectance, valid = unpack(self.dataset.frames[view].cube()[lines, samples])
        device = directions.device
        return torch.from_numpy(reflectance).to(device), torch.from_numpy(valid).to(device), seen.to(device)

    def _lens(self, view: int) -> tuple[PinholeIntrinsics, tuple[float, float, float, float]]:
        camera = self.dataset.cameras[view]
        lens = PinholeIntrinsics(
            int(camera.width), int(camera.height), *(float(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy))
        )
        if camera.distortion_params is None:
            return lens, (0.0, 0.0, 0.0, 0.0)
        k1, k2, _, _, p1, p2 = camera.distortion_params.flatten().tolist()
        return lens, (k1, k2, p1, p2)


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
        intrinsics: of the frame.
        distortion: k1, k2, p1, p2 (OpenCV).
    """
    turned = in_camera_frame(directions, rotation.reshape(9).expand(*directions.shape[:-1], 9))
    places, forward = image_coordinates(turned, intrinsics, distortion)
    pixels = places.flip(-1).floor().long()
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
