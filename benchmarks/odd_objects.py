"""Simulated sessions whose object, disc or view is not the ideal one."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from mistakes import edit_cube, frames_of, header_of, stated

from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.geometry.camera import project
from hsi_sc_nerf.poses.marker_detection import detect_markers
from hsi_sc_nerf.simulate import assemble
from hsi_sc_nerf.simulate.materials import Plain, PlantTissue
from hsi_sc_nerf.simulate.render import Part
from hsi_sc_nerf.simulate.scene import Scene, Sphere, load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth

SIZE_PX, FRAMES = 112, 24
EFFECTS = ("photon_noise", "read_noise", "dark_pattern")
SHIFT_M = 0.02
OPACITY = 0.5
"""Of the translucent object: so much of the light comes from it, the rest from what is behind."""
MIRROR = 0.4
"""Part of the light that the glossy disc mirrors, from 22 degrees above: black acrylic has 0.15, steel 0.6."""
BLACK = 0.03
"""Reflectance of the black object."""


@dataclass(frozen=True)
class OddObject:
    """A session that is odd in one way; ``make`` writes it, made of a scene, into a folder."""

    name: str
    make: Callable[[Scene, Path], None]


def odd_session(odd: OddObject, scene: str, seed: int, folder: Path) -> Path:
    """Write the session unless it is there."""
    made = override(load_scene(scene), frames=FRAMES, size_px=SIZE_PX, seed=seed, effects=EFFECTS)
    if not folder.is_dir():
        odd.make(made, folder)
    return folder


def _black(scene: Scene, folder: Path) -> None:
    """All of it but its shape is black and grey."""
    part = assemble.object_part(scene)
    black = {name: Plain(BLACK) for name in part.materials}
    simulate_session(replace(scene, materials=black), folder)


def _dark_red(scene: Scene, folder: Path) -> None:
    """A plum: it reflects in the near infrared only, and little there."""
    part = assemble.object_part(scene)
    plum = PlantTissue(0.25, chlorophyll=1.0, carotenoid=1.0, anthocyanin=2.0, brown=0.5, water=0.08)
    simulate_session(replace(scene, materials=dict.fromkeys(part.materials, plum)), folder)


def _translucent(scene: Scene, folder: Path) -> None:
    """What is behind it shines through, without refraction."""
    behind = folder.with_name(f"{folder.name}-behind")
    # The smallest object that there is, of the container's material.
    empty = replace(scene, object=Sphere("sphere", 0.01, "container_plastic"))
    simulate_session(empty, behind)
    simulate_session(scene, folder)
    truth = load_truth(folder)
    for frame, of_behind in zip(frames_of(folder), frames_of(behind), strict=True):
        through = (1.0 - OPACITY) * truth.object_coverage(frame.name)[..., None]
        other = open_cube(header_of(of_behind)).read().astype(np.float32)
        edit_cube(header_of(frame), lambda own, t=through, o=other: own + t * (o - own))
    shutil.rmtree(behind)


def _mirroring_disc(scene: Scene, folder: Path) -> None:
    """The disc, but not the markers on it, mirrors a part of the light."""
    camera = scene.camera
    below = folder.with_name(f"{folder.name}-below")
    # What a mirror shows is seen by the mirrored camera, upside down; the disc itself is not in its way.
    mirrored = replace(camera, elevation_deg=-camera.elevation_deg, aim_height_m=-camera.aim_height_m)
    turntable = replace(scene.turntable, disc_diameter_m=0.01)
    markers = replace(scene.markers, on_disc=0)
    simulate_session(replace(scene, camera=mirrored, turntable=turntable, markers=markers), below)
    simulate_session(scene, folder)
    truth = load_truth(folder)
    disc = truth.materials.index("disc")
    for frame, of_below in zip(frames_of(folder), frames_of(below), strict=True):
        part = MIRROR * truth.material_weights(frame.name)[..., disc, None]
        other = open_cube(header_of(of_below)).read()[::-1].astype(np.float32)
        edit_cube(header_of(frame), lambda own, p=part, o=other: own + p * (o - own))
    shutil.rmtree(below)


def _moved(scene: Scene, folder: Path, shift_m: float) -> None:
    original = assemble.object_part

    def object_part(scene: Scene) -> Part:
        part = original(scene)
        return replace(part, mesh=part.mesh.moved(np.array([shift_m, 0.0, 0.0])))

    with patch.object(assemble, "object_part", object_part):
        simulate_session(scene, folder)


def _off_axis(scene: Scene, folder: Path) -> None:
    """The fruit stands beside the axis, the container on it."""
    _moved(scene, folder, SHIFT_M)


def _cut_at_the_top(fraction: float) -> Callable[[Scene, Path], None]:
    """The object stands a little beside the axis, and its top leaves the image in the fraction of the frames in which
    it is nearest to the camera."""

    def make(scene: Scene, folder: Path) -> None:
        top_m = assemble.object_part(scene).mesh.vertices + np.array([SHIFT_M, 0.0, 0.0])
        lens = assemble.intrinsics(scene.camera)
        for _ in range(5):  # the lines change nearly in proportion to the aim
            poses = assemble.frame_plan(scene).camera_to_world
            lines = [project(top_m, pose, lens)[0][:, 1].min() for pose in poses]
            lower_m = float(np.quantile(lines, fraction)) * scene.camera.distance_m / lens.fl_y
            camera = replace(scene.camera, aim_height_m=scene.camera.aim_height_m - lower_m)
            scene = replace(scene, camera=camera)
        _moved(scene, folder, SHIFT_M)

    return make


def _hidden_markers(scene: Scene, folder: Path) -> None:
    """In a third of the frames no marker is seen."""
    simulate_session(scene, folder)
    hide_markers(folder)


def hide_markers(session: Path) -> None:
    """Paint the markers of a third of the frames, one after the other, as the disc beside them."""
    frames = frames_of(session)
    dictionary = str(stated(session)["marker_dictionary"])
    for frame in frames[len(frames) // 3 : 2 * len(frames) // 3]:
        edit_cube(header_of(frame), lambda counts: _without_markers(counts, dictionary))


def _without_markers(counts: np.ndarray, dictionary: str) -> np.ndarray:
    grey = counts.mean(axis=-1)
    grey = np.clip(255.0 * grey / np.quantile(grey, 0.99), 0, 255).astype(np.uint8)
    while found := detect_markers(grey, dictionary):
        for corners in found.values():
            centre = corners.mean(axis=0)
            inner, outer = (np.zeros(grey.shape, np.uint8) for _ in range(2))
            for image, scale in ((inner, 1.25), (outer, 1.6)):
                cv2.fillConvexPoly(image, np.rint(centre + scale * (corners - centre)).astype(np.int32), 1)
            beside = np.median(counts[(outer > 0) & (inner == 0)], axis=0)
            counts[inner > 0] = beside
            grey[inner > 0] = np.median(grey[(outer > 0) & (inner == 0)])
    return counts


ODD = [
    OddObject("a black object", _black),
    OddObject("a dark red object", _dark_red),
    OddObject("a translucent object", _translucent),
    OddObject("markers hidden in a third of the frames", _hidden_markers),
    OddObject("a disc that mirrors", _mirroring_disc),
    OddObject("the object 2 cm beside the axis", _off_axis),
    OddObject("the top leaves the image in a quarter of the frames", _cut_at_the_top(0.25)),
]
