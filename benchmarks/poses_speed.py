"""Time and errors of poses of one session: from markers, from features, and by COLMAP with its defaults.

    uv run python benchmarks/poses_speed.py

Every method gets the same gray images. COLMAP's defaults are exhaustive matching, no masks, and a free pose for every
frame. Errors are the largest over the posed frames, after the best similarity where the method has no scale.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import tyro
from jaxtyping import Float, UInt8
from pose_errors import align_poses, pose_errors, transformed_poses
from pose_hard_cases import Case, grey_images, scene_of
from results_table import RESULTS, write_results

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL
from hsi_sc_nerf.poses.pose_methods import PoseMethod, find_poses
from hsi_sc_nerf.simulate.frames import Simulation

COLUMNS = ("wall behind the pear", "method", "seconds", "frames", "rotation, deg", "position, mm")
SESSIONS = {
    "even": Case(frames=60),
    "patterned, noise, drift": Case(("textured_background", "photon_noise", "lamp_drift"), frames=60),
}
Images = Sequence[UInt8[np.ndarray, "h w"]]
Poses = Float[np.ndarray, "n 4 4"]


@dataclass(frozen=True)
class PosesSpeed:
    """Compare the methods of poses."""

    frames: int | None = None
    """Frames in the turn; 60 if not given."""
    size: int = 512
    """Width and height of the images, pixels."""
    defaults: bool = True
    """Run COLMAP with its defaults too."""
    limit_s: int = 150
    """Its mapping stops after this many seconds."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Simulate, estimate poses by every method, print the table, write it."""
        rows = []
        for wall, case in SESSIONS.items():
            simulation = Simulation(scene_of(case, self.size, self.frames))
            images = grey_images(simulation)
            info = SessionInfo(marker_side_m=simulation.scene.markers.side_m)
            methods: dict[str, Callable[[Images, list[str]], Poses]] = {
                "markers": partial(from_package, info=info, method="markers"),
                "features, this package": partial(from_package, info=info, method="colmap"),
            }
            if self.defaults:
                methods["COLMAP's defaults"] = partial(from_colmap_defaults, limit_s=self.limit_s)
            for method, estimate in methods.items():
                rows.append((wall, method, *measured(estimate, images, simulation, has_scale=method == "markers")))
                print(" | ".join(rows[-1]), flush=True)
        write_results("poses_speed", COLUMNS, rows, keys=2, folder=self.results)


def from_package(images: Images, names: list[str], *, info: SessionInfo, method: PoseMethod) -> Poses:
    """Poses as `hsi-sc-nerf process` finds them."""
    return find_poses(images, names, info, method, progress=False).camera_to_world


def from_colmap_defaults(images: Images, names: list[str], *, limit_s: int) -> Poses:
    """COLMAP with its defaults: one camera, exhaustive matching, the largest reconstruction of those made in time."""
    import pycolmap

    pycolmap.logging.minloglevel = 3
    poses = np.full((len(images), 4, 4), np.nan)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "images").mkdir()
        for i, image in enumerate(images):
            cv2.imwrite(str(folder / "images" / f"{i:05d}.png"), image)
        database = folder / "database.db"
        pycolmap.extract_features(database, folder / "images", camera_mode=pycolmap.CameraMode.SINGLE)
        pycolmap.match_exhaustive(database)
        options = pycolmap.IncrementalPipelineOptions()
        options.max_runtime_seconds = limit_s
        found = pycolmap.incremental_mapping(database, folder / "images", folder, options)
    best = max(found.values(), key=lambda r: r.num_reg_images(), default=None)
    for image in best.images.values() if best else ():
        if image.has_pose:
            world_to_camera = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
            poses[int(Path(image.name).stem)] = np.linalg.inv(world_to_camera) @ OPENCV_TO_OPENGL
    return poses


def measured(
    estimate: Callable[[Images, list[str]], Poses], images: Images, simulation: Simulation, has_scale: bool
) -> tuple[str, ...]:
    """Seconds of an estimate, the number of frames that it poses, and its largest errors."""
    started = time.perf_counter()
    try:
        poses = estimate(images, simulation.captures)
    except InputError:
        poses = np.full((len(images), 4, 4), np.nan)
    seconds = time.perf_counter() - started
    used = np.isfinite(poses).all(axis=(1, 2))
    found, true = poses[used], simulation.camera_to_world[used]
    cells = f"{seconds:.0f}", str(used.sum())
    if len(found) < 3:
        return (*cells, "", "")
    if not has_scale:
        found = transformed_poses(align_poses(found, true), found)
    rotation_deg, position_mm = pose_errors(found, true)
    return (*cells, f"{rotation_deg.max():.2f}", f"{position_mm.max():.2f}")


if __name__ == "__main__":
    tyro.cli(PosesSpeed).main()
