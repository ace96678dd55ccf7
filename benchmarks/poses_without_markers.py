"""Errors of poses without markers beside what is stated, by object and by what is known of the session.

    uv run python benchmarks/poses_without_markers.py FOLDER
    uv run python benchmarks/poses_without_markers.py FOLDER --objects "quince, path-traced"

The objects are those of our simulator and the path-traced fruit of benchmarks/path_traced_scene.py. Each is rendered
without markers, and once with markers for comparison. FOLDER keeps the pictures and what COLMAP found in them, which
are used again: take an empty one after a change of either.

Errors are the largest over the used frames, as what is stated. The origin's height is not compared where neither
markers nor the container show the disc.
Where nothing gives the scale, lengths are compared in units of the camera's distance. The size is that of the object:
the camera's distance over its focal length.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from independent_session import BANDS, lamp_drift
from jaxtyping import Float, UInt8
from path_traced_scene import (
    CONTAINER_HEIGHT_M,
    CONTAINER_RADIUS_M,
    DICTIONARY,
    MARKER_SIDE_M,
    PathTracedScene,
    camera_pose,
    stop_angles_deg,
)
from pose_hard_cases import Case, grey_images, known_info, pose_errors, scene_of
from results_table import Benchmark, write_results
from rich.progress import track

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, rotation_about_z
from hsi_sc_nerf.poses.feature_poses import KnownCamera, poses_from_sfm
from hsi_sc_nerf.poses.pose_methods import find_poses
from hsi_sc_nerf.poses.report import check_poses
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.poses.structure_from_motion import FreePoses, structure_from_motion
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.spectra import to_8_bit

COLUMNS = (
    "object",
    "known",
    "rotation, deg",
    "stated, deg",
    "position, mm",
    "stated, mm",
    "focal, %",
    "stated focal, %",
    "size, %",
    "stated size, %",
    "goal",
    "findings",
)
FRAMES = 36
GOAL = (0.3, 1.5, 0.5)
"""Degrees, millimetres, percent of the size."""
PICTURE_NM = np.array([[470.0, 560.0, 640.0]])
"""Wavelengths of the path-traced picture."""
SPOTS, RAYS, RAYS_FOR_MARKERS = 500, 20, 9
LIGHT = ("textured_background", "photon_noise", "lamp", "gloss")
SIMULATED = {
    "pear": Case(("textured_background",), frames=FRAMES),
    "pear, gloss": Case(LIGHT, frames=FRAMES),
    "apple, gloss": Case(LIGHT, "apple", FRAMES),
    "maize": Case(("textured_background",), "maize", FRAMES),
    "maize, gloss": Case(LIGHT, "maize", FRAMES),
}
PATH_TRACED = {"quince, path-traced": 17.0, "quince, path-traced, wider lens": 24.0}
"""Field of view over the image's width, degrees: container and fruit fill the picture, or the markers on the disc."""


@dataclass(frozen=True, eq=False)
class KnownSession:
    """Pictures of a session, its true camera and poses, and all that a laboratory could note of it."""

    images: list[UInt8[np.ndarray, "h w"]]
    focal_px: float
    camera_to_world: Float[np.ndarray, "n 4 4"]
    info: SessionInfo

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the frames."""
        return tuple(f"frame_{i:03d}" for i in range(len(self.images)))

    @property
    def distance_m(self) -> float:
        """Distance of the camera from the axis."""
        return float(np.linalg.norm(self.camera_to_world[0, :2, 3]))

    @property
    def camera(self) -> KnownCamera:
        """What is known of the camera from an earlier session."""
        height, width = self.images[0].shape
        lens = PinholeIntrinsics(width, height, self.focal_px, self.focal_px, width / 2.0, height / 2.0)
        return KnownCamera(lens, (0.0, 0.0, 0.0, 0.0), self.camera_to_world[0])


def simulated(case: Case, size_px: int, markers: bool) -> KnownSession:
    """A session of our simulator."""
    if not markers:
        case = replace(case, changes={"markers": {"on_container": 0, "on_disc": 0}})
    simulation = Simulation(scene_of(case, size_px))
    info = known_info(simulation)
    return KnownSession(grey_images(simulation), simulation.intrinsics.fl_x, simulation.camera_to_world, info)


def path_traced(field_of_view_deg: float, size_px: int, markers: bool) -> KnownSession:
    """The path-traced session, whose lamps drift."""
    scene = PathTracedScene(
        PICTURE_NM,
        size_px,
        RAYS_FOR_MARKERS if markers else RAYS,
        spots=SPOTS,
        markers=markers,
        field_of_view_deg=field_of_view_deg,
        sampler="multijitter",
    )
    angles_deg = stop_angles_deg(FRAMES, np.random.default_rng(0))
    drift = lamp_drift(FRAMES)[:, np.argmin(np.abs(BANDS - PICTURE_NM.mean()))]
    white = float(np.median(replace(scene, size_px=32).tarp(1000)))
    images = [
        to_8_bit(drift[i] * scene.radiance(angles_deg[i], i).mean(axis=-1) / white)
        for i in track(range(FRAMES), "rendering")
    ]
    info = SessionInfo(
        marker_dictionary=DICTIONARY,
        marker_side_m=MARKER_SIDE_M,
        nominal_step_deg=360.0 / FRAMES,
        direction="cw",
        container_diameter_m=2.0 * CONTAINER_RADIUS_M,
        container_height_m=CONTAINER_HEIGHT_M,
    )
    return KnownSession(images, scene.focal_px, np.stack([camera_pose(a) for a in angles_deg]), info)


@dataclass(frozen=True)
class PosesWithoutMarkers(Benchmark):
    """Measure poses without markers."""

    folder: tyro.conf.Positional[Path]
    """Keeps the pictures and what COLMAP found."""
    objects: tuple[str, ...] = (*SIMULATED, *PATH_TRACED)
    """Which objects."""
    size: int = 384
    """Width and height of the images, pixels."""

    def main(self) -> None:
        """Measure, print the table, write it."""
        for name in self.objects:
            session = self._session(name, markers=False)
            for known, (info, camera) in what_is_known(session).items():
                from_sfm = partial(poses_from_sfm, free=self._free_poses(name, session, camera))
                self._write(name, known, _cells(session, info, camera, from_sfm))
            session = self._session(name, markers=True)
            self._write(name, "markers", _cells(session, session.info, None, None))

    def _write(self, name: str, known: str, cells: tuple[str, ...]) -> None:
        write_results("poses_without_markers", COLUMNS, [(name, known, *cells)], keys=2, folder=self.results)

    def _free_poses(self, name: str, session: KnownSession, camera: KnownCamera | None) -> FreePoses:
        """What COLMAP finds in the session, with the focal length where it is known, unless the folder has it."""
        known = "" if camera is None else "_known_camera"
        path = self.folder / f"{name.replace(', ', '_')}_{self.size}_colmap{known}.pickle"
        if not path.is_file():
            focal_px = None if camera is None else camera.intrinsics.fl_x
            path.write_bytes(pickle.dumps(structure_from_motion(session.images, session.names, focal_px=focal_px)))
        return pickle.loads(path.read_bytes())

    def _session(self, name: str, markers: bool) -> KnownSession:
        """The session, rendered unless the folder has its pictures."""
        path = self.folder / f"{name.replace(', ', '_')}_{self.size}_{'markers' if markers else 'bare'}.npz"
        if not path.is_file():
            self.folder.mkdir(parents=True, exist_ok=True)
            made = (
                path_traced(PATH_TRACED[name], self.size, markers)
                if name in PATH_TRACED
                else simulated(SIMULATED[name], self.size, markers)
            )
            info = json.dumps(asdict(made.info))
            np.savez_compressed(path, made.images, made.focal_px, made.camera_to_world, info)
        with np.load(path) as kept:
            images, focal_px, camera_to_world, info = (kept[key] for key in kept)
        return KnownSession(list(images), float(focal_px), camera_to_world, SessionInfo(**json.loads(str(info))))


def what_is_known(session: KnownSession) -> dict[str, tuple[SessionInfo, KnownCamera | None]]:
    """What is known of a session without markers, case by case."""
    whole = session.info
    outline = SessionInfo(
        container_diameter_m=whole.container_diameter_m, container_height_m=whole.container_height_m
    )
    angles = SessionInfo(nominal_step_deg=whole.nominal_step_deg, direction=whole.direction)
    both = replace(
        angles, container_diameter_m=whole.container_diameter_m, container_height_m=whole.container_height_m
    )
    return {
        "nothing": (SessionInfo(), None),
        "container": (outline, None),
        "angles": (angles, None),
        "earlier camera": (SessionInfo(), session.camera),
        "container, angles, earlier camera": (both, session.camera),
    }


def _cells(
    session: KnownSession,
    info: SessionInfo,
    camera: KnownCamera | None,
    from_sfm: Callable[..., TurntablePoses] | None,
) -> tuple[str, ...]:
    try:
        if from_sfm is None:
            poses = find_poses(session.images, session.names, info, "markers")
        else:
            poses = find_poses(session.images, session.names, info, "colmap", camera=camera, from_sfm=from_sfm)
    except InputError as error:
        return (*("",) * 9, f"refused: {error}")
    rotation_deg, position_mm = _errors(session, poses)
    stated = poses.uncertainty
    assert stated is not None
    metres = 1.0 if poses.metric else session.distance_m
    distance_m = metres * float(np.linalg.norm(poses.camera_to_world[poses.used][0, :2, 3]))
    size = distance_m / session.distance_m * session.focal_px / poses.intrinsics.fl_x - 1.0
    stated_size = stated.size if poses.scale is None else poses.scale.uncertainty
    found = [rotation_deg, position_mm, 100.0 * abs(size)]
    stated_errors = [stated.rotation_deg, 1e3 * metres * stated.position_m, 100.0 * stated_size]
    levels = [f"{f.name} {f.level}" for f in check_poses(poses, info) if f.level != "green"]
    return (
        f"{rotation_deg:.3f}",
        f"{stated_errors[0]:.3f}",
        f"{position_mm:.2f}",
        f"{stated_errors[1]:.2f}",
        f"{100.0 * (poses.intrinsics.fl_x / session.focal_px - 1.0):+.2f}",
        f"{100.0 * stated.focal:.2f}",
        f"{100.0 * size:+.2f}",
        f"{stated_errors[2]:.2f}",
        goal_met(found, stated_errors),
        "; ".join(levels),
    )


def goal_met(found: list[float], stated: list[float]) -> str:
    """Whether errors meet the goal, or are as large as stated, or within twice of that."""
    beyond = [e / std for e, std, goal in zip(found, stated, GOAL, strict=True) if e > goal]
    ratio = max(beyond, default=0.0)
    if not beyond:
        return "met"
    return "stated" if ratio <= 1.0 else "within 2 stated" if ratio <= 2.0 else f"{ratio:.1f} stated"


def _errors(session: KnownSession, poses: TurntablePoses) -> tuple[float, float]:
    """Largest errors of rotation, degrees, and of position, millimetres."""
    found, truth = poses.camera_to_world[poses.used].copy(), session.camera_to_world[poses.used]
    if not poses.metric:
        found[:, :3, 3] *= session.distance_m
    azimuth_deg = np.rad2deg(np.arctan2(truth[0, 1, 3], truth[0, 0, 3]))
    truth = rotation_about_z(-azimuth_deg) @ truth  # x points to the first used frame's camera
    if not poses.disc_markers and not poses.disc_by_container:
        truth[:, 2, 3] += np.mean(found[:, 2, 3] - truth[:, 2, 3])
    rotation_deg, position_mm = pose_errors(found, truth)
    return float(rotation_deg.max()), float(position_mm.max())


if __name__ == "__main__":
    tyro.cli(PosesWithoutMarkers).main()
