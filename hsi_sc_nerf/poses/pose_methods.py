"""The methods that find a session's poses, and the choice of one that the session supports."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
from threadpoolctl import threadpool_limits

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.feature_poses import Images, KnownCamera, poses_from_known_camera, poses_from_sfm
from hsi_sc_nerf.poses.marker_poses import poses_from_markers
from hsi_sc_nerf.poses.result import TurntablePoses

PoseMethod: TypeAlias = Literal["auto", "markers", "colmap", "angles"]

FIELD_OF_VIEW_DEG = (4.0, 100.0)
"""Plausible fields of view over the image's width, from a long tele lens to a very wide one. Too few features may
give another one."""
# In the order in which they are tried.
_NAMES: dict[str, str] = {"markers": "markers", "colmap": "features (COLMAP)", "angles": "known angles"}


def find_poses(
    images: Images,
    names: Sequence[str],
    info: SessionInfo,
    method: PoseMethod = "auto",
    *,
    camera: KnownCamera | None = None,
    places: Sequence[int] | None = None,
    from_sfm: Callable[..., TurntablePoses] = poses_from_sfm,
) -> TurntablePoses:
    """Poses by one method, or by the first that works; the result names the method and why it was used.

    Args:
        images: one gray image per frame, all of one size, or ``SessionPictures``.
        info: what is known of the session: markers, container, nominal step or angles, direction, distance.
        method: ``auto`` takes the first of ``markers``, ``colmap`` and ``angles`` that works.
        camera: of an earlier session; poses from features start from its focal length, and with known angles poses
            need neither markers nor texture.
        places: each frame's place in the turn (`Session.places`), where captures are left out.
        from_sfm: called like `poses_from_sfm`.

    Raises:
        InputError: the method, or every method, fails; says why.

    Example:
        >>> poses = find_poses(images, names, SessionInfo(marker_side_m=0.03))
        >>> poses.chosen
        'by markers'
    """

    def by(method: str) -> TurntablePoses:
        if method == "markers":
            return poses_from_markers(images, names, info)
        if method == "colmap":
            return _checked(from_sfm(images, names, info, camera=camera, places=places))
        if camera is None:
            return _checked(from_sfm(images, names, info, hold_angles=True, places=places))
        height, width = images[0].shape
        return poses_from_known_camera(names, (width, height), info, camera, places)

    # Many small systems of equations are solved side by side, which BLAS's own threads would slow down.
    with threadpool_limits(limits=1, user_api="blas"):
        if method != "auto":
            return replace(by(method), chosen=f"by {_NAMES[method]}, as the settings say")
        failed = []
        for name, words in _NAMES.items():
            try:
                poses = by(name)
            except InputError as error:
                failed.append(f"{words}: {str(error).rstrip('.')}")
                continue
            why_not = f" (not by {'; nor by '.join(failed)})" if failed else ""
            return replace(poses, chosen=f"by {words}{why_not}")
    raise InputError(f"no method finds poses: {'; '.join(failed)}.")


def _checked(poses: TurntablePoses) -> TurntablePoses:
    """Refuse poses from features that are too few: focal length and distance grow or shrink together.

    Raises:
        InputError: no camera has such a field of view.
    """
    field_deg = float(np.rad2deg(2.0 * np.arctan(poses.intrinsics.w / 2.0 / poses.intrinsics.fl_x)))
    low, high = FIELD_OF_VIEW_DEG
    if not low <= field_deg <= high:
        raise InputError(
            f"the features are too few to determine the camera (they give a field of view of {field_deg:.1f} "
            "degrees); take images of more pixels, an object with more texture, or markers"
        )
    return poses
