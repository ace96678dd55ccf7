"""A turntable session that shares no code with our simulator: path-traced by Mitsuba 3, written as a SPECIM IQ does.

    uv run python benchmarks/independent_session.py SESSION

A glossy lumpy fruit on a white container turns clockwise before a wooden wall, under two lamps in a white room.
Markers lie on the disc only. The lamps lose 5 % of their light (10 % in the blue). The path tracer's noise stays in:
about 5 % a pixel, common to all bands of a pixel and independent from frame to frame. The pictures are upright.

Three renderings of three wavelengths each use the same paths. The 204 bands are mixed from these nine: spectra of
materials and their products (one bounce) are linear combinations of their values there, by least squares.

``truth/`` holds truth.json (camera, poses, angles, markers, spectra, drift), masks.npz (fraction of each pixel that
the fruit covers) and mesh.ply.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import mitsuba as mi
import numpy as np
import trimesh
import tyro
from jaxtyping import Float
from rich.progress import track

mi.set_variant("scalar_rgb")

BANDS = np.linspace(397.66, 1003.81, 204)
NODES_NM = np.array([[420.0, 680.0, 860.0], [470.0, 645.0, 965.0], [520.0, 570.0, 720.0]])
"""Rendered wavelengths; a row is one rendering."""
NAME, WHITE = "quince", "tarp"
DISC_RADIUS_M, DISC_THICKNESS_M = 0.135, 0.008
CONTAINER_RADIUS_M, CONTAINER_HEIGHT_M = 0.0375, 0.055
MARKERS, MARKER_SIDE_M, MARKER_RADIUS_M = 8, 0.044, 0.101
DICTIONARY = "DICT_4X4_50"
DISTANCE_M, ELEVATION_DEG, FIELD_OF_VIEW_DEG, AIM_M = 0.72, 33.0, 24.0, np.array([0.0, 0.0, 0.045])
WALL_BEHIND_M = 0.3
DRIFT, DRIFT_BLUE = 0.05, 0.10
"""Loss of light over the session above 550 nm, and at 400 nm."""
DARK, DARK_PATTERN, LARGEST, WHITE_LEVEL = 96.0, 4.0, 4095, 0.8
ELECTRONS_PER_COUNT, READ_NOISE_COUNTS = 8.0, 4.0
TINT_MS = 98.0
DATE = "14-10-2026"
DARK_LINES = 32
HEADER = """ENVI
description = {{Data recorded with Specim IQ}}
samples = {samples}
lines = {lines}
bands = 204
header offset = 0
file type = ENVI Standard
data type = 12
interleave = BIL
sensor type = SPECIM IQ
byte order = 0
default bands = {{70,53,19}}
latitude = 0
longitude = 0
acquisition date = {date}
errors = none
binning = {{1,1}}
tint = {tint:g}
fps = 10.2041
wavelength = {{{wavelengths}}}
"""
METADATA = """<?xml version="1.0" encoding="UTF-8"?>
<properties xmlns="http://www.specim.fi/iq">
  <dataset>
    <key field="name">{name}</key>
    <key field="camera">Specim IQ</key>
    <key field="date">{date}</key>
    <key field="integration_time">{tint:g}</key>
    <key field="WR_mode">custom</key>
  </dataset>
</properties>
"""


def _bell(nm: np.ndarray, centre_nm: float, width_nm: float) -> np.ndarray:
    return np.exp(-0.5 * ((nm - centre_nm) / width_nm) ** 2)


def _rise(nm: np.ndarray, middle_nm: float, width_nm: float) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-(nm - middle_nm) / width_nm))


MATERIALS = {
    "skin": lambda nm: 0.06 + 0.50 * _rise(nm, 512, 14) - 0.24 * _bell(nm, 676, 22) - 0.12 * _bell(nm, 968, 28),
    "blush": lambda nm: 0.05 + 0.52 * _rise(nm, 612, 22) - 0.10 * _bell(nm, 676, 22) - 0.12 * _bell(nm, 968, 28),
    "spot": lambda nm: 0.10 + 0.30 * _rise(nm, 640, 70) - 0.06 * _bell(nm, 968, 28),
    "container": lambda nm: 0.82 - 0.12 * _bell(nm, 397, 18),
    "disc": lambda nm: 0.45 + 0.00005 * (nm - 700),
    "paper": lambda nm: 0.84 - 0.25 * _bell(nm, 397, 20),
    "ink": lambda nm: 0.04 + 0.00002 * (nm - 397),
    "wood": lambda nm: 0.12 + 0.50 * _rise(nm, 590, 75),
    "grain": lambda nm: 0.05 + 0.22 * _rise(nm, 690, 85),
    "room": lambda nm: 0.9 + 0.0 * nm,
    "tarp": lambda nm: 1.0 + 0.0 * nm,
}
"""Reflectance of each material over the wavelength in nm."""


@dataclass(frozen=True)
class IndependentSession:
    """Render and write the session."""

    session: tyro.conf.Positional[Path]
    """Folder of the session; an earlier one is replaced."""
    frames: int = 30
    """Frames of one turn."""
    size: int = 128
    """Width and height of the images, pixels."""
    rays: int = 64
    """Rays in each pixel; fewer make more noise."""
    fruit: Literal["quince", "long"] = "quince"
    """Shape of the fruit."""
    seed: int = 0
    """Seed of paths, angles and noise."""

    def main(self) -> None:
        """Render, mix, expose and write."""
        shutil.rmtree(self.session, ignore_errors=True)
        rng = np.random.default_rng(self.seed)
        fruit = fruit_mesh(self.fruit)
        scenes = [_objects(fruit, nodes_nm) for nodes_nm in NODES_NM]
        camera = _look_at(AIM_M + DISTANCE_M * _direction(0.0, ELEVATION_DEG), AIM_M)
        # The disc stops a little off its marks.
        angles_deg = -360.0 / self.frames * np.arange(self.frames) + rng.normal(0.0, 0.15, self.frames)
        angles_deg -= angles_deg[0]
        mixing, pattern = mixing_matrix(), rng.normal(0.0, DARK_PATTERN, (self.size, len(BANDS)))
        names = [f"{NAME}_{number:03d}" for number in range(self.frames)]
        drift = lamp_drift(self.frames)

        white = self._radiance([_tarp(nodes) for nodes in NODES_NM], camera, 0.0, 1000, 4) @ mixing
        self._write(WHITE, white, pattern, rng)
        masks, poses = [], []
        for number, angle_deg in track(list(enumerate(angles_deg)), "rendering"):
            nine = self._radiance(scenes, camera, angle_deg, number, 1)
            self._write(names[number], (nine @ mixing) * drift[number], pattern, rng)
            poses.append(_about_z(-angle_deg) @ camera)
            masks.append(self._coverage(fruit, poses[-1]))
        self._write_truth(names, angles_deg, poses, masks, drift, fruit)

    def _radiance(
        self, scenes: list[dict[str, Any]], camera: np.ndarray, angle_deg: float, seed: int, more: int
    ) -> Float[np.ndarray, "h w 9"]:
        """Radiance at the nine wavelengths; room and camera turn back instead of the disc."""
        back = _about_z(-angle_deg)
        images = []
        for nodes_nm, objects in zip(NODES_NM, scenes, strict=True):
            world = objects | _room(nodes_nm, back) | {"type": "scene", "sensor": self._sensor(back @ camera, more)}
            # All paths are alike in the three renderings, because nothing chooses a path by its colour.
            world["integrator"] = {"type": "path", "max_depth": 4, "rr_depth": 100}
            images.append(np.array(mi.render(mi.load_dict(world), seed=1000 * self.seed + seed), float)[..., :3])
        return np.concatenate(images, axis=-1)

    def _coverage(self, fruit: trimesh.Trimesh, pose: np.ndarray) -> Float[np.ndarray, "h w"]:
        """Fraction of each pixel that the fruit covers: the fruit shines and all else is black."""
        lit = {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
        world = {"type": "scene", "integrator": {"type": "path", "max_depth": 1}, "sensor": self._sensor(pose, 1)}
        world |= _objects(fruit, NODES_NM[0], lit)
        return np.array(mi.render(mi.load_dict(world), seed=5), float)[..., 0].clip(0.0, 1.0)

    def _sensor(self, camera_to_world: np.ndarray, more: int) -> dict[str, Any]:
        return {
            "type": "perspective",
            "fov": FIELD_OF_VIEW_DEG,
            "near_clip": 0.01,
            "far_clip": 10.0,
            # Mitsuba's x points left and its camera looks along +z.
            "to_world": mi.ScalarTransform4f(camera_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])),
            "film": {"type": "hdrfilm", "width": self.size, "height": self.size, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": more * self.rays},
        }

    def _write(
        self, name: str, radiance: Float[np.ndarray, "h w bands"], pattern: np.ndarray, rng: np.random.Generator
    ) -> None:
        """One capture's folder: counts and dark with the sensor's noise, headers, XML."""
        signal = radiance * white_signal()
        electrons = rng.poisson(np.maximum(signal, 0.0) * ELECTRONS_PER_COUNT)
        folder = self.session / name
        (folder / "capture").mkdir(parents=True)
        (folder / "metadata").mkdir()
        lightless = np.zeros((DARK_LINES, self.size, len(BANDS)))
        for prefix, light in (("", electrons / ELECTRONS_PER_COUNT), ("DARKREF_", lightless)):
            counts = light + DARK + pattern + rng.normal(0.0, READ_NOISE_COUNTS, light.shape)
            cube = np.clip(np.rint(counts), 0, LARGEST).astype("<u2")
            # BIL: for each line, band by band.
            (folder / "capture" / f"{prefix}{name}.raw").write_bytes(np.moveaxis(cube, -1, 1).tobytes())
            wavelengths = ", ".join(f"{nm:.2f}" for nm in BANDS)
            header = HEADER.format(
                samples=self.size, lines=len(cube), date=DATE, tint=TINT_MS, wavelengths=wavelengths
            )
            (folder / "capture" / f"{prefix}{name}.hdr").write_text(header, encoding="utf-8")
        metadata = METADATA.format(name=name, date=DATE, tint=TINT_MS)
        (folder / "metadata" / f"{name}.xml").write_text(metadata, encoding="utf-8")

    def _write_truth(
        self,
        names: list[str],
        angles_deg: np.ndarray,
        poses: list[np.ndarray],
        masks: list[np.ndarray],
        drift: np.ndarray,
        fruit: trimesh.Trimesh,
    ) -> None:
        stated = {
            "object": NAME,
            "white_reference": WHITE,
            "nominal_step_deg": 360.0 / self.frames,
            "direction": "cw",
            "marker_dictionary": DICTIONARY,
            "marker_side_m": MARKER_SIDE_M,
            "container_diameter_m": 2 * CONTAINER_RADIUS_M,
            "container_height_m": CONTAINER_HEIGHT_M,
            "image_rotation_deg": 0,
        }
        (self.session / "session.json").write_text(json.dumps(stated, indent=1), encoding="utf-8")
        folder = self.session / "truth"
        folder.mkdir()
        focal_px = self.size / 2.0 / np.tan(np.deg2rad(FIELD_OF_VIEW_DEG) / 2.0)
        centre = self.size / 2.0
        truth = {
            "intrinsics": {
                "w": self.size,
                "h": self.size,
                "fl_x": focal_px,
                "fl_y": focal_px,
                "cx": centre,
                "cy": centre,
            },
            "frames": [
                {
                    "capture": name,
                    "angle_deg": angle_deg,
                    "camera_to_world": pose.tolist(),
                    "drift": of_frame.tolist(),
                }
                for name, angle_deg, pose, of_frame in zip(names, angles_deg.tolist(), poses, drift, strict=True)
            ],
            "marker_layout": {number: corners.tolist() for number, (_, corners) in marker_poses().items()},
            "wavelengths_nm": BANDS.tolist(),
            "reflectance": {name: spectrum(BANDS).tolist() for name, spectrum in MATERIALS.items()},
            "mesh": {"area_m2": fruit.area, "volume_m3": fruit.volume},
        }
        (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8")
        np.savez_compressed(folder / "masks.npz", **dict(zip(names, np.array(masks, np.float16), strict=True)))
        fruit.export(folder / "mesh.ply")


def mixing_matrix() -> Float[np.ndarray, "9 bands"]:
    """Weights of the nine rendered wavelengths in each band: exact for materials and products of two, nearly."""
    nodes_nm = NODES_NM.ravel()

    def table(nm: np.ndarray) -> np.ndarray:
        spectra = np.array([np.ones_like(nm), *(spectrum(nm) for spectrum in MATERIALS.values())])
        # Light that has met two materials counts less than that of one.
        products = [0.2 * a * b for i, a in enumerate(spectra[1:9]) for b in spectra[1 : i + 2]]
        return np.concatenate([spectra, products])

    return np.linalg.lstsq(table(nodes_nm), table(BANDS), rcond=1e-3)[0]


def white_signal() -> Float[np.ndarray, "bands"]:
    """Counts above dark of reflectance 1: tungsten light on a silicon detector."""
    light = (BANDS / 1000.0) ** -4 / np.expm1(1.438776877e7 / (BANDS * 2900.0))
    electrons = light * (0.1 + 0.55 * np.exp(-(((BANDS - 620.0) / 210.0) ** 2)))
    return electrons / electrons.max() * (WHITE_LEVEL * LARGEST - DARK)


def lamp_drift(frames: int) -> Float[np.ndarray, "frames bands"]:
    """Ratio of the lamps' light to that on the tarp, which was taken before the first frame."""
    progress = 1.0 - np.exp(-np.arange(1, frames + 1) / (0.4 * frames))
    loss = DRIFT + (DRIFT_BLUE - DRIFT) * np.clip((550.0 - BANDS) / 150.0, 0.0, 1.0)
    return 1.0 - progress[:, None] / progress[-1] * loss


def fruit_mesh(name: str) -> trimesh.Trimesh:
    """A lumpy fruit on the container's lid that no turn brings on to itself."""
    ball = trimesh.creation.icosphere(subdivisions=6)
    x, y, z = ball.vertices.T
    radius = 1.0 + 0.10 * z * (1.0 - z) + 0.06 * x * y + 0.07 * np.exp(-7.0 * (1.0 - x)) - 0.05 * x * z**2
    radius += 0.03 * np.sin(5.0 * np.arctan2(y, x)) * (1.0 - z**2) ** 2 - 0.25 * np.exp(-14.0 * (1.0 - z))
    vertices = 0.043 * radius[:, None] * ball.vertices
    vertices *= [1.0, 0.94, 1.12] if name == "quince" else [0.62, 0.7, 1.35]
    # It stands on a flat patch.
    vertices[:, 2] = np.maximum(vertices[:, 2] - vertices[:, 2].min(), 0.002) - 0.002 + CONTAINER_HEIGHT_M
    return trimesh.Trimesh(vertices, ball.faces, process=False)


def marker_poses() -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Of each marker on the disc: the transform of the square [-1, 1]², and its corners in OpenCV's order, metres."""
    poses = {}
    for number in range(MARKERS):
        turn = _about_z(360.0 / MARKERS * number)
        frame = turn @ np.array([[0, -1, 0, MARKER_RADIUS_M], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        corners = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
        poses[number] = frame, MARKER_SIDE_M * corners @ frame[:3, :3].T + frame[:3, 3]
    return poses


def _objects(fruit: trimesh.Trimesh, nodes_nm: np.ndarray, lit: dict[str, Any] | None = None) -> dict[str, Any]:
    """All that turns, at three wavelengths; with ``lit`` the fruit is that lamp."""
    upright = mi.ScalarTransform4f
    disc = upright().translate([0, 0, -0.0005]).scale([DISC_RADIUS_M, DISC_RADIUS_M, 1.0])
    side = upright().scale([CONTAINER_RADIUS_M, CONTAINER_RADIUS_M, CONTAINER_HEIGHT_M])
    rim = (
        upright()
        .translate([0, 0, -DISC_THICKNESS_M])
        .scale([DISC_RADIUS_M, DISC_RADIUS_M, DISC_THICKNESS_M - 0.0005])
    )
    lid = upright().translate([0, 0, CONTAINER_HEIGHT_M]).scale([CONTAINER_RADIUS_M, CONTAINER_RADIUS_M, 1.0])
    plastic, grey = (_matte(nodes_nm, name) for name in ("container", "disc"))
    objects: dict[str, Any] = {
        "disc": {"type": "disk", "to_world": disc, "bsdf": grey},
        "rim": {"type": "cylinder", "to_world": rim, "bsdf": grey},
        "side": {"type": "cylinder", "to_world": side, "bsdf": plastic},
        "lid": {"type": "disk", "to_world": lid, "bsdf": plastic},
        "fruit": _fruit(fruit, nodes_nm, lit),
    }
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    modules = dictionary.markerSize + 2
    for number, (frame, _) in marker_poses().items():
        image = np.pad(cv2.aruco.generateImageMarker(dictionary, number, modules) == 0, 1)[::-1, :, None].astype(
            np.float32
        )
        half = MARKER_SIDE_M / 2.0 * (modules + 2) / modules
        objects[f"marker_{number}"] = {
            "type": "rectangle",
            "to_world": upright(frame @ np.diag([half, half, 1.0, 1.0])),
            "bsdf": _blend(_matte(nodes_nm, "paper"), _matte(nodes_nm, "ink"), _texture(image, "nearest")),
        }
    return objects


def _fruit(fruit: trimesh.Trimesh, nodes_nm: np.ndarray, lit: dict[str, Any] | None) -> Any:
    x, y, z = fruit.vertices.T
    azimuth = np.arctan2(y, x)
    blush = np.clip(0.5 + 0.7 * np.cos(azimuth - 0.7) + 0.25 * np.sin(170.0 * z + 3.0 * azimuth), 0.0, 1.0)
    centres = fruit.vertices[np.random.default_rng(3).choice(len(fruit.vertices), 160, replace=False)]
    near_m = np.min(np.linalg.norm(fruit.vertices[:, None] - centres[None], axis=-1), axis=1)
    spots = np.clip((0.0018 - near_m) / 0.0008, 0.0, 1.0)
    skin = _blend(
        _matte(nodes_nm, "skin"), _matte(nodes_nm, "blush"), {"type": "mesh_attribute", "name": "vertex_blush"}
    )
    body = _blend(skin, _matte(nodes_nm, "spot"), {"type": "mesh_attribute", "name": "vertex_spot"})
    gloss = {"type": "roughconductor", "material": "none", "alpha": 0.12}
    properties = mi.Properties()
    properties["surface"] = mi.load_dict({"type": "twosided", "bsdf": _blend(body, gloss, 0.045)})
    if lit is not None:
        properties["emitter"] = mi.load_dict(lit)
    mesh = mi.Mesh("fruit", len(fruit.vertices), len(fruit.faces), properties, has_vertex_normals=True)
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = fruit.vertices.ravel().tolist()
    buffers["vertex_normals"] = fruit.vertex_normals.ravel().tolist()
    buffers["faces"] = fruit.faces.ravel().tolist()
    buffers.update()
    mesh.add_attribute("vertex_blush", 1, blush.tolist())
    mesh.add_attribute("vertex_spot", 1, spots.tolist())
    return mesh


def _room(nodes_nm: np.ndarray, back: np.ndarray) -> dict[str, Any]:
    """White room, two lamps and the wooden wall, turned by ``back``."""
    view = -_direction(0.0, ELEVATION_DEG)
    wall = _look_at(AIM_M + WALL_BEHIND_M * view, AIM_M - view)
    lamps = {}
    for number, azimuth_deg in enumerate((-40.0, 55.0)):
        lamp = _look_at(AIM_M + 0.9 * _direction(azimuth_deg, 60.0), AIM_M)
        lamps[f"lamp_{number}"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(back @ lamp @ np.diag([-0.12, 0.12, -1.0, 1.0])),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [12.0, 12.0, 12.0]}},
        }
    return lamps | {
        "air": {"type": "constant", "radiance": {"type": "rgb", "value": [0.25, 0.25, 0.25]}},
        "wall": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(back @ wall @ np.diag([0.5, 0.5, 1.0, 1.0])),
            "bsdf": {
                "type": "twosided",
                "bsdf": _blend(
                    _matte(nodes_nm, "wood"), _matte(nodes_nm, "grain"), _texture(wood_grain(), "bilinear")
                ),
            },
        },
    }


def wood_grain(size: int = 512) -> Float[np.ndarray, "h w 1"]:
    """Fraction of dark grain on a wall of eight planks: stretched rings, knots and joints."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:size, :size] / size
    plank = np.floor(8.0 * x).astype(int)
    phase, shade = rng.uniform(0.0, 6.0, 8)[plank], rng.uniform(-0.2, 0.3, 8)[plank]
    warp = cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), 24.0, sigmaY=60.0)
    rings = 0.5 + 0.5 * np.sin(260.0 * x + 900.0 * warp / 10.0 + phase + 4.0 * np.sin(5.0 * y + phase))
    knots = sum(np.exp(-((x - a) ** 2 + 0.3 * (y - b) ** 2) / 0.0006) for a, b in rng.uniform(0.1, 0.9, (14, 2)))
    joints = (np.abs(8.0 * x - np.round(8.0 * x)) < 0.03).astype(float)
    return np.clip(0.75 * rings + shade + knots + joints, 0.0, 1.0).astype(np.float32)[..., None]


def _tarp(nodes_nm: np.ndarray) -> dict[str, Any]:
    """The tarp that is held before the camera instead of the turntable."""
    held = _look_at(AIM_M, AIM_M - _direction(0.0, ELEVATION_DEG)) @ np.diag([0.125, 0.125, 1.0, 1.0])
    weave = np.random.default_rng(2).normal(0.0, 0.012, (96, 96, 1)).clip(-0.03, 0.03) + 0.03
    cloth = _blend(_matte(nodes_nm, "tarp"), _matte(nodes_nm, "ink"), _texture(weave.astype(np.float32), "bilinear"))
    bsdf = {"type": "twosided", "bsdf": cloth}
    return {"tarp": {"type": "rectangle", "to_world": mi.ScalarTransform4f(held), "bsdf": bsdf}}


def _matte(nodes_nm: np.ndarray, name: str) -> dict[str, Any]:
    colour = {"type": "rgb", "value": MATERIALS[name](nodes_nm).clip(0.0, 1.0).tolist()}
    return {"type": "diffuse", "reflectance": colour}


def _texture(image: Float[np.ndarray, "h w 1"], filter_type: str) -> dict[str, Any]:
    return {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, "filter_type": filter_type}


def _blend(first: dict[str, Any], second: dict[str, Any], weight_of_second: dict[str, Any] | float) -> dict[str, Any]:
    return {"type": "blendbsdf", "weight": weight_of_second, "first": first, "second": second}


def _direction(azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3"]:
    a, e = np.deg2rad([azimuth_deg, elevation_deg])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def _about_z(angle_deg: float) -> Float[np.ndarray, "4 4"]:
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def _look_at(eye: np.ndarray, aim: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """A frame at ``eye`` whose -z axis points at ``aim`` and whose y axis is upright (a camera of OpenGL)."""
    z = (eye - aim) / np.linalg.norm(eye - aim)
    x = np.cross([0.0, 0.0, 1.0], z) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], z))
    frame = np.eye(4)
    frame[:3] = np.stack([x, np.cross(z, x), z, eye], axis=-1)
    return frame


if __name__ == "__main__":
    tyro.cli(IndependentSession).main()
