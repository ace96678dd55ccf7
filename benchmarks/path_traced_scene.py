"""A turntable scene for Mitsuba 3: a glossy fruit on a white container before a wooden wall, in a white room.

It shares no code with our simulator. The fruit turns clockwise under two lamps; markers lie on the disc only. Room
and camera turn back instead of the disc, which gives the same images.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import cv2
import mitsuba as mi
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree

mi.set_variant("scalar_rgb")

DISC_RADIUS_M, DISC_THICKNESS_M = 0.135, 0.008
CONTAINER_RADIUS_M, CONTAINER_HEIGHT_M = 0.0375, 0.055
MARKERS, MARKER_SIDE_M, MARKER_RADIUS_M = 8, 0.044, 0.101
DICTIONARY = "DICT_4X4_50"
DISTANCE_M, ELEVATION_DEG, AIM_M = 0.72, 33.0, np.array([0.0, 0.0, 0.045])
WALL_BEHIND_M = 0.3
Fruit = Literal["quince", "long", "ribbed"]
GLOSS = 0.045
"""Fraction of the fruit's light that is reflected as by rough metal, whatever the wavelength."""


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


@dataclass(frozen=True, eq=False)
class PathTracedScene:
    """What is rendered, and how."""

    nodes_nm: Float[np.ndarray, "k 3"]
    """Wavelengths; a row is one rendering."""
    size_px: int
    """Width and height of the images."""
    rays: int
    """Rays in each pixel; fewer make more noise."""
    fruit: Fruit = "quince"
    """Shape of the fruit."""
    spots: int = 160
    """Number of dark spots on the skin."""
    markers: bool = True
    """Whether markers lie on the disc."""
    field_of_view_deg: float = 24.0
    """Field of view over the image's width."""
    sampler: Literal["independent", "multijitter"] = "independent"
    """The latter makes less noise, which is no longer independent between the paths of a pixel."""
    seed: int = 0
    """Seed of the paths."""

    @property
    def focal_px(self) -> float:
        """Focal length."""
        return self.size_px / 2.0 / float(np.tan(np.deg2rad(self.field_of_view_deg) / 2.0))

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The fruit's surface."""
        return fruit_mesh(self.fruit)

    @cached_property
    def _turning(self) -> list[dict[str, Any]]:
        return [_objects(self.mesh, nodes, markers=self.markers, spots=self.spots) for nodes in self.nodes_nm]

    def radiance(self, angle_deg: float, seed: int) -> Float[np.ndarray, "h w 3*k"]:
        """Radiance at the wavelengths with the disc at an angle."""
        return self._render(self._turning, angle_deg, seed, 1)

    def tarp(self, seed: int) -> Float[np.ndarray, "h w 3*k"]:
        """Radiance of the tarp that is held before the turntable, with four times the rays."""
        return self._render([_tarp(nodes) for nodes in self.nodes_nm], 0.0, seed, 4)

    def coverage(self, angle_deg: float) -> Float[np.ndarray, "h w"]:
        """Fraction of each pixel that the fruit covers: the fruit shines and all else is black."""
        lit = {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
        world = {"type": "scene", "integrator": {"type": "path", "max_depth": 1}}
        world |= {"sensor": self._sensor(camera_pose(angle_deg), 1)}
        world |= _objects(self.mesh, self.nodes_nm[0], lit, markers=self.markers, spots=self.spots)
        return np.array(mi.render(mi.load_dict(world), seed=5), float)[..., 0].clip(0.0, 1.0)

    def _render(
        self, scenes: list[dict[str, Any]], angle_deg: float, seed: int, more: int
    ) -> Float[np.ndarray, "h w 3*k"]:
        images = []
        for nodes, objects in zip(self.nodes_nm, scenes, strict=True):
            world = objects | _room(nodes, about_z(-angle_deg)) | {"type": "scene"}
            world["sensor"] = self._sensor(camera_pose(angle_deg), more)
            # All paths are alike in all renderings, because nothing chooses a path by its colour.
            world["integrator"] = {"type": "path", "max_depth": 4, "rr_depth": 100}
            images.append(np.array(mi.render(mi.load_dict(world), seed=1000 * self.seed + seed), float)[..., :3])
        return np.concatenate(images, axis=-1)

    def _sensor(self, camera_to_world: np.ndarray, more: int) -> dict[str, Any]:
        return {
            "type": "perspective",
            "fov": self.field_of_view_deg,
            "near_clip": 0.01,
            "far_clip": 10.0,
            # Mitsuba's x points left and its camera looks along +z.
            "to_world": mi.ScalarTransform4f(camera_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])),
            "film": {"type": "hdrfilm", "width": self.size_px, "height": self.size_px, "rfilter": {"type": "box"}},
            "sampler": {"type": self.sampler, "sample_count": more * self.rays},
        }


def camera_pose(angle_deg: float) -> Float[np.ndarray, "4 4"]:
    """Camera-to-world pose (OpenGL axes, metres) in the object's axes, with the disc at an angle."""
    return about_z(-angle_deg) @ _look_at(AIM_M + DISTANCE_M * _direction(0.0, ELEVATION_DEG), AIM_M)


def stop_angles_deg(frames: int, rng: np.random.Generator) -> Float[np.ndarray, "frames"]:
    """Angles of one clockwise turn, relative to the first: the disc stops a little off its marks."""
    angles_deg = -360.0 / frames * np.arange(frames) + rng.normal(0.0, 0.15, frames)
    return angles_deg - angles_deg[0]


def fruit_mesh(name: Fruit) -> trimesh.Trimesh:
    """A fruit on the container's lid that no turn brings on to itself; the ribbed one is flat with a hollow top."""
    ball = trimesh.creation.icosphere(subdivisions=6)
    x, y, z = ball.vertices.T
    azimuth = np.arctan2(y, x)
    if name == "ribbed":
        ribs = np.abs(np.sin(3.5 * azimuth + 0.4 * np.sin(azimuth))) ** 0.7
        radius = 0.93 + 0.10 * ribs * (1.0 - z**2) + 0.05 * x * y - 0.32 * np.exp(-9.0 * (1.0 - z))
        shape = [1.12, 1.05, 0.86]
    else:
        radius = 1.0 + 0.10 * z * (1.0 - z) + 0.06 * x * y + 0.07 * np.exp(-7.0 * (1.0 - x)) - 0.05 * x * z**2
        radius += 0.03 * np.sin(5.0 * azimuth) * (1.0 - z**2) ** 2 - 0.25 * np.exp(-14.0 * (1.0 - z))
        shape = [1.0, 0.94, 1.12] if name == "quince" else [0.62, 0.7, 1.35]
    vertices = 0.043 * radius[:, None] * ball.vertices * shape
    # It stands on a flat patch.
    vertices[:, 2] = np.maximum(vertices[:, 2] - vertices[:, 2].min(), 0.002) - 0.002 + CONTAINER_HEIGHT_M
    return trimesh.Trimesh(vertices, ball.faces, process=False)


def marker_poses() -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Markers on the disc by number: transform of the square [-1, 1]², and corners in OpenCV's order, metres."""
    poses = {}
    for number in range(MARKERS):
        turn = about_z(360.0 / MARKERS * number)
        frame = turn @ np.array([[0, -1, 0, MARKER_RADIUS_M], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        corners = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
        poses[number] = frame, MARKER_SIDE_M * corners @ frame[:3, :3].T + frame[:3, 3]
    return poses


def _objects(
    fruit: trimesh.Trimesh,
    nodes_nm: np.ndarray,
    lit: dict[str, Any] | None = None,
    *,
    markers: bool,
    spots: int,
) -> dict[str, Any]:
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
        "fruit": _fruit(fruit, nodes_nm, lit, spots),
    }
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    modules = dictionary.markerSize + 2
    for number, (frame, _) in marker_poses().items() if markers else ():
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


def skin_fractions(fruit: trimesh.Trimesh, spots: int) -> tuple[np.ndarray, np.ndarray]:
    """Fraction of the blush in the skin, and of dark spots over both, at each vertex (v,)."""
    x, y, z = fruit.vertices.T
    azimuth = np.arctan2(y, x)
    blush = np.clip(0.5 + 0.7 * np.cos(azimuth - 0.7) + 0.25 * np.sin(170.0 * z + 3.0 * azimuth), 0.0, 1.0)
    centres = fruit.vertices[np.random.default_rng(3).choice(len(fruit.vertices), spots, replace=False)]
    near_m = KDTree(centres).query(fruit.vertices)[0]
    return blush, np.clip((0.0018 - near_m) / 0.0008, 0.0, 1.0)


def material_reflectance(fruit: trimesh.Trimesh, spots: int, nm: np.ndarray) -> Float[np.ndarray, "v bands"]:
    """Diffuse reflectance at each vertex, which the gloss leaves."""
    blush, spotted = (fraction[:, None] for fraction in skin_fractions(fruit, spots))
    skin, red, spot = (MATERIALS[name](nm).clip(0.0, 1.0) for name in ("skin", "blush", "spot"))
    return (1.0 - GLOSS) * ((1.0 - spotted) * ((1.0 - blush) * skin + blush * red) + spotted * spot)


def _fruit(fruit: trimesh.Trimesh, nodes_nm: np.ndarray, lit: dict[str, Any] | None, spots: int) -> Any:
    blush, spotted = skin_fractions(fruit, spots)
    skin = _blend(
        _matte(nodes_nm, "skin"), _matte(nodes_nm, "blush"), {"type": "mesh_attribute", "name": "vertex_blush"}
    )
    body = _blend(skin, _matte(nodes_nm, "spot"), {"type": "mesh_attribute", "name": "vertex_spot"})
    gloss = {"type": "roughconductor", "material": "none", "alpha": 0.12}
    properties = mi.Properties()
    properties["surface"] = mi.load_dict({"type": "twosided", "bsdf": _blend(body, gloss, GLOSS)})
    if lit is not None:
        properties["emitter"] = mi.load_dict(lit)
    mesh = mi.Mesh("fruit", len(fruit.vertices), len(fruit.faces), properties, has_vertex_normals=True)
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = fruit.vertices.ravel().tolist()
    buffers["vertex_normals"] = fruit.vertex_normals.ravel().tolist()
    buffers["faces"] = fruit.faces.ravel().tolist()
    buffers.update()
    mesh.add_attribute("vertex_blush", 1, blush.tolist())
    mesh.add_attribute("vertex_spot", 1, spotted.tolist())
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
    cloth = _blend(_matte(nodes_nm, "tarp"), _matte(nodes_nm, "ink"), _texture(_weave(), "bilinear"))
    bsdf = {"type": "twosided", "bsdf": cloth}
    return {"tarp": {"type": "rectangle", "to_world": mi.ScalarTransform4f(held), "bsdf": bsdf}}


def _weave() -> Float[np.ndarray, "96 96 1"]:
    """Fraction of dark threads in the tarp."""
    return (np.random.default_rng(2).normal(0.0, 0.012, (96, 96, 1)).clip(-0.03, 0.03) + 0.03).astype(np.float32)


def tarp_reflectance(nm: np.ndarray) -> np.ndarray:
    """Mean reflectance of the tarp, which a session takes for white."""
    dark = float(_weave().mean())
    return (1.0 - dark) * MATERIALS["tarp"](nm) + dark * MATERIALS["ink"](nm)


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


def about_z(angle_deg: float) -> Float[np.ndarray, "4 4"]:
    """A turn about z."""
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def _look_at(eye: np.ndarray, aim: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """A frame at ``eye`` whose -z axis points at ``aim`` and whose y axis is upright (a camera of OpenGL)."""
    z = (eye - aim) / np.linalg.norm(eye - aim)
    x = np.cross([0.0, 0.0, 1.0], z) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], z))
    frame = np.eye(4)
    frame[:3] = np.stack([x, np.cross(z, x), z, eye], axis=-1)
    return frame
