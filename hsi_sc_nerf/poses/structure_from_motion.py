"""Structure from motion by COLMAP for a turntable: static pixels are masked, neighbours in the turn are matched.

J. L. Schönberger and J.-M. Frahm, "Structure-from-motion revisited" (CVPR 2016). Every frame gets a pose of its own,
and ``turntable_from_poses`` fits one turntable to them.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.morphology import dilate, ellipse_close_open, touching
from hsi_sc_nerf.poses.session_pictures import require_frames
from hsi_sc_nerf.poses.turntable import FEWEST_FRAMES, Tracks

if TYPE_CHECKING:
    import pycolmap

# glog's level "fatal": errors are reported by the results.
_QUIET = 3
_STRETCH_PERCENTILES = (0.5, 99.5)
# Frames up to this fraction of a full turn apart are matched, and at least this many neighbours on each side.
_NEIGHBOURS_TURN = 0.2
_FEWEST_NEIGHBOURS = 3
# Focal length in image widths during mapping, if it is not known. One orbit around a small object hardly separates it
# from the distance; the bundle adjustment of the turntable determines it.
_FOCAL_FACTOR = 1.5
_SEED = 0
# Features (at most 8192, of 152 bytes each) and matches of a frame in COLMAP's database.
_DATABASE_BYTES = 1_500_000
# Least contrast of a SIFT feature: less than COLMAP's 0.0067, for skin is smooth.
_PEAK_THRESHOLD = 0.004
# Standard deviation of the Gaussian that lowers the images' noise, pixels.
_SMOOTHING_PX = 1.0
# A pixel moves if its brightness varies over the frames by more than this multiple of the noise, and by more than
# this standard deviation, gray levels: rounding to 8 bits alone causes less.
_NOISE_FACTOR = 3.0
_LEAST_CHANGE = 1.0
# Gaps up to this fraction of the image's shorter side are closed: even skin between its patterns.
_CLOSING_FRACTION = 0.04
# The moving region is widened by this fraction of the shorter side; little, for the background begins right there.
_MARGIN_FRACTION = 0.002
# Moving specks below this fraction of the image's area are left out, such as the jagged rim of an even disc.
_LEAST_AREA_FRACTION = 0.0005
# Brightness classes of equal size in which the noise is measured: photon noise grows with the light.
_BRIGHTNESS_CLASSES = 16
# At least this fraction of a class is static; otherwise a brighter class gives its noise.
_STILL_FRACTION = 0.1


@dataclass(frozen=True)
class FreePoses:
    """The result of structure from motion: a pose of its own for each frame, in a world of unknown scale."""

    world_to_camera: Float[np.ndarray, "n 4 4"]
    """OpenCV axes, COLMAP's scale; nan for frames without a pose."""
    focal_px: float
    centre_px: tuple[float, float]
    points_3d: Float[np.ndarray, "p 3"]
    """Points in COLMAP's world; ``tracks`` number them by row."""
    tracks: Tracks

    @property
    def used(self) -> Bool[np.ndarray, "n"]:
        """Frames with a pose."""
        return np.isfinite(self.world_to_camera).all(axis=(1, 2))


def structure_from_motion(
    images: Sequence[UInt8[np.ndarray, "h w"]],
    names: Sequence[str],
    *,
    focal_px: float | None = None,
) -> FreePoses:
    """Poses of a camera that goes round the object at rest, from the images of the turning object.

    Args:
        images: one gray image per frame in the order of the turn, all of one size.
        focal_px: focal length of the camera, where it is known; mapping holds it.

    Raises:
        InputError: nothing moves, the object has too little texture to pose three frames, or COLMAP cannot write
            its temporary files.
        ValueError: images of different sizes, or not one name per image.
    """
    require_frames(images, names)
    moving = moving_pixels(images)
    if not moving.any():
        raise InputError(
            f"nothing moves in the {len(images)} frames {names[0]} ... {names[-1]}; check that the turntable turned "
            "between the frames, and that the object has some texture"
        )
    # The images are stretched to the contrast of the moving pixels.
    low, high = np.percentile(np.stack(images)[:, moving], _STRETCH_PERCENTILES)
    table = np.rint(np.clip((np.arange(256) - low) / max(high - low, 1.0), 0.0, 1.0) * 255.0).astype(np.uint8)
    place = "folder of temporary files"
    try:
        place = tempfile.gettempdir()
        require_space(Path(place), len(images) * (_DATABASE_BYTES + images[0].size))
        with tempfile.TemporaryDirectory(prefix="hsi-sc-nerf-colmap-") as name:
            folder = Path(name)
            (folder / "images").mkdir()
            for i, image in enumerate(images):
                _write(folder / "images" / _file_name(i), table[image])
            _write(folder / "mask.png", moving.astype(np.uint8) * 255)
            _match(folder, len(images), images[0].shape, focal_px)
            reconstruction = _map(folder)
    except (OSError, RuntimeError) as error:  # pycolmap raises the latter
        raise InputError(
            f"{place}: COLMAP cannot write its files ({error}); free space there, or set TMPDIR to another disk"
        ) from error
    if reconstruction is None:
        raise InputError(
            f"the frames {names[0]} ... {names[-1]} show too little texture to find poses from features; take "
            "markers or smaller steps"
        )
    return _free_poses(reconstruction, len(names))


def require_space(folder: Path, needed: int) -> None:
    """Refuse a disk that is too full before COLMAP starts: it would end the process.

    Args:
        needed: bytes.

    Raises:
        OSError: there is less space, or no folder.
    """
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(f"{free / 1e6:.0f} MB are free, {needed / 1e6:.0f} MB may be needed")


def _write(path: Path, image: UInt8[np.ndarray, "h w"]) -> None:
    if not cv2.imwrite(str(path), image):
        raise OSError(f"{path.name} could not be written")


def moving_pixels(images: Sequence[UInt8[np.ndarray, "h w"]]) -> Bool[np.ndarray, "h w"]:
    """Pixels that show something that turns in some of the frames.

    Structure from motion must not see the static background, or it would find a stationary camera. Only pixels whose
    brightness changes are found, so not an even disc nor the outline of a body of revolution. The lamps' drift, one
    factor per frame, is removed first.

    Args:
        images: one 8-bit gray image per frame, all of one size, linear in reflectance.
    """
    stack = np.stack([cv2.GaussianBlur(i.astype(np.float32), (0, 0), _SMOOTHING_PX) for i in images])
    middle = np.median(stack, axis=0)
    for image in stack:
        image /= _lamp_factor(image, middle)
    mean, spread = stack.mean(axis=0), stack.std(axis=0)
    moving = spread > np.maximum(_LEAST_CHANGE, _NOISE_FACTOR * _noise_spread(mean, spread))
    side = min(moving.shape)
    # Opening first drops single pixels that noise alone lifts above the threshold, before closing joins them.
    moving = ellipse_close_open(moving, close_px=0, open_px=2)
    moving = ellipse_close_open(moving, close_px=_odd(_CLOSING_FRACTION * side), open_px=3)
    moving = touching(moving, moving, min_area_px=round(_LEAST_AREA_FRACTION * moving.size))
    return dilate(moving, _odd(2 * _MARGIN_FRACTION * side))


def neighbour_pairs(frames: int) -> list[tuple[int, int]]:
    """Pairs of frames to match: up to a fifth of a full turn apart, the last a neighbour of the first.

    Frames of a partial turn are nearer to each other than that, and its last and first frame do not match.
    """
    most = max(_FEWEST_NEIGHBOURS, round(_NEIGHBOURS_TURN * frames))
    return [(i, j) for i in range(frames) for j in range(i + 1, frames) if min(j - i, frames - (j - i)) <= most]


def _file_name(frame: int) -> str:
    return f"{frame:05d}.png"


def _match(folder: Path, frames: int, shape: tuple[int, ...], focal_px: float | None) -> None:
    """Features of all images, and those that neighbours in the turn share, into the folder's database."""
    import pycolmap

    pycolmap.logging.minloglevel = _QUIET
    pycolmap.set_random_seed(_SEED)
    height, width = shape
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_PINHOLE"
    reader.camera_params = f"{focal_px or _FOCAL_FACTOR * width},{width / 2},{height / 2}"
    reader.camera_mask_path = str(folder / "mask.png")
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.peak_threshold = _PEAK_THRESHOLD
    # Images are numbered here, in their order: extraction would number them as its threads come along.
    pycolmap.Database.open(folder / "database.db").close()
    pycolmap.import_images(
        folder / "database.db", folder / "images", camera_mode=pycolmap.CameraMode.SINGLE, options=reader
    )
    pycolmap.extract_features(
        folder / "database.db",
        folder / "images",
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    pairs = neighbour_pairs(frames)
    (folder / "pairs.txt").write_text("".join(f"{_file_name(i)} {_file_name(j)}\n" for i, j in pairs))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(folder / "pairs.txt")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = _SEED
    pycolmap.match_image_pairs(
        folder / "database.db",
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def _map(folder: Path) -> pycolmap.Reconstruction | None:
    """The largest reconstruction from the folder's database; None where there is none of three frames."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = _SEED
    options.num_threads = 1
    options.multiple_models = False
    options.min_model_size = FEWEST_FRAMES
    options.extract_colors = False
    options.ba_refine_focal_length = False
    options.mapper.abs_pose_refine_focal_length = False
    found = pycolmap.incremental_mapping(folder / "database.db", folder / "images", folder, options)
    best = max(found.values(), key=lambda r: r.num_reg_images(), default=None)
    if best is None or best.num_reg_images() < FEWEST_FRAMES:
        return None
    return best


def _free_poses(reconstruction: pycolmap.Reconstruction, frames: int) -> FreePoses:
    ids = sorted(reconstruction.points3D)
    row = {point: i for i, point in enumerate(ids)}
    poses = np.full((frames, 4, 4), np.nan)
    seen = []
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        frame = int(Path(image.name).stem)
        poses[frame] = np.eye(4)
        poses[frame, :3] = image.cam_from_world().matrix()
        seen += [(frame, row[p.point3D_id], *p.xy) for p in image.points2D if p.has_point3D()]
    rows = np.array(sorted(seen)).reshape(-1, 4)
    (camera,) = reconstruction.cameras.values()
    return FreePoses(
        world_to_camera=poses,
        focal_px=float(camera.focal_length),
        centre_px=(float(camera.principal_point_x), float(camera.principal_point_y)),
        points_3d=np.array([reconstruction.points3D[i].xyz for i in ids]).reshape(-1, 3),
        tracks=Tracks(rows[:, 0].astype(int), rows[:, 1].astype(int), rows[:, 2:]),
    )


def _lamp_factor(image: Float[np.ndarray, "h w"], middle: Float[np.ndarray, "h w"]) -> float:
    """Brightness of the image over that of the median image: the median over the pixels that are not dark."""
    lit = middle >= 1.0  # in a black chamber few
    if not lit.any():
        return 1.0
    bright = lit & (middle >= np.median(middle[lit]))
    return float(np.median(image[bright] / middle[bright]))


def _noise_spread(mean: Float[np.ndarray, "h w"], spread: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Standard deviation over the frames due to noise alone, at each pixel by its brightness.

    Noise does not decrease with brightness, so a class with too few static pixels takes that of a brighter one.
    """
    edges = np.quantile(mean, np.linspace(0.0, 1.0, _BRIGHTNESS_CLASSES + 1)[1:-1])
    brightness_class = np.searchsorted(edges, mean)
    lower = np.full(_BRIGHTNESS_CLASSES, np.inf)
    for k in np.unique(brightness_class):
        lower[k] = np.quantile(spread[brightness_class == k], _STILL_FRACTION)
    return np.minimum.accumulate(lower[::-1])[::-1][brightness_class]


def _odd(size: float) -> int:
    return 2 * round(size / 2) + 1
