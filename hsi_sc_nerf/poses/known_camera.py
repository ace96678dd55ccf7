"""Poses from angles that are known and a camera that an earlier session has calibrated: nothing is measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, turntable_camera_to_world
from hsi_sc_nerf.poses.result import TurntablePoses


@dataclass(frozen=True, eq=False)
class KnownCamera:
    """A camera before its turntable, as an earlier session found it."""

    intrinsics: PinholeIntrinsics
    distortion: tuple[float, float, float, float]
    camera_to_world: Float[np.ndarray, "4 4"]
    """Pose at the angle 0, object frame, metres."""
    direction: Literal["ccw", "cw"] | None = None
    """How the turntable turned, seen from above; None where the earlier session does not tell."""


def poses_by_known_camera(
    names: Sequence[str],
    size_px: tuple[int, int],
    angles_deg: Float[np.ndarray, "n"],
    camera: KnownCamera,
    *,
    nominal_step_deg: float | None,
    direction: Literal["ccw", "cw"] | None,
) -> TurntablePoses:
    """Poses of a camera that has not moved since, before an object that was turned by ``angles_deg``.

    Args:
        names: the frames' names.
        size_px: width and height of the images.
        angles_deg: of each frame, relative to the first, counter-clockwise seen from above.
        camera: of the earlier session.
        nominal_step_deg: for the report.
        direction: for the report.

    Raises:
        InputError: images of another size than the camera's.
    """
    if size_px != (camera.intrinsics.w, camera.intrinsics.h):
        raise InputError(
            f"the images have {size_px[0]} x {size_px[1]} pixels, but the camera of the earlier session had "
            f"{camera.intrinsics.w} x {camera.intrinsics.h}; give a session of the same camera"
        )
    n = len(names)
    return TurntablePoses(
        names=tuple(names),
        intrinsics=camera.intrinsics,
        distortion=camera.distortion,
        camera_to_world=np.stack([turntable_camera_to_world(camera.camera_to_world, float(a)) for a in angles_deg]),
        angles_deg=np.asarray(angles_deg, dtype=float),
        reprojection_error_px=np.full(n, np.nan),
        used=np.ones(n, bool),
        marker_corners_m={},
        dropped={},
        dictionary=None,
        markers_per_frame=(0,) * n,
        overall_error_px=float("nan"),
        blur_px=0.0,
        disc_markers=(),
        disc_tilt_deg=None,
        loop_closure_deg=None,
        nominal_step_deg=nominal_step_deg,
        nominal_direction=direction,
        warnings=("poses are as given, by the camera of an earlier session and the angles; nothing was measured",),
        method="angles",
    )
