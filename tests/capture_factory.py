"""Small capture sessions with known reflectance, for tests of everything between raw cubes and packed datasets.

A sphere with a plant's spectrum stands above a container's lid before a flat background; the counts are exact.
"""

import json
from pathlib import Path

import numpy as np

from hsi_sc_nerf.capture.envi import write_cube
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, pixel_rays, turntable_camera_to_world
from hsi_sc_nerf.packed.dataset import PackedFrame
from hsi_sc_nerf.poses.result import TurntablePoses

BANDS = 12
WAVELENGTHS_NM = np.linspace(400.0, 1000.0, BANDS)
LAMP = 2000.0 + 200.0 * np.arange(BANDS)
DARK = 100
SIZE_PX = 48
INTRINSICS = PinholeIntrinsics(SIZE_PX, SIZE_PX, 90.0, 90.0, SIZE_PX / 2, SIZE_PX / 2)
SPHERE_CENTRE_M = np.array([0.0, 0.005, 0.11])
SPHERE_RADIUS_M = 0.04
PLANT = np.where(WAVELENGTHS_NM < 700.0, 0.1, 0.6)
BACKGROUND = 0.8
INFO = {
    "object": "ball",
    "marker_side_m": 0.02,
    "container_diameter_m": 0.09,
    "container_height_m": 0.07,
}


def true_pose(angle_deg: float) -> np.ndarray:
    return turntable_camera_to_world(look_at([0.4, 0.0, 0.25], [0.0, 0.0, 0.1]), angle_deg)


def sphere_mask(
    camera_to_world: np.ndarray,
    intrinsics: PinholeIntrinsics = INTRINSICS,
    centre_m: np.ndarray = SPHERE_CENTRE_M,
    radius_m: float = SPHERE_RADIUS_M,
) -> np.ndarray:
    x, y = np.meshgrid(np.arange(intrinsics.w) + 0.5, np.arange(intrinsics.h) + 0.5)
    origin, directions = pixel_rays(intrinsics, camera_to_world, np.stack([x, y], axis=-1))
    towards = centre_m - origin
    along = directions @ towards
    return towards @ towards - along**2 < radius_m**2


def frame_reflectance(angle_deg: float) -> np.ndarray:
    return np.where(sphere_mask(true_pose(angle_deg))[..., None], PLANT, BACKGROUND)


def expose(reflectance: np.ndarray) -> np.ndarray:
    return np.rint(reflectance * LAMP + DARK).astype(np.uint16)


def write_capture(
    folder: Path, name: str, counts: np.ndarray, *, specim: bool = True, wavelengths_nm: np.ndarray = WAVELENGTHS_NM
) -> Path:
    """A capture with a dark cube of two lines; returns its header."""
    base = folder / name / "capture" if specim else folder
    dark = np.full((2, counts.shape[1], counts.shape[2]), DARK, np.uint16)
    write_cube(base / f"{name}.hdr", counts, wavelengths_nm=wavelengths_nm)
    write_cube(base / f"DARKREF_{name}.hdr", dark, wavelengths_nm=wavelengths_nm)
    return base / f"{name}.hdr"


def write_session(folder: Path, angles_deg=(0.0, 90.0, 180.0, 270.0), *, specim: bool = True, info=INFO) -> Path:
    """Frames ``ball_1``, ``ball_2`` ..., the tarp and ``session.json``."""
    for number, angle in enumerate(angles_deg, start=1):
        write_capture(folder, f"ball_{number}", expose(frame_reflectance(angle)), specim=specim)
    write_capture(folder, "white_reference", expose(np.ones((SIZE_PX, SIZE_PX, BANDS))), specim=specim)
    if info is not None:
        (folder / "session.json").write_text(json.dumps(info))
    return folder


def true_poses(images, names, *, unused=(), angles_deg=(0.0, 90.0, 180.0, 270.0), **_) -> TurntablePoses:
    """Stands in for the pose estimate: the poses that the frames were made with."""
    used = np.array([name not in unused for name in names])
    side = 0.02 * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    return TurntablePoses(
        names=tuple(names),
        intrinsics=INTRINSICS,
        distortion=(0.0, 0.0, 0.0, 0.0),
        camera_to_world=np.stack([true_pose(angle) for angle in angles_deg]),
        angles_deg=np.array(angles_deg),
        reprojection_error_px=np.full(len(names), 0.1),
        used=used,
        marker_corners_m={0: side + np.array([0.06, 0, 0]), 1: side - np.array([0.09, 0, 0])},
        dropped=dict.fromkeys(unused, "hidden"),
        dictionary="DICT_5X5_50",
        markers_per_frame=(2,) * len(names),
        overall_error_px=0.1,
        blur_px=0.5,
        disc_markers=(0, 1),
        disc_tilt_deg=0.0,
        loop_closure_deg=0.0,
    )


def packed_frame(root: Path, capture: str, camera_to_world: np.ndarray | None = None, **known) -> PackedFrame:
    """A frame of a packed dataset whose files lie where `process` puts them; they need not be there."""
    return PackedFrame(
        capture=capture,
        image_path=root / "images" / f"{capture}.png",
        mask_path=root / "masks" / f"{capture}.png",
        cube_path=root / "cubes" / f"{capture}.hdr",
        flags_path=root / "flags" / f"{capture}.png",
        camera_to_world=np.eye(4) if camera_to_world is None else camera_to_world,
        **{"angle_deg": 0.0, "reprojection_error_px": None, **known},
    )
