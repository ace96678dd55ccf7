"""Refinement of the measured poses during training.

A refinement corrects rays by the frame that they belong to. Held-out frames are corrected as well, so that evaluation
sees a view as training would have. The corrections are learned in some stages and frozen in the others.

The turntable refinement has the degrees of freedom of a camera before a turning object. With the object turning about
z, ``c2w_i = Rot(z, -angle_i) c2w_0``; the refined pose is ``Rot(z, -delta_i) c2w_i exp(twist)``, with one twist of
the camera (in its own axes) for all frames and one angle ``delta_i`` a frame. The poses are relative to the object,
so the twist covers errors of the axis as well: moving the camera before the axis and moving the axis before the
camera are the same. Where the table wobbles, each frame keeps its measured tilt.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.lie_groups import exp_map_SE3, exp_map_SO3xR3
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from hsi_sc_nerf.data.dataparser import CAMERA_ROTATION, FRAME_INDEX

_ANGLE_L2_PENALTY = 1e-2
"""Penalty on the frames' angle corrections (radians)."""


@dataclass
class PoseRefinementConfig(CameraOptimizerConfig):
    """Refinement of the measured poses during training."""

    _target: type = field(default_factory=lambda: PoseRefinement)
    mode: Literal["auto", "off", "turntable", "free-discarded"] = "auto"  # type: ignore[assignment]
    """Degrees of freedom. turntable: the camera before the axis, and the table's angle in each frame. free-discarded:
    a rotation and a shift of each frame, reset to zero after the first stage and never applied to held-out views, as
    in the paper's published code. off: none. auto: turntable if effects have pose_refinement, otherwise off."""

    def setup(self, refine: bool = False, **kwargs) -> PoseRefinement:
        """The refinement of the selected mode.

        Args:
            refine: whether mode "auto" refines.
            **kwargs: arguments of `PoseRefinement`.
        """
        mode = self.mode
        if mode == "auto":
            mode = "turntable" if refine else "off"
        kinds = {"turntable": TurntableRefinement, "free-discarded": DiscardedRefinement}
        # nerfstudio decides by the mode whether there are parameters.
        return kinds.get(mode, PoseRefinement)(replace(self, mode=mode), **kwargs)


class PoseRefinement(CameraOptimizer):
    """The measured poses as they are (mode off), and what all refinements have in common.

    Args:
        camera_to_world: pose of the first frame in scene units.
        frame_indices: position of each training camera's frame in the session, ascending.
        num_frames: frames of the session, held-out ones included.
        axis_origin: a point of the turntable's axis in scene units; the axis is parallel to z.
    """

    config: PoseRefinementConfig
    interpolation: Tensor

    def __init__(
        self,
        config: PoseRefinementConfig,
        camera_to_world: Float[np.ndarray, "4 4"],
        frame_indices: Int[np.ndarray, "train"],
        num_frames: int,
        axis_origin: Float[np.ndarray, "3"],
    ) -> None:
        # nerfstudio's own constructor refuses modes that it does not know.
        torch.nn.Module.__init__(self)
        self.config = config

    def corrections(
        self, frames: Int[Tensor, "*n"], rotations: Float[Tensor, "*n 3 3"], positions: Float[Tensor, "*n 3"]
    ) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
        """Rotations to multiply the cameras' from the left, and the cameras' corrected positions.

        Args:
            frames: frames that the cameras belong to.
            rotations: measured camera-to-world rotations.
            positions: measured positions, scene units.
        """
        return torch.eye(3).to(rotations).expand_as(rotations), positions

    def corrected(self, frames: Int[Tensor, "n"], camera_to_world: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4 4"]:
        """Refined poses of frames of the session, from their measured poses in scene units."""
        turns, positions = self.corrections(frames, camera_to_world[:, :3, :3], camera_to_world[:, :3, 3])
        refined = camera_to_world.clone()
        refined[:, :3, :3] = turns @ camera_to_world[:, :3, :3]
        refined[:, :3, 3] = positions
        return refined

    def apply_to_raybundle(self, raybundle: RayBundle) -> None:
        """Correct rays that carry a frame index; others (a viewer's) are not changed."""
        if self.config.mode == "off" or FRAME_INDEX not in raybundle.metadata:
            return
        frames = raybundle.metadata[FRAME_INDEX][..., 0].long()
        rotations = raybundle.metadata[CAMERA_ROTATION].reshape(*frames.shape, 3, 3)
        # In half precision, rays would move by tenths of a millimetre.
        with torch.autocast(raybundle.origins.device.type, enabled=False):
            turns, raybundle.origins = self.corrections(frames, rotations, raybundle.origins)
            raybundle.directions = torch.einsum("...ij,...j->...i", turns, raybundle.directions)

    def forward(self, indices: Int[Tensor, "n"]) -> Float[Tensor, "n 3 4"]:
        """Correction of the training cameras that nerfstudio's viewer draws: none, they are drawn as measured."""
        return torch.eye(4, device=indices.device)[:3].expand(len(indices), 3, 4)

    @property
    def frozen(self) -> bool:
        """Whether no correction is being learned."""
        return not any(parameter.requires_grad for parameter in self.parameters())

    def freeze(self, frozen: bool) -> None:
        """Stop or resume learning; what was learned stays in force."""
        self.requires_grad_(not frozen)

    def get_loss_dict(self, loss_dict: dict) -> None:
        """Add the penalty on the corrections while they are learned."""
        if not self.frozen:
            super().get_loss_dict(loss_dict)


class TurntableRefinement(PoseRefinement):
    """One twist of the camera for all views, and one angle a frame; held-out frames interpolate their neighbours'."""

    twist_basis: Tensor
    axis_origin: Tensor

    def __init__(self, config: PoseRefinementConfig, **turntable) -> None:
        super().__init__(config, **turntable)
        axis_origin = np.asarray(turntable["axis_origin"])
        centred = np.array(turntable["camera_to_world"], dtype=np.float64)
        centred[:3, 3] -= axis_origin
        buffers = {
            "twist_basis": visible_twists(centred),
            "interpolation": held_out_interpolation(turntable["frame_indices"], turntable["num_frames"]),
            "axis_origin": axis_origin,
        }
        for name, value in buffers.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32))
        self.camera_twist = torch.nn.Parameter(torch.zeros(3))
        self.frame_angles = torch.nn.Parameter(torch.zeros(len(turntable["frame_indices"])))

    def angle_corrections(self) -> Float[Tensor, "num_frames"]:
        """Correction of every frame's angle, radians; the mean over the training frames is zero."""
        return self.interpolation @ (self.frame_angles - self.frame_angles.mean())

    def twist(self) -> Float[Tensor, "6"]:
        """The correction of the camera in its own axes: translation (scene units), rotation (radians)."""
        return self.twist_basis @ self.camera_twist

    def corrections(
        self, frames: Int[Tensor, "*n"], rotations: Float[Tensor, "*n 3 3"], positions: Float[Tensor, "*n 3"]
    ) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
        """The camera's twist in the scene's axes, R delta R^T, then each frame's angle about the axis."""
        twist = exp_map_SE3(self.twist()[None])[0]
        about_axis = _rotations_about_z(-self.angle_corrections())[frames]
        turns = about_axis @ rotations @ twist[:, :3] @ rotations.transpose(-1, -2)
        from_axis = positions + rotations @ twist[:, 3] - self.axis_origin
        return turns, torch.einsum("...ij,...j->...i", about_axis, from_axis) + self.axis_origin

    def get_loss_dict(self, loss_dict: dict) -> None:
        """Squared lengths of the shift (scene units) and turn (radians), and mean square of the angles."""
        if not self.frozen:
            shift, turn = self.twist().split(3)
            loss_dict["camera_opt_regularizer"] = (
                shift.square().sum() * self.config.trans_l2_penalty
                + turn.square().sum() * self.config.rot_l2_penalty
                + self.frame_angles.square().mean() * _ANGLE_L2_PENALTY
            )

    def get_metrics_dict(self, metrics_dict: dict) -> None:
        """Add the size of the corrections, for the logs."""
        shift, turn = self.twist().detach().split(3)
        metrics_dict["camera_opt_translation"] = shift.norm()
        metrics_dict["camera_opt_rotation_deg"] = torch.rad2deg(turn.norm())
        metrics_dict["camera_opt_angle_max_deg"] = torch.rad2deg(self.angle_corrections().detach().abs().max())


class DiscardedRefinement(PoseRefinement):
    """The paper's published code: nerfstudio's ``SO3xR3`` of the training views, reset when it is frozen."""

    def __init__(self, config: PoseRefinementConfig, **turntable) -> None:
        super().__init__(config, **turntable)
        of_training = torch.eye(turntable["num_frames"])[:, turntable["frame_indices"]]
        self.register_buffer("interpolation", of_training)
        self.pose_adjustment = torch.nn.Parameter(torch.zeros(of_training.shape[1], 6))

    def corrections(
        self, frames: Int[Tensor, "*n"], rotations: Float[Tensor, "*n 3 3"], positions: Float[Tensor, "*n 3"]
    ) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
        """Each training frame's own rotation in the scene's axes, and its shifted position."""
        matrices = exp_map_SO3xR3(self.interpolation @ self.pose_adjustment)[frames]
        return matrices[..., :3], positions + matrices[..., 3]

    def freeze(self, frozen: bool) -> None:
        """Stop or resume learning; stopping resets the corrections."""
        super().freeze(frozen)
        if frozen:
            torch.nn.init.zeros_(self.pose_adjustment)

    def get_metrics_dict(self, metrics_dict: dict) -> None:
        """Mean sizes of the corrections, for the logs; nerfstudio's would wait for the GPU."""
        shifts, turns = self.pose_adjustment.detach().split(3, dim=1)
        metrics_dict["camera_opt_translation"] = shifts.norm(dim=-1).mean()
        metrics_dict["camera_opt_rotation"] = turns.norm(dim=-1).mean()


def held_out_interpolation(
    frame_indices: Int[np.ndarray, "train"], num_frames: int
) -> Float[np.ndarray, "num_frames train"]:
    """Matrix that interpolates the training frames' corrections linearly to all frames."""
    return np.stack(
        [np.interp(np.arange(num_frames), frame_indices, column) for column in np.eye(len(frame_indices))], axis=1
    )


def visible_twists(camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 3"]:
    """Orthonormal basis of the camera twists that change the images of a turning object of unknown shape.

    Twists are (translation, rotation) in the camera's axes, applied on the right of ``camera_to_world``, whose origin
    is on the turntable's axis. A rotation about the axis and a shift along it only move the object frame, and a
    camera further from the axis sees the same images of a larger object. These three are projected out, so that frame
    and scale stay as measured; a common angle of all frames is excluded by `TurntableRefinement.angle_corrections`.
    """
    rotation, position = camera_to_world[:3, :3], camera_to_world[:3, 3]
    z = np.array([0.0, 0.0, 1.0])
    # Adjoint of the inverse pose: a world twist (v, w) moves the camera like (R^T (v + w x p), R^T w).
    turn = np.concatenate([rotation.T @ np.cross(z, position), rotation.T @ z])
    shift = np.concatenate([rotation.T @ z, np.zeros(3)])
    scale = np.concatenate([rotation.T @ position, np.zeros(3)])
    invisible, _ = np.linalg.qr(np.stack([turn, shift, scale], axis=1))
    left, _, _ = np.linalg.svd(np.eye(6) - invisible @ invisible.T)
    return left[:, :3]


def _rotations_about_z(angles: Float[Tensor, "n"]) -> Float[Tensor, "n 3 3"]:
    cos, sin = torch.cos(angles), torch.sin(angles)
    zero, one = torch.zeros_like(angles), torch.ones_like(angles)
    return torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1).reshape(-1, 3, 3)
