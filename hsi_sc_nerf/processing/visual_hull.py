"""The visual hull of the foreground masks, what each camera sees of it, and boxes about it.

The visual hull is the set of points that project into the object's mask in every frame (A. Laurentini, "The visual
hull concept for silhouette-based image understanding", IEEE TPAMI 16, 1994). `voted_hull` computes it on a coarse
grid and lets a few frames contradict a point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, closest_point_to_rays, image_of, pixels_of
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.packed.dataset import Container

MIN_VIEWS_FRACTION = 2.0 / 3.0
"""A point of the hull lies in the image of this fraction of the frames: too few masks carve what lies far behind the
object or beside the camera."""
MAX_MISSED_FRACTION = 0.05
"""A point of the hull may lie outside the mask in this fraction of all frames: one wrong mask or pose must not cut a
piece off the object."""
_FIRST_STEP = 6
"""Every sixth frame is tested first: a few frames rule out most points."""
GRID_CELLS = 48
"""The visual hull is computed on this number of voxels along each axis."""
HULL_MISSED_FRACTION = 0.15
"""Fraction of the frames that may contradict a point: a few frames of another object must not carve the hull."""
OBJECT_MARGIN_M = 0.003
"""The object's box is widened by this: masks and poses are uncertain by a pixel or two."""
SCENE_MARGIN_M = 0.005
"""The box of everything that turns is widened by this."""
DISC_OVER_MARKERS = 1.1
"""Radius of the turntable's disc as a multiple of the outermost marker corner's distance from the axis."""
DISC_OVER_CONTAINER = 2.3
"""Diameter of the disc as a multiple of the container's, where no marker shows it; the simulator's is 205 mm under a
container of 90 mm."""


@dataclass(frozen=True, eq=False)
class VotedHull:
    """The visual hull that most masks agree on.

    Attributes:
        core: centres of the voxels that hardly any mask contradicts (`MAX_MISSED_FRACTION`), object
            frame, metres; n may be 0.
        sides_m: sides of a voxel.
        voxel_px: diameter of a voxel in the images, odd.
        silhouettes: pixels of each frame that see the hull.
        core_silhouettes: pixels of each frame that see the core.
    """

    core: Float[np.ndarray, "n 3"]
    sides_m: Float[np.ndarray, "3"]
    voxel_px: int
    silhouettes: Bool[np.ndarray, "frames h w"]
    core_silhouettes: Bool[np.ndarray, "frames h w"]

    def trim(self, masks: Bool[np.ndarray, "frames h w"]) -> Bool[np.ndarray, "frames h w"]:
        """Masks without what most other frames contradict, such as noise on the container's lid.

        Masks may exceed the hull's silhouette by half a voxel's diameter.
        """
        return masks & np.stack([dilate(silhouette, self.voxel_px) for silhouette in self.silhouettes])


def voted_hull(
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    min_z_m: float | None = None,
) -> VotedHull:
    """The visual hull of the masks, which `HULL_MISSED_FRACTION` of the frames may contradict.

    The hull is computed on a grid twice: in the cube that the cameras see, then in the bounds found there. Masks are
    dilated by half a voxel's diagonal, so that parts thinner than a voxel are kept.

    Args:
        camera_to_worlds: poses, OpenGL axes.
        intrinsics: intrinsics of the one camera; lens distortion is neglected.
        min_z_m: height of the container's lid, below which the hull does not reach; None if unknown.

    Example:
        >>> dataset = open_packed("apple_01-data")
        >>> masks = np.stack([frame.mask() for frame in dataset.frames])
        >>> hull = voted_hull(masks, dataset.camera_to_worlds, dataset.intrinsics)
    """
    # The point that all frames look at.
    (centre,), _ = closest_point_to_rays(camera_to_worlds[:, :3, 3], camera_to_worlds[:, :3, 2])
    distance = np.linalg.norm(camera_to_worlds[:, :3, 3] - centre, axis=1).min()
    reach = distance * max(intrinsics.w / intrinsics.fl_x, intrinsics.h / intrinsics.fl_y) / 2.0
    low, high = centre - reach, centre + reach
    shown = masks.any(axis=(1, 2)) | (not masks.any())  # an empty mask does not tell where the object is
    poses = camera_to_worlds[shown]
    for _ in range(2):
        sides = (high - low) / GRID_CELLS
        ticks = [low[k] + sides[k] * (np.arange(GRID_CELLS) + 0.5) for k in range(3)]
        points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        if min_z_m is not None:
            points = points[points[:, 2] >= min_z_m - sides[2] / 2.0]
        voxel_px = 2 * int(np.ceil(intrinsics.fl_x * np.linalg.norm(sides) / 2.0 / distance)) + 1
        dilated = np.stack([dilate(mask, voxel_px) for mask in masks[shown]])
        voxels = visual_hull(points, dilated, poses, intrinsics, HULL_MISSED_FRACTION)
        if len(voxels) == 0:
            break
        low, high = voxels.min(axis=0) - sides / 2.0, voxels.max(axis=0) + sides / 2.0
    core = visual_hull(voxels, dilated, poses, intrinsics)
    silhouettes, core_silhouettes = (
        np.stack([_silhouette(seen, pose, intrinsics, voxel_px) for pose in camera_to_worlds])
        for seen in (voxels, core)
    )
    return VotedHull(core, sides, voxel_px, silhouettes, core_silhouettes)


def _silhouette(
    voxels: Float[np.ndarray, "n 3"], pose: Float[np.ndarray, "4 4"], intrinsics: PinholeIntrinsics, voxel_px: int
) -> Bool[np.ndarray, "h w"]:
    """Pixels that see the hull of masks that were dilated by a voxel's diameter."""
    # Dilation closes the gaps between voxels; erosion undoes it, and the dilation of the masks.
    return ~dilate(~dilate(image_of(voxels, pose, intrinsics), voxel_px), 2 * voxel_px - 1)


def visual_hull(
    points: Float[np.ndarray, "n 3"],
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    max_missed_fraction: float = MAX_MISSED_FRACTION,
) -> Float[np.ndarray, "kept 3"]:
    """The points that most frames see (`MIN_VIEWS_FRACTION`) and few outside the mask.

    Lens distortion is neglected.

    Args:
        points: in the object frame, metres.
        masks: true on the object.
        camera_to_worlds: poses, OpenGL axes.
        max_missed_fraction: fraction of all frames that may have a point of the hull outside of their mask.

    Example:
        >>> ticks = np.linspace(-0.1, 0.1, 48)
        >>> centres = np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)
        >>> hull = visual_hull(centres, masks, camera_to_worlds, intrinsics)
    """
    max_missed = int(max_missed_fraction * len(masks) + 1e-9)
    for step in (_FIRST_STEP, 1):

        def pixels_in(frame: int, points: Float[np.ndarray, "n 3"], step: int = step) -> tuple[Any, Any]:
            return pixels_of(points, camera_to_worlds[frame * step], intrinsics)

        in_image, in_mask = silhouette_counts(points, masks[::step], pixels_in)
        keep = in_image - in_mask <= max_missed
        points, in_image = points[keep], in_image[keep]
    return points[in_image >= MIN_VIEWS_FRACTION * len(masks) - 1e-9]


def silhouette_counts(points: Any, masks: Iterable[Any], pixels_of: Callable[[int, Any], Any]) -> tuple[Any, Any]:
    """Count the frames that have each point in their image, and those that have it in the object's mask.

    Occlusion is ignored. Takes NumPy arrays or tensors and returns two counts (n) of the same kind.

    Args:
        points: (n, 3), in the unit that ``pixels_of`` takes.
        masks: masks of each frame (lines, samples), true on the object.
        pixels_of: of a frame's index and points, which points lie in the image (n), and their pixels (n, 2) as
            (sample, line), (0, 0) where they do not.
    """
    in_image: Any = 0
    in_mask: Any = 0
    for index, mask in enumerate(masks):
        inside, pixels = pixels_of(index, points)
        in_image = in_image + inside
        in_mask = in_mask + (inside & mask[pixels[:, 1], pixels[:, 0]])
    return in_image, in_mask


def object_box(hull: VotedHull, min_z_m: float | None = None) -> Float[np.ndarray, "2 3"]:
    """Minimum and maximum of the core of the masks' visual hull, object frame, metres.

    Args:
        min_z_m: height of the container's lid, below which the box does not reach; None if unknown.

    Raises:
        InputError: no point projects into the masks: masks and poses do not fit each other.

    Example:
        >>> dataset = open_packed("apple_01-data")
        >>> masks = np.stack([frame.mask() for frame in dataset.frames])
        >>> low_m, high_m = object_box(voted_hull(masks, dataset.camera_to_worlds, dataset.intrinsics))
    """
    if len(hull.core) == 0:
        raise InputError(
            "the foreground masks and the poses do not fit each other, so that no object is left in space; look "
            "at report/masks.png and report/poses.png."
        )
    low, high = hull.core.min(axis=0) - hull.sides_m / 2.0, hull.core.max(axis=0) + hull.sides_m / 2.0
    box = np.stack([low - OBJECT_MARGIN_M, high + OBJECT_MARGIN_M])
    if min_z_m is not None:
        box[0, 2] = max(box[0, 2], min_z_m)
    return box


def size_in_words(box_m: Float[np.ndarray, "2 3"], metric: bool) -> str:
    """The sides of a box: in mm, or in % of the camera's distance where nothing gives the scale."""
    factor, unit = (1000.0, "mm") if metric else (100.0, "% of the camera's distance")
    return f"{' x '.join(f'{factor * side:.0f}' for side in np.diff(box_m, axis=0)[0])} {unit}"


def scene_box(
    object_box_m: Float[np.ndarray, "2 3"],
    marker_corners_m: dict[int, Float[np.ndarray, "4 3"]],
    container: Container | None,
    container_diameter_m: float | None = None,
) -> Float[np.ndarray, "2 3"]:
    """Minimum and maximum of everything that turns: object, container, markers and the disc under them.

    The disc is round, so the box is square about the axis. Its radius is taken to be (`assumed_disc` says which):

    - `DISC_OVER_MARKERS` times the distance of the outermost marker corner from the axis;
    - without markers, `DISC_OVER_CONTAINER` times the container's radius;
    - with neither, the object box's reach. It holds all that differs from the background.

    Args:
        container: where its size is known and it stands on z = 0.
        container_diameter_m: of a container whose height over the disc is not known, where lengths are metres.
    """
    corners = np.concatenate([np.zeros((1, 3)), *marker_corners_m.values()])
    diameter_m = container_diameter_m or 0.0 if container is None else container.diameter_m
    radii = [
        DISC_OVER_MARKERS * np.hypot(corners[:, 0], corners[:, 1]).max(),
        np.abs(object_box_m[:, :2]).max(),
        diameter_m / 2.0 if marker_corners_m else DISC_OVER_CONTAINER * diameter_m / 2.0,
    ]
    lowest = min(corners[:, 2].min(), object_box_m[0, 2])
    highest = max(corners[:, 2].max(), object_box_m[1, 2], 0.0 if container is None else container.height_m)
    reach = max(radii) + SCENE_MARGIN_M
    return np.array([[-reach, -reach, lowest - SCENE_MARGIN_M], [reach, reach, highest + SCENE_MARGIN_M]])


def assumed_disc(has_markers: bool, container_diameter_m: float | None) -> str | None:
    """What `scene_box` assumes about a disc that no marker shows, as the rest of a sentence; None with markers."""
    if has_markers:
        return None
    if container_diameter_m is None:
        return "the size of the disc is not known: the scene is taken to end where the masks' hull ends"
    diameter_mm = 1e3 * DISC_OVER_CONTAINER * container_diameter_m
    return (
        f"no marker shows the size of the disc: its diameter is taken to be {diameter_mm:.0f} mm, "
        f"{DISC_OVER_CONTAINER} times the container's"
    )
