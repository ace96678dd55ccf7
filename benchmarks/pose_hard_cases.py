"""How good poses from markers are in hard cases, on simulated sessions with known truth, as a table.

    uv run python benchmarks/pose_hard_cases.py --page docs/poses.md

Each case is a session with one thing that makes it hard. Printed are the largest errors over the used frames of the
camera's rotation and place, the error of the focal length, the reprojection error, and what the report warns of.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import tyro
from jaxtyping import Float, UInt8
from page import write_table
from rich.console import Console
from rich.table import Table

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import rotation_about_z, rotation_angle_deg
from hsi_sc_nerf.poses.pose_methods import find_poses
from hsi_sc_nerf.poses.report import pose_report
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import Scene, load_scene, override
from hsi_sc_nerf.spectra.pseudo_rgb import to_8_bit

TABLE = "markers table"
COLUMNS = (
    "case",
    "frames",
    "rotation, deg",
    "place, mm",
    "focal, %",
    "reprojection, px",
    "time, s",
    "model; warnings",
)
WORKERS = 2
Images = list[UInt8[np.ndarray, "h w"]]


@dataclass(frozen=True)
class Case:
    """A session that is hard to pose."""

    effects: tuple[str, ...] = ()
    """Of the simulator."""
    scene: str = "pear"
    frames: int = 24
    size: float = 1.0
    """Of the images, as a share of the usual size."""
    changes: dict[str, dict[str, float]] = field(default_factory=dict)
    """To parts of the scene."""
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
    "wobble of 0.3 degrees": Case(("wobble",), frames=36, any_axis=True),
    "wobble of 1 degree": Case(("{wobble: {amplitude_deg: 1}}",), frames=36, any_axis=True),
}


@dataclass(frozen=True)
class Posed:
    """Poses of a simulated session beside the truth."""

    simulation: Simulation
    poses: TurntablePoses
    truth: Float[np.ndarray, "n 4 4"]
    """True poses of the used frames, in the estimate's object frame."""
    seconds: float

    @property
    def rotation_deg(self) -> Float[np.ndarray, "n"]:
        """Errors of the used frames' rotations."""
        found = self.poses.camera_to_world[self.poses.used]
        return np.array([rotation_angle_deg(a, b) for a, b in zip(found, self.truth, strict=True)])

    @property
    def place_mm(self) -> Float[np.ndarray, "n"]:
        """Errors of the used frames' places."""
        found = self.poses.camera_to_world[self.poses.used]
        return 1e3 * np.linalg.norm(found[:, :3, 3] - self.truth[:, :3, 3], axis=-1)

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
    info = SessionInfo(
        marker_dictionary=scene.markers.dictionary,
        marker_side_m=scene.markers.side_m,
        nominal_step_deg=simulation.plan.nominal_step_deg,
        direction=simulation.plan.direction,
        container_diameter_m=scene.container.diameter_m,
        container_height_m=scene.container.height_m,
    )
    started = time.perf_counter()
    poses = find_poses(images, simulation.captures, info, "markers", progress=False)
    seconds = time.perf_counter() - started
    found, truth = poses.camera_to_world[poses.used], simulation.camera_to_world[poses.used]
    azimuth = np.rad2deg(np.arctan2(truth[0, 1, 3], truth[0, 0, 3]))
    truth = rotation_about_z(-azimuth) @ truth  # x points to the first used frame's camera
    if case.any_axis:
        truth = _aligned(truth, found)
    if case.any_height:
        truth[:, 2, 3] += np.mean(found[:, 2, 3] - truth[:, 2, 3])
    return Posed(simulation, poses, truth, seconds)


def _aligned(truth, found):
    """The truth moved rigidly on to the found poses."""
    u, _, vt = np.linalg.svd((found[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], 1, 2)).sum(axis=0))
    move = np.eye(4)
    move[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    move[:3, 3] = (found[:, :3, 3] - truth[:, :3, 3] @ move[:3, :3].T).mean(axis=0)
    return move @ truth


@dataclass(frozen=True)
class PoseHardCases:
    """Measure poses from markers in hard cases."""

    size: int = 512
    """Width and height of the images, pixels; some cases take a share of it."""
    cases: tuple[str, ...] = tuple(CASES)
    """Which cases."""
    page: Path | None = None
    """Markdown page whose table is replaced."""

    def main(self) -> None:
        """Measure, print the table, write it into the page."""
        rows, console = [], Console(width=170)
        for name in self.cases:
            rows.append((name, *self._measure(CASES[name])))
            console.print(" | ".join(rows[-1]), highlight=False)
        shown = Table(*COLUMNS)
        for cells in rows:
            shown.add_row(*cells)
        console.print(shown)
        if self.page is not None:
            write_table(self.page, TABLE, COLUMNS, rows)

    def _measure(self, case: Case) -> tuple[str, ...]:
        try:
            posed = pose(case, self.size)
        except InputError as error:
            return ("0", "", "", "", "", "", f"refused: {error}")
        poses = posed.poses
        return (
            f"{poses.used.sum()} of {len(poses.names)}",
            f"{posed.rotation_deg.max():.3f}",
            f"{posed.place_mm.max():.2f}",
            f"{posed.focal_percent:+.3f}",
            f"{poses.overall_error_px:.3f}",
            f"{posed.seconds:.0f}",
            "; ".join([poses.model, *pose_report(poses)["warnings"]]),
        )


if __name__ == "__main__":
    tyro.cli(PoseHardCases).main()
