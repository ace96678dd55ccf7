"""Structure from motion by COLMAP for a turntable: what stands still is masked, neighbours in the turn are matched.

J. L. Schönberger and J.-M. Frahm, "Structure-from-motion revisited" (CVPR 2016). Every frame gets a pose of its own
here; ``turntable_from_poses`` and ``track_adjust`` make one machine of them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.static_background import StaticBackgroundConfig, moving_pixels
from hsi_sc_nerf.poses.tracks import Tracks
from hsi_sc_nerf.poses.turntable_from_poses import FEWEST_FRAMES

if TYPE_CHECKING:
    import pycolmap

# glog's levels: 2 is "error", 3 is "fatal". What goes wrong is told by what comes back.
_QUIET = 3
_STRETCH_PERCENTILES = (0.5, 99.5)


@dataclass(frozen=True)
class StructureFromMotionConfig:
    """Settings of structure from motion."""

    background: StaticBackgroundConfig = field(default_factory=StaticBackgroundConfig)
    """How pixels that stand still are told; they carry no features."""
    peak_threshold: float = 0.004
    """Least contrast of a SIFT feature; smaller finds more on smooth skin, and more noise."""
    neighbours_deg: float = 72.0
    """Frames up to this far apart are matched, if the frames make one full turn."""
    fewest_neighbours: int = 3
    """And at least so many to each side."""
    focal_factor: float = 1.5
    """Focal length in image widths that mapping starts from and keeps; ``track_adjust`` finds it, for the machine
    tells it better than free poses do."""
    refine_focal: bool = False
    """Let COLMAP change the focal length, after mapping."""
    threads: int = -1
    """Threads; -1 for as many as there are cores. Mapping takes one, so that it gives the same again."""
    seed: int = 0
    """Of COLMAP's random sampling."""


@dataclass(frozen=True)
class FreePoses:
    """What structure from motion knows: a pose of its own for each frame, in a world of unknown scale.

    Rows of frames that are not ``used`` are nan. Pixels have their origin at the image's upper left corner, which is
    COLMAP's convention too.
    """

    names: tuple[str, ...]
    used: Bool[np.ndarray, "n"]
    world_to_camera: Float[np.ndarray, "n 4 4"]
    """OpenCV axes, COLMAP's scale."""
    focal_px: float
    centre_px: tuple[float, float]
    radial: tuple[float, float]
    """OpenCV's k1, k2."""
    places: Float[np.ndarray, "p 3"]
    """Points in COLMAP's world; ``tracks`` count them by row."""
    tracks: Tracks
    reprojection_error_px: float
    moving: Bool[np.ndarray, "h w"]
    """Where features were looked for."""


def structure_from_motion(
    images: Sequence[UInt8[np.ndarray, "h w"]],
    names: Sequence[str],
    config: StructureFromMotionConfig | None = None,
    *,
    moving: Bool[np.ndarray, "h w"] | None = None,
    focal_px: float | None = None,
) -> FreePoses:
    """Poses of the camera that, going round a fixed object, takes the images that the turntable gave.

    Args:
        images: one gray image a frame in the order of the turn, all of one size.
        names: the frames' names, for messages.
        config: settings; the defaults suit fruit of 512 x 512 pixels in 20 to 60 frames.
        moving: where features are looked for; found by ``moving_pixels`` if not given.
        focal_px: the focal length, if it is known.

    Raises:
        InputError: nothing moves, or the object has too little texture to pose three frames.
        ValueError: images of different sizes, or as many names as images are not given.
    """
    config = config or StructureFromMotionConfig()
    moving = _checked(images, names, config, moving)
    with _working_folder(images, moving) as folder:
        _match(folder, len(images), images[0].shape, config, focal_px)
        reconstruction = _map(folder, config)
        if reconstruction is None:
            raise _too_little_texture(names)
        return _free_poses(reconstruction, names, moving)


def matched_tracks(
    images: Sequence[UInt8[np.ndarray, "h w"]],
    names: Sequence[str],
    config: StructureFromMotionConfig | None = None,
    *,
    moving: Bool[np.ndarray, "h w"] | None = None,
) -> Tracks:
    """Features that several frames share, without any pose: where the turntable's angles are known, this is enough.

    Matches are joined to tracks; a track that comes to two places in one frame is a mistake and left out.

    Raises:
        InputError, ValueError: as ``structure_from_motion``.
    """
    config = config or StructureFromMotionConfig()
    moving = _checked(images, names, config, moving)
    with _working_folder(images, moving) as folder:
        _match(folder, len(images), images[0].shape, config, None)
        tracks = _joined(folder)
    if len(tracks) == 0:
        raise _too_little_texture(names)
    return tracks


def neighbour_pairs(frames: int, config: StructureFromMotionConfig) -> list[tuple[int, int]]:
    """Pairs of frames to match: up to ``neighbours_deg`` apart in a full turn, the last a neighbour of the first.

    Frames of a partial turn are nearer to each other than that, and its last and first frame do not match.
    """
    reach = max(config.fewest_neighbours, round(config.neighbours_deg * frames / 360.0))
    return [
        (i, j) for i in range(frames) for j in range(i + 1, frames) if min(j - i, frames - (j - i)) <= reach
    ]  # fmt: skip


def _checked(images, names, config, moving):
    """The mask of what moves, found if not given, after checks of what was given."""
    if len(images) != len(names) or len({image.shape for image in images}) > 1:
        raise ValueError("structure from motion needs images of one size and one name an image")
    if len(images) < FEWEST_FRAMES:
        raise InputError(
            f"{len(images)} frame(s) ({', '.join(names)}) cannot fix a turntable's axis; "
            f"give {FEWEST_FRAMES} or more frames of one session"
        )
    moving = moving_pixels(images, config.background) if moving is None else moving
    if not moving.any():
        raise InputError(
            f"nothing moves in the {len(images)} frames {names[0]} ... {names[-1]}; check that the turntable turned "
            "between the frames, and that the object has some texture"
        )
    return moving


def _too_little_texture(names):
    return InputError(
        f"the frames {names[0]} ... {names[-1]} show too little texture to find poses from features; take markers, "
        "smaller steps, or a band in which the object shows patterns"
    )


@contextmanager
def _working_folder(images, moving) -> Iterator[Path]:
    """A temporary folder with what COLMAP reads: the images stretched to the contrast of what moves, and the mask."""
    low, high = np.percentile(np.stack(images)[:, moving], _STRETCH_PERCENTILES)
    table = np.rint(np.clip((np.arange(256) - low) / max(high - low, 1.0), 0.0, 1.0) * 255.0).astype(np.uint8)
    with tempfile.TemporaryDirectory(prefix="hsi-sc-nerf-colmap-") as name:
        folder = Path(name)
        (folder / "images").mkdir()
        for i, image in enumerate(images):
            cv2.imwrite(str(folder / "images" / _file_name(i)), table[image])
        cv2.imwrite(str(folder / "mask.png"), moving.astype(np.uint8) * 255)
        yield folder


def _file_name(frame: int) -> str:
    return f"{frame:05d}.png"


def _frame_of(file_name: str) -> int:
    return int(Path(file_name).stem)


def _match(folder: Path, frames: int, shape: tuple[int, ...], config: StructureFromMotionConfig, focal_px) -> None:
    """Features of all images, and those that neighbours in the turn share, into the folder's database."""
    import pycolmap

    pycolmap.logging.minloglevel = _QUIET
    pycolmap.set_random_seed(config.seed)
    height, width = shape
    focal_px = config.focal_factor * width if focal_px is None else focal_px
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_PINHOLE"
    reader.camera_params = f"{focal_px},{width / 2},{height / 2}"
    reader.camera_mask_path = str(folder / "mask.png")
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = config.threads
    extraction.sift.peak_threshold = config.peak_threshold
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
    pairs = neighbour_pairs(frames, config)
    (folder / "pairs.txt").write_text("".join(f"{_file_name(i)} {_file_name(j)}\n" for i, j in pairs))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(folder / "pairs.txt")
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = config.threads
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = config.seed
    pycolmap.match_image_pairs(
        folder / "database.db",
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def _joined(folder: Path) -> Tracks:
    """Tracks of the verified matches in the folder's database."""
    import pycolmap

    with pycolmap.Database.open(folder / "database.db") as database:
        images = {image.image_id: _frame_of(image.name) for image in database.read_all_images()}
        places = {i: database.read_keypoints(i)[:, :2] for i in images}
        pairs, geometries = database.read_two_view_geometries()
    order = sorted(images, key=images.__getitem__)
    first = dict(zip(order, np.cumsum([0] + [len(places[i]) for i in order[:-1]]).tolist(), strict=True))
    links = [np.zeros((0, 2), int)]
    for pair, geometry in zip(pairs, geometries, strict=True):
        links.append(geometry.inlier_matches.astype(int) + [first[i] for i in pycolmap.pair_id_to_image_pair(pair)])
    a, b = np.concatenate(links).T
    frame = np.concatenate([np.full(len(places[i]), images[i]) for i in order])
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(frame), len(frame)))
    track = connected_components(graph, directed=False)[1]
    _, one, twice = np.unique(np.stack([track, frame]), axis=1, return_inverse=True, return_counts=True)
    contradicts = np.isin(track, track[twice[one.ravel()] > 1])
    keep = (np.bincount(track)[track] > 1) & ~contradicts
    _, point = np.unique(track[keep], return_inverse=True)
    return Tracks(frame[keep], point, np.concatenate([places[i] for i in order])[keep].astype(float))


def _map(folder: Path, config: StructureFromMotionConfig) -> pycolmap.Reconstruction | None:
    """The largest reconstruction from the folder's database; None where there is none of three frames."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = config.seed
    options.num_threads = 1
    options.multiple_models = False
    options.min_model_size = FEWEST_FRAMES
    options.extract_colors = False
    # One orbit round a small object hardly tells the focal length from the distance: free, it runs away.
    options.ba_refine_focal_length = False
    options.mapper.abs_pose_refine_focal_length = False
    found = pycolmap.incremental_mapping(folder / "database.db", folder / "images", folder, options)
    best = max(found.values(), key=lambda r: r.num_reg_images(), default=None)
    if best is None or best.num_reg_images() < FEWEST_FRAMES:
        return None
    if config.refine_focal:
        adjustment = pycolmap.BundleAdjustmentOptions()
        adjustment.print_summary = False
        pycolmap.bundle_adjustment(best, adjustment)
    return best


def _free_poses(reconstruction: pycolmap.Reconstruction, names, moving) -> FreePoses:
    ids = sorted(reconstruction.points3D)
    row = {point: i for i, point in enumerate(ids)}
    poses = np.full((len(names), 4, 4), np.nan)
    seen = []
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        frame = _frame_of(image.name)
        poses[frame] = np.eye(4)
        poses[frame, :3] = image.cam_from_world().matrix()
        seen += [(frame, row[p.point3D_id], *p.xy) for p in image.points2D if p.has_point3D()]
    rows = np.array(sorted(seen)).reshape(-1, 4)
    (camera,) = reconstruction.cameras.values()
    return FreePoses(
        names=tuple(names),
        used=np.isfinite(poses).all(axis=(1, 2)),
        world_to_camera=poses,
        focal_px=float(camera.focal_length),
        centre_px=(float(camera.principal_point_x), float(camera.principal_point_y)),
        radial=(0.0, 0.0),
        places=np.array([reconstruction.points3D[i].xyz for i in ids]).reshape(-1, 3),
        tracks=Tracks(rows[:, 0].astype(int), rows[:, 1].astype(int), rows[:, 2:]),
        reprojection_error_px=float(reconstruction.compute_mean_reprojection_error()),
        moving=moving,
    )
