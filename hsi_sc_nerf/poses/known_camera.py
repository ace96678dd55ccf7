"""What is known before any image is looked at: the camera of an earlier session, and the turntable's angles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, turntable_camera_to_world
from hsi_sc_nerf.poses.result import TurntablePoses


@dataclass(frozen=True, eq=False)
class KnownCamera:
    """A camera before its turntable, calibrated by an earlier session."""

    intrinsics: PinholeIntrinsics
    distortion: tuple[float, float, float, float]
    camera_to_world: Float[np.ndarray, "4 4"]
    """Pose at the angle 0, object frame, metres."""
    direction: Literal["ccw", "cw"] | None = None
    """The turntable's turn seen from above; None where the earlier session does not tell."""

    @property
    def distance_m(self) -> float:
        """From the turntable's axis."""
        return float(np.hypot(self.camera_to_world[0, 3], self.camera_to_world[1, 3]))

    def check_size(self, size_px: tuple[int, int]) -> None:
        """Refuse images of another width and height.

        Raises:
            InputError: they differ.
        """
        if size_px != (self.intrinsics.w, self.intrinsics.h):
            raise InputError(
                f"the images have {size_px[0]} x {size_px[1]} pixels, but the camera of the earlier session had "
                f"{self.intrinsics.w} x {self.intrinsics.h}; give a session of the same camera"
            )


def known_angles_deg(info: SessionInfo, frames: int) -> Float[np.ndarray, "n"] | None:
    """The frames' angles by ``session.json``, relative to the first; positive where the direction is not known.

    Raises:
        InputError: not one angle per frame.
    """
    sign = -1.0 if info.direction == "cw" else 1.0
    if info.frame_angles_deg is not None:
        if len(info.frame_angles_deg) != frames:
            raise InputError(
                f"{len(info.frame_angles_deg)} frame angles are given for {frames} frames; give one per frame"
            )
        return sign * (np.array(info.frame_angles_deg) - info.frame_angles_deg[0])
    return None if info.nominal_step_deg is None else sign * info.nominal_step_deg * np.arange(frames)


def poses_from_known_camera(
    names: Sequence[str], size_px: tuple[int, int], info: SessionInfo, camera: KnownCamera
) -> TurntablePoses:
    """Poses of a camera that has not moved since an earlier session, from angles alone: nothing is measured.

    Args:
        names: of the frames.
        size_px: width and height of the images.
        info: the angles and the direction.
        camera: of the earlier session; its direction counts where ``info`` has none.

    Raises:
        InputError: images of another size than the camera's, unknown angles, or an unknown direction, with which the
            poses would be mirrored as likely as not.
    """
    camera.check_size(size_px)
    direction, n = info.direction or camera.direction, len(names)
    angles_deg = known_angles_deg(info, n)
    if angles_deg is None:
        raise InputError("the angles are not known; give nominal_step_deg or frame_angles_deg in session.json")
    if direction is None:
        raise InputError(
            "which way the turntable turns is not known, nor do the angles of the earlier session tell; give "
            "direction (ccw or cw) in session.json"
        )
    if info.direction is None and direction == "cw":
        angles_deg = -angles_deg
    return TurntablePoses(
        names=tuple(names),
        intrinsics=camera.intrinsics,
        distortion=camera.distortion,
        camera_to_world=np.stack([turntable_camera_to_world(camera.camera_to_world, float(a)) for a in angles_deg]),
        angles_deg=angles_deg,
        reprojection_error_px=np.full(n, np.nan),
        used=np.ones(n, bool),
        markers_per_frame=(0,) * n,
        overall_error_px=float("nan"),
        findings=(Finding("poses-given", "amber", "Poses are as given; nothing was measured."),),
        method="angles",
    )
