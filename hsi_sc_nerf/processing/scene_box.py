"""Boxes around the object and the scene, from poses and masks: a coarse visual hull.

A point of the object projects into the mask of each frame that sees it (A. Laurentini, "The visual hull concept
for silhouette-based image understanding", IEEE TPAMI 16, 1994).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, project
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.packed.dataset import Container

DISC_OVERHANG = 1.1
"""How far the turntable's disc reaches beyond its outermost marker corner, as a factor on the radius."""
DISC_OVER_CONTAINER = 2.3
"""How much wider than the container the disc is taken to be where no marker shows its reach: the simulator's has
205 mm under a container of 90 mm."""


def focus_point(camera_to_worlds: Float[np.ndarray, "frames 4 4"]) -> Float[np.ndarray, "3"]:
    """The point nearest (least squares) to the optical axes of all frames."""
    origins, axes = camera_to_worlds[:, :3, 3], -camera_to_worlds[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # Axes that are parallel (a partial turn of nearly nothing) leave a direction open: the shortest solution.
    return np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, origins), rcond=None)[0]


def carve(
    points: Float[np.ndarray, "n 3"],
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    min_agreement: float = 0.95,
) -> Float[np.ndarray, "kept 3"]:
    """The points that two thirds of the frames see and that lie outside the mask in few frames.

    Few are at most ``1 - min_agreement`` of all frames: a wrong mask or pose may cut a piece off the object. What
    few frames see, far behind the object or beside the camera, has too few masks to be carved by.
    """
    allowed = int((1.0 - min_agreement) * len(masks) + 1e-9)
    missed = np.zeros(len(points), dtype=int)
    seen = np.zeros(len(points), dtype=int)
    for mask, pose in zip(masks, camera_to_worlds, strict=True):
        pixels, depth = project(points, pose, intrinsics)
        in_image = (depth > 0.0) & (pixels >= 0.0).all(axis=1) & (pixels < (intrinsics.w, intrinsics.h)).all(axis=1)
        x, y = pixels[in_image].astype(int).T
        missed[in_image] += ~mask[y, x]
        keep = missed <= allowed
        points, missed, seen = points[keep], missed[keep], (seen + in_image)[keep]
    return points[3 * seen >= 2 * len(masks)]


def object_box(
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    *,
    min_z_m: float | None = None,
    margin_m: float = 0.003,
    resolution: int = 48,
) -> Float[np.ndarray, "2 3"]:
    """Minimum and maximum of the masks' visual hull (metres), widened by ``margin_m``.

    The hull is carved twice: in the cube that the cameras see, then in the bounds found there. A voxel counts where
    any part of it may lie in the masks (they are dilated by half its diagonal), so that thin parts are not lost
    between the voxels' centres. Lens distortion is neglected. ``min_z_m`` is a floor under the object (the
    container's lid), where it is known.

    Raises:
        InputError: no point projects into the masks: masks and poses do not fit each other.
    """
    centre = focus_point(camera_to_worlds)
    distance = np.linalg.norm(camera_to_worlds[:, :3, 3] - centre, axis=1).min()
    reach = distance * max(intrinsics.w / intrinsics.fl_x, intrinsics.h / intrinsics.fl_y) / 2.0
    low, high = centre - reach, centre + reach
    for _ in range(2):
        step = (high - low) / resolution
        ticks = [low[k] + step[k] * (np.arange(resolution) + 0.5) for k in range(3)]
        points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        if min_z_m is not None:
            points = points[points[:, 2] >= min_z_m - step[2] / 2.0]
        half_diagonal_px = intrinsics.fl_x * np.linalg.norm(step) / 2.0 / distance
        size_px = 2 * int(np.ceil(half_diagonal_px)) + 1
        widened = np.stack([dilate(mask, size_px) for mask in masks])
        hull = carve(points, widened, camera_to_worlds, intrinsics)
        if len(hull) == 0:
            raise InputError(
                "the foreground masks and the poses do not fit each other, so that no object is left in space; look "
                "at report/masks.png and report/poses.png."
            )
        low, high = hull.min(axis=0) - step / 2.0, hull.max(axis=0) + step / 2.0
    box = np.stack([low - margin_m, high + margin_m])
    if min_z_m is not None:
        box[0, 2] = max(box[0, 2], min_z_m)
    return box


def scene_box(
    object_box_m: Float[np.ndarray, "2 3"],
    marker_corners_m: dict[int, Float[np.ndarray, "4 3"]],
    container: Container | None,
    margin_m: float = 0.005,
    container_diameter_m: float | None = None,
) -> Float[np.ndarray, "2 3"]:
    """Minimum and maximum of all that turns: object, container, markers and the disc that they lie on.

    The disc is round, so the box is square about the axis; it is widened by ``margin_m``. How far the disc reaches is
    assumed, in this order (``assumed_disc`` says which):

    - ``DISC_OVERHANG`` times as far as the outermost marker corner;
    - without markers, ``DISC_OVER_CONTAINER`` times as far as the container's wall;
    - with neither, no farther than the masks' hull (``object_box_m``), which holds all that differs from the
      background: a disc as dark as the chamber is outside.

    Args:
        object_box_m: minimum and maximum of the masks' hull.
        marker_corners_m: corners of the markers by their id; may be empty.
        container: where its size is known and it stands on z = 0.
        margin_m: the box is widened by this.
        container_diameter_m: of a container whose height over the disc is not known, where lengths are metres.
    """
    corners = np.concatenate([np.zeros((1, 3)), *marker_corners_m.values()])
    width_m = container_diameter_m or 0.0 if container is None else container.diameter_m
    radii = [
        DISC_OVERHANG * np.hypot(corners[:, 0], corners[:, 1]).max(),
        np.abs(object_box_m[:, :2]).max(),
        width_m / 2.0 if marker_corners_m else DISC_OVER_CONTAINER * width_m / 2.0,
    ]
    lowest = min(corners[:, 2].min(), object_box_m[0, 2])
    highest = max(corners[:, 2].max(), object_box_m[1, 2], 0.0 if container is None else container.height_m)
    reach = max(radii) + margin_m
    return np.array([[-reach, -reach, lowest - margin_m], [reach, reach, highest + margin_m]])


def assumed_disc(has_markers: bool, container_diameter_m: float | None) -> str | None:
    """What ``scene_box`` assumes of a disc that no marker shows, as a sentence's end; None with markers."""
    if has_markers:
        return None
    if container_diameter_m is None:
        return "nothing shows how far the disc reaches: what turns is taken to end where the masks' hull ends"
    diameter_mm = 1e3 * DISC_OVER_CONTAINER * container_diameter_m
    return (
        f"no marker shows how far the disc reaches: its diameter is taken to be {diameter_mm:.0f} mm, "
        f"{DISC_OVER_CONTAINER} times the container's"
    )
