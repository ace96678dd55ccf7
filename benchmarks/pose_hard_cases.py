"""Largest errors of poses from markers in hard cases.

    uv run python benchmarks/pose_hard_cases.py

Each case is a simulated session with one thing that makes it hard; errors are those against its true poses, over the
used frames. "Size" is how much too large an object on the axis comes out, by distance and focal length together.
benchmarks/poses_without_markers.py measures poses from features.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import tyro
from jaxtyping import Float, UInt8
from results_table import Benchmark, write_results
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import rotation_about_z, rotation_angle_deg
from hsi_sc_nerf.poses.pose_methods import find_poses
from hsi_sc_nerf.poses.report import check_poses
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import Scene, load_scene, override
from hsi_sc_nerf.spectra import to_8_bit

COLUMNS = (
    "case",
    "frames",
    "rotation, deg",
    "position, mm",
    "focal, %",
    "size, %",
    "reprojection, px",
    "time, s",
    "model; warnings",
)
WORKERS = 2
OBJECT_HEIGHT_M = 0.12
"""Height of the middle of the simulator's fruit."""
Images = list[UInt8[np.ndarray, "h w"]]


@dataclass(frozen=True)
class Case:
    """A session that is hard to pose."""

    effects: tuple[str, ...] = ()
    """Effects of the simulator."""
    scene: str = "pear"
    frames: int = 24
    size: float = 1.0
    """Size of the images, as a fraction of the usual size."""
    changes: dict[str, dict[str, float]] = field(default_factory=dict)
    """Changes to parts of the scene."""
    alter: Callable[[Images], Images] | None = None
    """What is done to the images."""
    any_axis: bool = False
    """A wobbling table has no axis but a mean one, and the truth's is another: compare after a rigid alignment."""
    any_height: bool = False
    """Without markers on the disc the origin's height is arbitrary."""


def blur_some(images: Images) -> Images:
    """Every fifth frame out of focus, by a hundredth of its width."""
    sigma_px = images[0].shape[1] / 150.0
    return [cv2.GaussianBlur(im, (0, 0), sigma_px) if i % 5 == 3 else im for i, im in enumerate(images)]


def hide_some(images: Images) -> Images:
    """In two frames a hand is before the turntable."""
    hidden = [image.copy() for image in images]
    for i in (2, 7):
        hidden[i][hidden[i].shape[0] // 3 :] = 120
    return hidden


def bump_one(images: Images) -> Images:
    """The camera is pushed aside for one frame, by a hundredth of its width."""
    height, width = images[0].shape
    aside = np.array([[1.0, 0.0, width / 100.0], [0.0, 1.0, -width / 150.0]])
    bumped = cv2.warpAffine(images[5], aside, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return [bumped if i == 5 else image for i, image in enumerate(images)]


CASES = {
    "even turn": Case(),
    "partial turn (200 degrees)": Case(("{partial_turn: {span_deg: 200}}",)),
    "uneven steps (1 degree)": Case(("angle_jitter",)),
    "clockwise": Case(("clockwise",)),
    "a missing and a repeated frame": Case(("{missing_frames: {count: 1}}", "{repeated_frames: {count: 1}}")),
    "camera rolled by 5 degrees": Case(("{axis_tilt: {tilt_deg: 5}}",)),
    "disc 10 mm off the axis": Case(("{off_centre: {shift_m: 0.01}}",)),
    "one or two markers visible": Case(
        frames=36, changes={"markers": {"on_container": 3, "on_disc": 0}}, any_height=True
    ),
    "markers hidden by the object": Case(
        scene="apple", changes={"container": {"diameter_m": 0.07, "height_m": 0.055}, "markers": {"on_container": 4}}
    ),
    "blurred and noisy": Case(("{optical_blur: {sigma_px: 1.5}}", "photon_noise", "{read_noise: {electrons: 300}}")),
    "every fifth frame out of focus": Case(alter=blur_some),
    "two frames covered": Case(alter=hide_some),
    "camera bumped in one frame": Case(alter=bump_one),
    "textured background": Case(("textured_background",)),
    "20 frames": Case(frames=20),
    "markers of 20 px": Case(frames=36, size=0.273),
    "markers of 14 px": Case(frames=36, size=0.1914),
    "markers of 10 px": Case(frames=36, size=0.1367),
    "markers of 8 px": Case(frames=36, size=0.1094),
    "markers of 6 px": Case(frames=36, size=0.082),
    "no texture": Case(scene="sphere"),
    "lamp, gloss and shadows": Case(("lamp", "gloss", "chamber_shading")),
    "lens distortion (k1 -0.15)": Case(("lens_distortion",)),
    "128 px": Case(("photon_noise",), frames=60, size=0.25),
    "128 px, the chamber's shade": Case(("photon_noise", "chamber_shading"), frames=60, size=0.25),
    "128 px, shade, k1 -0.03": Case(
        ("photon_noise", "chamber_shading", "{lens_distortion: {k1: -0.03}}"), frames=60, size=0.25
    ),
    "wobble of 0.3 degrees": Case(("wobble",), frames=36, any_axis=True),
    "wobble of 1 degree": Case(("{wobble: {amplitude_deg: 1}}",), frames=36, any_axis=True),
}


@dataclass(frozen=True)
class Posed:
    """Poses of a simulated session beside the truth.

    Attributes:
        simulation: the session.
        info: what is known of it.
        poses: of its frames.
        rotation_deg: errors of the used frames' rotations.
        position_mm: errors of the used frames' positions.
        size_percent: how much too large an object on the axis, `OBJECT_HEIGHT_M` up, comes out.
        seconds: wall time.
    """

    simulation: Simulation
    info: SessionInfo
    poses: TurntablePoses
    rotation_deg: Float[np.ndarray, "n"]
    position_mm: Float[np.ndarray, "n"]
    size_percent: float
    seconds: float

    @property
    def focal_percent(self) -> float:
        """Error of the focal length."""
        return 100.0 * (self.poses.intrinsics.fl_x / self.simulation.intrinsics.fl_x - 1.0)


def scene_of(case: Case, size_px: int, frames: int | None = None) -> Scene:
    """The case's scene at an image size; fewer frames where given."""
    scene = override(
        load_scene(case.scene),
        frames=frames or case.frames,
        size_px=round(case.size * size_px),
        bands=6,
        effects=case.effects,
    )
    return replace(scene, **{part: replace(getattr(scene, part), **to) for part, to in case.changes.items()})


def grey_images(simulation: Simulation) -> Images:
    """The frames' mean reflectance from 450 to 700 nm, as `process` looks for markers in it."""
    visible = (simulation.wavelengths_nm >= 450.0) & (simulation.wavelengths_nm <= 700.0)

    def signal(capture) -> Float[np.ndarray, "h w bands"]:
        return capture.counts[..., visible].astype(np.float32) - capture.dark[..., visible].mean(0, dtype=np.float32)

    edge = simulation.scene.camera.size_px // 4
    white = np.median(signal(simulation.white())[edge:-edge, edge:-edge], axis=(0, 1))
    with ThreadPoolExecutor(WORKERS) as pool:
        frames = range(len(simulation.captures))
        return list(pool.map(lambda i: to_8_bit((signal(simulation.frame(i)) / white).mean(axis=-1)), frames))


def pose(case: Case, size_px: int, frames: int | None = None) -> Posed:
    """Simulate a case and pose it.

    Raises:
        InputError: the frames cannot be posed.
    """
    scene = scene_of(case, size_px, frames)
    simulation = Simulation(scene)
    images = grey_images(simulation)
    if case.alter is not None:
        images = case.alter(images)
    info = known_info(simulation)
    started = time.perf_counter()
    poses = find_poses(images, simulation.captures, info, "markers")
    seconds = time.perf_counter() - started
    found, truth = poses.camera_to_world[poses.used], simulation.camera_to_world[poses.used]
    azimuth = np.rad2deg(np.arctan2(truth[0, 1, 3], truth[0, 0, 3]))
    truth = rotation_about_z(-azimuth) @ truth  # x points to the first used frame's camera
    if case.any_axis:
        truth = aligned_poses(truth, found)
    if case.any_height:
        truth[:, 2, 3] += np.mean(found[:, 2, 3] - truth[:, 2, 3])
    middle = np.array([0.0, 0.0, OBJECT_HEIGHT_M])
    distance, true_distance = (np.linalg.norm(of[:, :3, 3] - middle, axis=1).mean() for of in (found, truth))
    magnified = poses.intrinsics.fl_x / simulation.intrinsics.fl_x
    size_percent = 100.0 * (distance / true_distance / magnified - 1.0)
    return Posed(simulation, info, poses, *pose_errors(found, truth), size_percent, seconds)


def pose_errors(
    found: Float[np.ndarray, "n 4 4"], true: Float[np.ndarray, "n 4 4"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Errors of rotation (degrees) and position (millimetres) of each camera-to-world pose (metres)."""
    degrees = np.array([rotation_angle_deg(a, b) for a, b in zip(found, true, strict=True)])
    return degrees, 1e3 * np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=-1)


def aligned_poses(
    poses: Float[np.ndarray, "n 4 4"], reference: Float[np.ndarray, "n 4 4"]
) -> Float[np.ndarray, "n 4 4"]:
    """Camera-to-world poses (metres) moved rigidly onto a reference: first by orientations, then by positions."""
    turn = np.eye(4)
    relative = reference[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)
    turn[:3, :3] = Rotation.from_matrix(relative).mean().as_matrix()
    moved = turn @ poses
    moved[:, :3, 3] += (reference - moved)[:, :3, 3].mean(axis=0)
    return moved


def known_info(simulation: Simulation) -> SessionInfo:
    """What a laboratory would note of a session."""
    scene = simulation.scene
    return SessionInfo(
        marker_dictionary=scene.markers.dictionary,
        marker_side_m=scene.markers.side_m,
        nominal_step_deg=simulation.plan.nominal_step_deg,
        direction=simulation.plan.direction,
        container_diameter_m=scene.container.diameter_m,
        container_height_m=scene.container.height_m,
    )


@dataclass(frozen=True)
class PoseHardCases(Benchmark):
    """Measure poses in hard cases."""

    size: int = 512
    """Width and height of the images, pixels; some cases take a fraction of it."""
    cases: tuple[str, ...] = ()
    """Which cases; all if not given."""

    def main(self) -> None:
        """Measure, print the table, write it."""
        rows = []
        for name in self.cases or CASES:
            try:
                measured = _cells(pose(CASES[name], self.size))
            except InputError as error:
                measured = ("0", *[""] * (len(COLUMNS) - 3), f"refused: {error}")
            rows.append((name, *measured))
            print(" | ".join(rows[-1]), flush=True)
        write_results("pose_hard_cases", COLUMNS, rows, keys=1, folder=self.results)


def _cells(posed: Posed) -> tuple[str, ...]:
    poses = posed.poses
    return (
        f"{poses.used.sum()} of {len(poses.names)}",
        f"{posed.rotation_deg.max():.3f}",
        f"{posed.position_mm.max():.2f}",
        f"{posed.focal_percent:+.3f}",
        f"{posed.size_percent:+.3f}",
        f"{poses.overall_error_px:.3f}",
        f"{posed.seconds:.0f}",
        "; ".join([poses.model, *(f.sentence for f in check_poses(poses, posed.info) if f.level != "green")]),
    )


if __name__ == "__main__":
    tyro.cli(PoseHardCases).main()
