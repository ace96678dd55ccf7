"""Pose refinement that moves what can really move: the one camera, and the turntable's angle in each frame.

With the object turning about z, ``c2w_i = Rot(z, -angle_i) c2w_0``. A free correction of every view (nerfacto's
SO3xR3) knows nothing of that, and leaves held-out views behind. Here all views share one correction of the camera,
``c2w_i <- Rot(z, -delta_i) c2w_i exp(twist)``, and each frame adds one angle; held-out frames take their
neighbours' angle, so that what is learned applies to them as well.

A rotation of the camera about the axis, a shift along it and a common angle only move the object frame: those
directions are projected out, and the frame stays where the markers put it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.lie_groups import exp_map_SE3
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

FRAME_INDEX = "frame_index"
"""Camera metadata: which frame of the session a ray belongs to."""
CAMERA_ROTATION = "camera_rotation"
"""Camera metadata: the nine elements of the camera-to-world rotation of a ray, row by row."""


def gauge_free_basis(camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 4"]:
    """Orthonormal basis of the camera twists that are not a mere change of the object frame.

    Twists are (translation, rotation) in the camera's frame, applied on the right of ``camera_to_world``. Removed
    are the twists that equal a rotation about z or a shift along z, applied on the left.
    """
    rotation, position = camera_to_world[:3, :3], camera_to_world[:3, 3]
    z = np.array([0.0, 0.0, 1.0])
    # Adjoint of the inverse pose: a world twist (v, w) moves the camera like (R^T (v + w x p), R^T w).
    turn = np.concatenate([rotation.T @ np.cross(z, position), rotation.T @ z])
    shift = np.concatenate([rotation.T @ z, np.zeros(3)])
    gauge, _ = np.linalg.qr(np.stack([turn, shift], axis=1))
    left, _, _ = np.linalg.svd(np.eye(6) - gauge @ gauge.T)
    return left[:, :4]


def held_out_interpolation(
    frame_indices: Int[np.ndarray, "train"], num_frames: int
) -> Float[np.ndarray, "num_frames train"]:
    """Matrix that carries the training frames' angles to all frames, linearly between neighbours."""
    return np.stack(
        [np.interp(np.arange(num_frames), frame_indices, column) for column in np.eye(len(frame_indices))], axis=1
    )


@dataclass
class TurntableRefinementConfig(CameraOptimizerConfig):
    """Refinement of the shared camera pose and each frame's angle."""

    _target: type = field(default_factory=lambda: TurntableRefinement)
    mode: Literal["off", "turntable"] = "turntable"  # type: ignore[assignment]
    """Whether to refine the measured poses."""
    angle_l2_penalty: float = 1e-2
    """Penalty on the frames' angle corrections (radians)."""


class TurntableRefinement(CameraOptimizer):
    """Camera optimiser with a shared camera twist and one angle a frame.

    Args:
        config: the configuration.
        num_cameras: number of training cameras.
        device: where the parameters live.
        camera_to_world: pose of any one camera in scene units, (4, 4): it defines the gauge.
        frame_indices: position of each training camera's frame in the session, ascending.
        num_frames: frames of the session, held-out ones included.
        axis_origin: a point of the turntable's axis in scene units; the axis is parallel to z.
    """

    config: TurntableRefinementConfig
    gauge_basis: Tensor
    interpolation: Tensor
    axis_origin: Tensor

    def __init__(
        self,
        config: TurntableRefinementConfig,
        num_cameras: int,
        device: torch.device | str,
        camera_to_world: Float[np.ndarray, "4 4"],
        frame_indices: Int[np.ndarray, "train"],
        num_frames: int,
        axis_origin: Float[np.ndarray, "3"],
        **kwargs,
    ) -> None:
        torch.nn.Module.__init__(self)
        self.config = config
        self.num_cameras = num_cameras
        self.device = device
        self.frozen = False
        if config.mode == "off":
            return
        centred = np.array(camera_to_world, dtype=np.float64)
        centred[:3, 3] -= axis_origin
        as_buffer = {
            "gauge_basis": gauge_free_basis(centred),
            "interpolation": held_out_interpolation(frame_indices, num_frames),
            "axis_origin": np.asarray(axis_origin),
        }
        for name, value in as_buffer.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32))
        self.camera_twist = torch.nn.Parameter(torch.zeros(4))
        self.frame_angles = torch.nn.Parameter(torch.zeros(num_cameras))

    def angle_corrections(self) -> Float[Tensor, "num_frames"]:
        """Correction of every frame's angle, held-out ones included, radians; their mean over training is zero."""
        return self.interpolation @ (self.frame_angles - self.frame_angles.mean())

    def camera_correction(self) -> Float[Tensor, "3 4"]:
        """The shared correction, applied on the right of every camera-to-world pose."""
        return exp_map_SE3((self.gauge_basis @ self.camera_twist)[None])[0]

    def apply_to_raybundle(self, raybundle: RayBundle) -> None:
        """Correct the rays that carry a frame index; others (a viewer's) pass as they are."""
        if self.config.mode == "off" or FRAME_INDEX not in raybundle.metadata:
            return
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            frames = raybundle.metadata[FRAME_INDEX][..., 0].long()
            cos, sin = (f(self.angle_corrections())[frames] for f in (torch.cos, torch.sin))
            correction = self.camera_correction()
            # The camera's correction in the scene's axes: R delta R^T, with R the camera's own rotation.
            rotation = raybundle.metadata[CAMERA_ROTATION].reshape(*frames.shape, 3, 3)
            in_camera = torch.einsum("...ji,...j->...i", rotation, raybundle.directions)
            turned = torch.einsum("...ij,jk,...k->...i", rotation, correction[:, :3], in_camera)
            moved = raybundle.origins + rotation @ correction[:, 3]
            raybundle.directions = _turn_back(turned, cos, sin)
            raybundle.origins = _turn_back(moved - self.axis_origin, cos, sin) + self.axis_origin

    def get_loss_dict(self, loss_dict: dict) -> None:
        """Penalties that hold the corrections near zero."""
        if self.config.mode == "off" or self.frozen:
            return
        twist = self.gauge_basis @ self.camera_twist
        loss_dict["camera_opt_regularizer"] = (
            twist[:3].square().sum() * self.config.trans_l2_penalty
            + twist[3:].square().sum() * self.config.rot_l2_penalty
            + self.frame_angles.square().mean() * self.config.angle_l2_penalty
        )

    def get_metrics_dict(self, metrics_dict: dict) -> None:
        """Size of the corrections, for the logs."""
        if self.config.mode == "off":
            return
        twist = (self.gauge_basis @ self.camera_twist).detach()
        metrics_dict["camera_opt_translation"] = twist[:3].norm()
        metrics_dict["camera_opt_rotation_deg"] = torch.rad2deg(twist[3:].norm())
        metrics_dict["camera_opt_angle_max_deg"] = torch.rad2deg(self.angle_corrections().detach().abs().max())


def _turn_back(
    vectors: Float[Tensor, "*n 3"], cos: Float[Tensor, "*n"], sin: Float[Tensor, "*n"]
) -> Float[Tensor, "*n 3"]:
    """Rotate vectors by minus the angle about z."""
    x, y, z = vectors.unbind(-1)
    return torch.stack([cos * x + sin * y, cos * y - sin * x, z], dim=-1)
