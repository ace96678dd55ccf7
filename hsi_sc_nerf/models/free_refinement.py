"""Pose refinement that knows nothing of a turntable: six numbers a view, as nerfstudio's SO3xR3 camera optimiser.

Kept beside the turntable's for comparison, and for a table that does not turn about one axis at all.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.lie_groups import exp_map_SO3xR3
from torch import Tensor

from hsi_sc_nerf.models.pose_refinement import PoseRefinement, PoseRefinementConfig, held_out_interpolation


class FreeRefinement(PoseRefinement):
    """Each training view has a shift and a turn of its own, in the scene's axes, as in nerfstudio's ``SO3xR3``.

    Held-out views take the mean of their neighbours' six numbers, weighted by how near these are in the session.
    """

    spread: Tensor

    def __init__(
        self,
        config: PoseRefinementConfig,
        num_cameras: int,
        device: torch.device | str,
        frame_indices: Int[np.ndarray, "train"],
        num_frames: int,
        **turntable,
    ) -> None:
        super().__init__(config, num_cameras, device, frame_indices=frame_indices, num_frames=num_frames, **turntable)
        self.register_buffer("spread", torch.from_numpy(self._spread(frame_indices, num_frames)).float())
        self.pose_adjustment = torch.nn.Parameter(torch.zeros(num_cameras, 6))

    def _spread(
        self, frame_indices: Int[np.ndarray, "train"], num_frames: int
    ) -> Float[np.ndarray, "num_frames train"]:
        return held_out_interpolation(frame_indices, num_frames)

    def corrections(
        self,
        frames: Int[Tensor, "*n"],
        rotations: Float[Tensor, "*n 3 3"],
        positions: Float[Tensor, "*n 3"],
    ) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
        """Each frame's own turn, and its position shifted."""
        matrices = exp_map_SO3xR3(self.spread @ self.pose_adjustment)[frames]
        return matrices[..., :3], positions + matrices[..., 3]

    def get_metrics_dict(self, metrics_dict: dict) -> None:
        """Mean sizes of the corrections, for the logs; nerfstudio fetches them from the device each step."""
        shifts, turns = self.pose_adjustment.detach().split(3, dim=1)
        metrics_dict["camera_opt_translation"] = shifts.norm(dim=-1).mean()
        metrics_dict["camera_opt_rotation"] = turns.norm(dim=-1).mean()

    def penalty(self) -> Float[Tensor, ""]:
        """nerfstudio's: mean lengths of the shifts (scene units) and turns (radians)."""
        shifts, turns = self.pose_adjustment.split(3, dim=1)
        return (
            shifts.norm(dim=-1).mean() * self.config.trans_l2_penalty
            + turns.norm(dim=-1).mean() * self.config.rot_l2_penalty
        )


class DiscardedRefinement(FreeRefinement):
    """What the paper's published code does, for comparison.

    The corrections serve training views only and are lost when the next stage takes over without them: the field
    was learned with poses that nobody has any more.
    """

    def _spread(
        self, frame_indices: Int[np.ndarray, "train"], num_frames: int
    ) -> Float[np.ndarray, "num_frames train"]:
        return np.eye(num_frames)[:, frame_indices]

    def freeze(self, frozen: bool) -> None:
        """Stop or go on learning; stopping throws away what was learned."""
        super().freeze(frozen)
        if frozen:
            torch.nn.init.zeros_(self.pose_adjustment)
