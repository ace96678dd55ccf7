"""Camera poses of a turntable session from its ArUco markers, whose layout need not be known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.assemble import Session, poses_of
from hsi_sc_nerf.poses.initialise import initialise
from hsi_sc_nerf.poses.markers import find_dictionary
from hsi_sc_nerf.poses.observe import observe, observe_expected
from hsi_sc_nerf.poses.outliers import (
    FEWEST_FRAMES,
    adjust_without_outliers,
    first_adjustment,
    usable,
    well_known,
)
from hsi_sc_nerf.poses.result import TurntablePoses

__all__ = ["TurntablePoses", "estimate_turntable_poses"]

# Taken for the markers' side where only the container's diameter is known; any length would do.
_SIDE_WITHOUT_SCALE_M = 0.03


def estimate_turntable_poses(
    images: Sequence[UInt8[np.ndarray, "h w"]],
    names: Sequence[str],
    *,
    dictionary: str | None = None,
    marker_side_m: float | None,
    nominal_step_deg: float | None = None,
    direction: Literal["ccw", "cw"] | None = None,
    container_diameter_m: float | None = None,
    container_height_m: float | None = None,
    progress: bool = True,
) -> TurntablePoses:
    """Poses from markers that turn with the object before a camera that stands still.

    Unknown and found: the focal length, the camera's pose, the axis, one angle a frame, where the markers sit, and
    the dictionary if it is not given. Radial lens distortion and small motions of a wobbling table are found where
    the images call for them (``choose``). A few frames that were knocked are left out. Pixels are square.

    The principal point is taken to be the image's centre. One axis hardly tells it from the camera's direction: with
    corners good to 0.03 px (24 frames of 512 x 512) it would be found to 0.1 px sideways and 0.8 px upright, the
    camera's direction then to 0.05 instead of 0.001 degrees, the focal length to 0.03 instead of 0.01 %. A centre
    that is really 5 px off costs 0.3 degrees, by which the same points stay at the same pixels, 1 mm and 0.16 %.

    Args:
        images: one grey image a frame, all of one size, linear in reflectance (a gamma moves every edge).
        names: the frames' names, for messages and the report.
        dictionary: OpenCV's name of the markers' dictionary, such as ``DICT_5X5_50``.
        marker_side_m: side of the markers' black square in metres; it gives the scale. None: the container does.
        nominal_step_deg: the turntable's step, only compared with what is found.
        direction: the turntable's turn seen from above, only compared with what is found.
        container_diameter_m: of the upright cylinder that carries markers around its side; compared with what the
            markers say, or the scale where their side is not known.
        container_height_m: of its lid above the disc, to tell its markers from others above it.
        progress: show progress bars.

    Raises:
        InputError: no markers, too few frames with linked markers to fix an axis, or nothing that gives the scale.
        ValueError: images of different sizes, or as many names as images are not given.
    """
    _check(images, names, marker_side_m, container_diameter_m)
    dictionary = dictionary or find_dictionary(images)
    observed = observe(images, dictionary, progress) if dictionary else None
    if dictionary is None or observed is None or len(observed.observations) == 0:
        raise InputError(
            f"no marker was found in any of the {len(images)} frames {names[0]} ... {names[-1]}; check that the "
            f"markers are visible and well exposed, and the marker dictionary ({dictionary or 'all were tried'})"
        )
    height, width = images[0].shape
    centre_px, side_m = (width / 2, height / 2), marker_side_m or _SIDE_WITHOUT_SCALE_M
    linked, rejected, still = usable(observed.observations)
    if len(np.unique(linked.frame)) < FEWEST_FRAMES:
        raise InputError(
            f"only {len(np.unique(linked.frame))} of the {len(images)} frames {names[0]} ... {names[-1]} share "
            f"markers with others, {FEWEST_FRAMES} are needed; take smaller steps or show more markers"
        )
    start = first_adjustment(initialise(linked, centre_px, width, side_m), linked, centre_px, side_m)
    first, _, thrown_out = adjust_without_outliers(start, linked, centre_px, side_m)
    start = first.turntable
    rejected += [r for r in thrown_out if r.frame not in start.frames]
    linked = linked.select(np.isin(linked.frame, start.frames))
    linked = observe_expected(images, dictionary, start, linked, centre_px, side_m, observed.blur_px)
    adjusted, kept, thrown_out = adjust_without_outliers(start, linked, centre_px, side_m)
    adjusted, kept, uncertain = well_known(adjusted, kept, centre_px, side_m)
    rejected += thrown_out + uncertain + [r for r in observed.unexplained if not linked.has(r.frame, r.marker)]
    return poses_of(
        adjusted,
        kept,
        rejected,
        Session(
            names=tuple(names),
            size_px=(width, height),
            dictionary=dictionary,
            marker_side_m=marker_side_m,
            nominal_step_deg=nominal_step_deg,
            direction=direction,
            container_diameter_m=container_diameter_m,
            container_height_m=container_height_m,
            blur_px=float(np.median(observed.blur_px)),
            warnings=tuple(f"marker {m} stands still in the image and was left out" for m in still),
        ),
    )


def _check(images, names, marker_side_m, container_diameter_m) -> None:
    if len(images) != len(names) or len({image.shape for image in images}) > 1:
        raise ValueError("estimate_turntable_poses: needs images of one size and one name an image")
    if marker_side_m is None and container_diameter_m is None:
        raise InputError(
            "nothing gives the scale; give marker_side_m, the side of the markers' black square in metres, or "
            "container_diameter_m and container_height_m"
        )
    if marker_side_m is not None and marker_side_m <= 0:
        raise InputError(f"marker_side_m is {marker_side_m}; give the side of the markers' black square in metres")
    if len(images) < FEWEST_FRAMES:
        raise InputError(
            f"{len(images)} frame(s) ({', '.join(names)}) cannot fix a turntable's axis; "
            f"give {FEWEST_FRAMES} or more frames of one session"
        )
