"""Pose refinement that moves what can really move: the camera before the axis, and the table's angle in each frame.

With the object turning about z, ``c2w_i = Rot(z, -angle_i) c2w_0``. A free correction of every view (nerfacto's
SO3xR3) knows nothing of that. Here all views share one correction of the camera in its own axes, and each frame adds
one angle, ``c2w_i <- Rot(z, -delta_i) c2w_i exp(twist)``; held-out frames take their neighbours' angle, so that what
is learned applies to them as well.

The poses are relative to the object, so a camera moved before a given axis and an axis moved before a given camera
are the same: the twist covers the axis' direction and place. The formula holds for any ``c2w_i``; where the table
wobbles, each frame keeps the pose it was measured at, the twist stays what all frames share, and the angle is a turn
of the object about its own z.

Four directions change no image: a rotation of the camera about the axis, a shift along it and a common angle only
move the object frame, and a camera further from the axis sees the same of a larger object. They are projected out:
the frame and the scale stay where the measured poses put them.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.lie_groups import exp_map_SE3
from torch import Tensor

from hsi_sc_nerf.models.pose_refinement import PoseRefinement, PoseRefinementConfig, held_out_interpolation


def visible_twists(camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 3"]:
    """Orthonormal basis of the camera twists that change the images of a turning object of unknown shape.

    Twists are (translation, rotation) in the camera's axes, applied on the right of ``camera_to_world``, whose origin
    is on the turntable's axis. Left out are the twists that equal a rotation about z or a shift along z, applied on
    the left, and the one that moves the camera away from the origin.
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


class TurntableRefinement(PoseRefinement):
    """A camera twist that all views share, and one angle a frame."""

    twist_basis: Tensor
    interpolation: Tensor
    axis_origin: Tensor

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
        super().__init__(config, num_cameras, device, camera_to_world, frame_indices, num_frames, axis_origin)
        centred = np.array(camera_to_world, dtype=np.float64)
        centred[:3, 3] -= axis_origin
        as_buffer = {
            "twist_basis": visible_twists(centred),
            "interpolation": held_out_interpolation(frame_indices, num_frames),
            "axis_origin": np.asarray(axis_origin),
        }
        for name, value in as_buffer.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32))
        self.camera_twist = torch.nn.Parameter(torch.zeros(3))
        self.frame_angles = torch.nn.Parameter(torch.zeros(num_cameras))

    def angle_corrections(self) -> Float[Tensor, "num_frames"]:
        """Correction of every frame's angle, held-out ones included, radians; their mean over training is zero."""
        return self.interpolation @ (self.frame_angles - self.frame_angles.mean())

    def twist(self) -> Float[Tensor, "6"]:
        """The shared correction of the camera, in its own axes: translation (scene units), rotation (radians)."""
        return self.twist_basis @ self.camera_twist

    def corrections(
        self,
        frames: Int[Tensor, "*n"],
        rotations: Float[Tensor, "*n 3 3"],
        positions: Float[Tensor, "*n 3"],
    ) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
        """The shared twist in the scene's axes, R delta R^T, then each frame's angle about the axis."""
        shared = exp_map_SE3(self.twist()[None])[0]
        back = _rotations_about_z(-self.angle_corrections())[frames]
        turns = back @ rotations @ shared[:, :3] @ rotations.transpose(-1, -2)
        from_axis = positions + rotations @ shared[:, 3] - self.axis_origin
        return turns, torch.einsum("...ij,...j->...i", back, from_axis) + self.axis_origin

    def penalty(self) -> Float[Tensor, ""]:
        """Squared length of the shared twist, and the mean square of the angles."""
        shift, turn = self.twist().split(3)
        return (
            shift.square().sum() * self.config.trans_l2_penalty
            + turn.square().sum() * self.config.rot_l2_penalty
            + self.frame_angles.square().mean() * self.config.angle_l2_penalty
        )

    def get_metrics_dict(self, metrics_dict: dict) -> None:
        """Size of the corrections, for the logs."""
        shift, turn = self.twist().detach().split(3)
        metrics_dict["camera_opt_translation"] = shift.norm()
        metrics_dict["camera_opt_rotation_deg"] = torch.rad2deg(turn.norm())
        metrics_dict["camera_opt_angle_max_deg"] = torch.rad2deg(self.angle_corrections().detach().abs().max())


def _rotations_about_z(angles: Float[Tensor, "n"]) -> Float[Tensor, "n 3 3"]:
    cos, sin = torch.cos(angles), torch.sin(angles)
    zero, one = torch.zeros_like(angles), torch.ones_like(angles)
    return torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1).reshape(-1, 3, 3)
