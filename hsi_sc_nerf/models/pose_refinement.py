"""Refinement of the measured poses during training: the modes to choose from, and what they have in common.

A refinement corrects rays by the frame that they belong to, whether it is a training or a held-out one, so that
evaluation sees a view as training would have. It is learned in the stages that say so and frozen in the others.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from hsi_sc_nerf.data.cameras import CAMERA_ROTATION, FRAME_INDEX


@dataclass
class PoseRefinementConfig(CameraOptimizerConfig):
    """Refinement of the measured poses during training."""

    _target: type = field(default_factory=lambda: PoseRefinement)
    mode: Literal["off", "turntable", "free", "free-discarded"] = "turntable"  # type: ignore[assignment]
    """What may move. turntable: the one camera before the axis, and the table's angle in each frame. free: every
    frame by itself, in six directions. free-discarded: the same, but thrown away at the end of the first stage and
    never used for held-out views, as the paper's published code does. off: nothing."""
    angle_l2_penalty: float = 1e-2
    """Penalty on the frames' angle corrections (radians), in mode turntable."""

    def setup(self, **kwargs) -> PoseRefinement:
        """The refinement of the chosen mode; ``kwargs`` are `PoseRefinement`'s."""
        # These modules derive from the class below.
        from hsi_sc_nerf.models.free_refinement import DiscardedRefinement, FreeRefinement
        from hsi_sc_nerf.models.turntable_refinement import TurntableRefinement

        refinement: type[PoseRefinement] = {
            "off": NoRefinement,
            "turntable": TurntableRefinement,
            "free": FreeRefinement,
            "free-discarded": DiscardedRefinement,
        }[self.mode]
        return refinement(self, **kwargs)


class PoseRefinement(CameraOptimizer):
    """A camera optimiser that corrects all views of a session, held-out ones included.

    Args:
        config: the configuration.
        num_cameras: number of training cameras.
        device: where the parameters live.
        camera_to_world: pose of the first frame in scene units, (4, 4).
        frame_indices: position of each training camera's frame in the session, ascending.
        num_frames: frames of the session, held-out ones included.
        axis_origin: a point of the turntable's axis in scene units; the axis is parallel to z.
    """

    config: PoseRefinementConfig

    def __init__(
        self,
        config: PoseRefinementConfig,
        num_cameras: int,
        device: torch.device | str,
        camera_to_world: Float[np.ndarray, "4 4"],
        frame_indices: Int[np.ndarray, "train"],
        num_frames: int,
        axis_origin: Float[np.ndarray, "3"],
    ) -> None:
        # nerfstudio's own constructor knows its own modes only.
        torch.nn.Module.__init__(self)
        self.config = config
        self.num_cameras = num_cameras
        self.device = device

    def corrections(
        self,
        frames: Int[Tensor, "*n"],
        rotations: Float[Tensor, "*n 3 3"],
        positions: Float[Tensor, "*n 3"],
    ) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
        """How cameras move: rotations to put on the left of theirs, and their new positions.

        Args:
            frames: the frames that they belong to.
            rotations: their measured camera-to-world rotations.
            positions: their measured positions, scene units.
        """
        raise NotImplementedError

    def corrected(self, frames: Int[Tensor, "n"], camera_to_world: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4 4"]:
        """The refined poses of frames of the session, from their measured ones in scene units."""
        turns, positions = self.corrections(frames, camera_to_world[:, :3, :3], camera_to_world[:, :3, 3])
        refined = camera_to_world.clone()
        refined[:, :3, :3] = turns @ camera_to_world[:, :3, :3]
        refined[:, :3, 3] = positions
        return refined

    def apply_to_raybundle(self, raybundle: RayBundle) -> None:
        """Correct the rays that carry a frame index; others (a viewer's) pass as they are."""
        if FRAME_INDEX not in raybundle.metadata:
            return
        frames = raybundle.metadata[FRAME_INDEX][..., 0].long()
        rotations = raybundle.metadata[CAMERA_ROTATION].reshape(*frames.shape, 3, 3)
        # Half precision would move the rays by tenths of a millimetre.
        with torch.autocast(raybundle.origins.device.type, enabled=False):
            turns, raybundle.origins = self.corrections(frames, rotations, raybundle.origins)
            raybundle.directions = torch.einsum("...ij,...j->...i", turns, raybundle.directions)

    def forward(self, indices: Int[Tensor, "n"]) -> Float[Tensor, "n 3 4"]:
        """What nerfstudio's viewer moves the training cameras by that it draws: nothing, they stay as measured."""
        return torch.eye(4, device=indices.device)[:3].expand(len(indices), 3, 4)

    @property
    def frozen(self) -> bool:
        """Whether nothing is being learned."""
        return not any(parameter.requires_grad for parameter in self.parameters())

    def freeze(self, frozen: bool) -> None:
        """Stop or go on learning, at the start of a stage; what was learned stays in force."""
        self.requires_grad_(not frozen)

    def get_loss_dict(self, loss_dict: dict) -> None:
        """Penalties that hold the corrections near zero while they are learned."""
        if not self.frozen:
            loss_dict["camera_opt_regularizer"] = self.penalty()

    def penalty(self) -> Float[Tensor, ""]:
        """How far the corrections are from zero, weighted as the configuration says."""
        raise NotImplementedError


class NoRefinement(PoseRefinement):
    """The measured poses as they are: no parameters, and rays pass untouched."""

    def corrections(
        self,
        frames: Int[Tensor, "*n"],
        rotations: Float[Tensor, "*n 3 3"],
        positions: Float[Tensor, "*n 3"],
    ) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
        """No turn, and the measured positions."""
        return torch.eye(3).to(rotations).expand_as(rotations), positions

    def apply_to_raybundle(self, raybundle: RayBundle) -> None:
        """Nothing to correct."""


def held_out_interpolation(
    frame_indices: Int[np.ndarray, "train"], num_frames: int
) -> Float[np.ndarray, "num_frames train"]:
    """Matrix that carries the training frames' corrections to all frames, linearly between neighbours."""
    return np.stack(
        [np.interp(np.arange(num_frames), frame_indices, column) for column in np.eye(len(frame_indices))], axis=1
    )
