"""Poses of one session from markers, from features our way, and from COLMAP with its defaults: how long, how right.

    uv run python benchmarks/poses_speed.py --output-dir /tmp/poses

A turn is simulated twice, before an even wall and before a patterned one, and every method gets the same gray images.
COLMAP's defaults are exhaustive matching, no masks, and every frame a pose of its own.
"""

from __future__ import annotations

import json
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
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.capture.session import Session, open_session
from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL
from hsi_sc_nerf.poses.pose_methods import PoseMethod, find_poses
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import Truth, load_truth
from hsi_sc_nerf.spectra.pseudo_rgb import bands_within, to_8_bit

GRAY_RANGE_NM = (450.0, 700.0)
WALL = ("textured_background",)
# Right is what meets the targets without markers.
RIGHT_DEG, RIGHT_MM = 0.3, 1.5
Images = Sequence[UInt8[np.ndarray, "h w"]]
Poses = Float[np.ndarray, "n 4 4"]


@dataclass(frozen=True)
class PosesSpeed:
    """Compare the ways to poses in one run."""

    output_dir: Path
    """Folder for the simulated sessions and for table.json."""
    session: Path | None = None
    """A simulated session of your own instead of both."""
    scene: str = "pear"
    """What stands on the turntable."""
    frames: int = 60
    """Frames in the turn."""
    size: int = 512
    """Width and height of the images, pixels."""
    bands: int = 8
    """Spectral bands; the gray image needs few."""
    plain: bool = True
    """Run COLMAP with its defaults too."""
    plain_limit_s: int = 300
    """Its mapping is told to stop after this many seconds."""

    def main(self) -> None:
        """Simulate what is missing, estimate poses by every method, print the table and write table.json."""
        self.output_dir.mkdir(parents=True, exist_ok=True)
        sessions = (
            {"given": self.session} if self.session else {"even": self._made(()), "patterned": self._made(WALL)}
        )
        table = Table("background", "method", "wall, s", "CPU, s", "frames", "rotation, °", "position, mm", "right")
        rows = []
        for background, path in sessions.items():
            session, truth = open_session(path), load_truth(path)
            images, names = gray_images(session), [frame.name for frame in session.frames]
            for method, (estimate, has_scale) in self._methods(truth).items():
                row = {
                    "background": background,
                    "method": method,
                    **measured(estimate, images, names, truth, has_scale),
                }
                rows.append(row)
                (self.output_dir / "table.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
                table.add_row(*(f"{v:.2f}" if isinstance(v, float) else str(v) for v in row.values()))
        Console().print(table)

    def _made(self, effects: tuple[str, ...]) -> Path:
        path = self.output_dir / "-".join((self.scene, *effects))
        scene = override(
            load_scene(self.scene), frames=self.frames, size_px=self.size, bands=self.bands, effects=effects
        )
        return simulate_session(scene, path)

    def _methods(self, truth: Truth) -> dict[str, tuple[Callable[[Images, list[str]], Poses], bool]]:
        side_m = float(np.linalg.norm(np.diff(next(iter(truth.marker_layout.values()))[:2], axis=0)))
        info = SessionInfo(marker_side_m=side_m)

        def by(method: PoseMethod) -> Callable[[Images, list[str]], Poses]:
            return lambda images, names: find_poses(images, names, info, method, progress=False).camera_to_world

        methods = {"markers": (by("markers"), True), "features": (by("colmap"), False)}
        plain = partial(from_colmap_defaults, limit_s=self.plain_limit_s)
        return {**methods, "COLMAP's defaults": (plain, False)} if self.plain else methods


def gray_images(session: Session) -> list[UInt8[np.ndarray, "h w"]]:
    """Gray images of a simulated session: its tarp is even and its dark level has no pattern."""
    assert session.white is not None
    assert session.white.dark is not None
    bands = bands_within(session.wavelengths_nm, GRAY_RANGE_NM)
    dark = session.white.dark.memmap()[..., bands].mean(axis=(0, 1))
    tarp = session.white.cube.memmap()[..., bands]
    lines, samples = tarp.shape[:2]
    middle = tarp[lines // 4 : 3 * lines // 4, samples // 4 : 3 * samples // 4]
    white = middle.mean(axis=(0, 1)) - dark
    return [to_8_bit(((f.cube.memmap()[..., bands] - dark) / white).mean(axis=-1)) for f in session.frames]


def from_colmap_defaults(images: Images, names: list[str], *, limit_s: int) -> Poses:
    """COLMAP as it comes: one camera, exhaustive matching, the largest reconstruction of those made in time."""
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
    estimate: Callable[[Images, list[str]], Poses], images: Images, names: list[str], truth: Truth, has_scale: bool
) -> dict[str, float | int | str]:
    """Times of an estimate, how many frames it poses, and its largest errors."""
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        poses = estimate(images, names)
    except InputError:
        poses = np.full((len(images), 4, 4), np.nan)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    used = np.isfinite(poses).all(axis=(1, 2))
    rotation_deg, position_mm = pose_errors(poses[used], truth.camera_to_world[used], has_scale)
    right = bool(used.all()) and rotation_deg < RIGHT_DEG and position_mm < RIGHT_MM
    return {
        "wall_s": wall,
        "cpu_s": cpu,
        "frames": int(used.sum()),
        "rotation_deg": rotation_deg,
        "position_mm": position_mm,
        "right": "yes" if right else "no",
    }


def pose_errors(found: Poses, true: Poses, has_scale: bool) -> tuple[float, float]:
    """Largest errors of rotation (degrees) and place (millimetres); without a scale after the best similarity."""
    if len(found) < 3:
        return np.nan, np.nan
    rotations = Rotation.from_matrix(true[:, :3, :3]) * Rotation.from_matrix(found[:, :3, :3]).inv()
    positions, true_positions = found[:, :3, 3], true[:, :3, 3]
    if not has_scale:
        turn = rotations.mean()
        rotations = rotations * turn.inv()
        positions = turn.apply(positions - positions.mean(axis=0))
        true_positions = true_positions - true_positions.mean(axis=0)
        positions = positions * (positions * true_positions).sum() / max(float((positions**2).sum()), 1e-12)
    rotation_deg = float(np.rad2deg(rotations.magnitude().max()))
    return rotation_deg, 1e3 * float(np.linalg.norm(positions - true_positions, axis=-1).max())


if __name__ == "__main__":
    tyro.cli(PosesSpeed).main()
