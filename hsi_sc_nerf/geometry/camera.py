"""Cameras, rays, rotations and similarity transformations on NumPy arrays; projection of rays also on tensors.

Conventions (docs/concepts/frames.md): camera-to-world in OpenGL axes with the object frame as the world, z along
the turntable's axis, metres; pixel coordinates start at the image's upper left corner.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from torch import Tensor  # takes seconds, and commands without a model do without it

# Multiplying a camera-to-world pose by this on the right turns OpenCV axes (y down, looking along +z) into
# OpenGL axes (y up, looking along -z), and back.
OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
"""Azimuth from one direction to the next on a Fibonacci spiral, rad."""


@dataclass(frozen=True)
class PinholeIntrinsics:
    """A pinhole camera in pixels; ``cx``, ``cy`` count from the image's upper left corner."""

    w: int
    h: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The calibration matrix K for corner-origin pixel coordinates."""
        return np.array([[self.fl_x, 0.0, self.cx], [0.0, self.fl_y, self.cy], [0.0, 0.0, 1.0]])


def rotation_about_z(angle_deg: float) -> Float[np.ndarray, "4 4"]:
    """Homogeneous rotation by ``angle_deg`` about z, counter-clockwise seen from +z."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()
    return pose


def look_at(eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Camera-to-world (OpenGL) of a camera at ``eye`` that looks at ``target`` with the image's up along +z.

    Raises:
        ValueError: the viewing direction is parallel to z, so "up" is undefined.
    """
    back = np.asarray(eye, float) - np.asarray(target, float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    if np.linalg.norm(right) < 1e-9:
        raise ValueError("look_at: the viewing direction is parallel to the z axis")
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(back, right), back, eye
    return pose


def turntable_camera_to_world(
    first_camera_to_world: Float[np.ndarray, "4 4"], angle_deg: float
) -> Float[np.ndarray, "4 4"]:
    """Camera-to-world in the object's frame after the object turned by ``angle_deg`` (counter-clockwise).

    Turning the object by +angle before a fixed camera gives the image that a camera turned by -angle about the
    same axis takes of a fixed object (paper, "simulated pose transformation").
    """
    return rotation_about_z(-angle_deg) @ first_camera_to_world


def project(
    points: Float[np.ndarray, "*n 3"],
    camera_to_world: Float[np.ndarray, "4 4"],
    intrinsics: PinholeIntrinsics,
    distortion: Float[np.ndarray, "4"] | tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray, "*n"]]:
    """Project object-frame points through a lens with the distortion k1, k2, p1, p2 (OpenCV).

    Returns:
        Pixel coordinates, and the depth in front of the camera (metres).
    """
    world_to_camera = np.linalg.inv(camera_to_world @ OPENCV_TO_OPENGL)
    in_camera = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    depth = in_camera[..., 2]
    plane, (k1, k2, p1, p2) = in_camera[..., :2] / depth[..., None], distortion
    squared, tangential = (plane**2).sum(axis=-1, keepdims=True), np.array([p2, p1])
    radial = 1.0 + squared * (k1 + squared * k2) + 2.0 * (plane @ tangential)[..., None]
    scale, centre = (intrinsics.fl_x, intrinsics.fl_y), (intrinsics.cx, intrinsics.cy)
    return (plane * radial + squared * tangential) * scale + centre, depth


def pixels_of(
    points: Float[np.ndarray, "n 3"], camera_to_world: Float[np.ndarray, "4 4"], intrinsics: PinholeIntrinsics
) -> tuple[Bool[np.ndarray, "n"], Int[np.ndarray, "n 2"]]:
    """Which object-frame points lie in the image, and their pixels (sample, line), (0, 0) where they do not."""
    pixels, depth = project(points, camera_to_world, intrinsics)
    inside = (depth > 0.0) & ((pixels >= 0.0) & (pixels < (intrinsics.w, intrinsics.h))).all(axis=1)
    return inside, np.where(inside[:, None], pixels, 0.0).astype(int)


def image_of(
    points: Float[np.ndarray, "n 3"], camera_to_world: Float[np.ndarray, "4 4"], intrinsics: PinholeIntrinsics
) -> Bool[np.ndarray, "h w"]:
    """The pixels that object-frame points project into, hidden or not."""
    inside, pixels = pixels_of(points, camera_to_world, intrinsics)
    image = np.zeros((intrinsics.h, intrinsics.w), bool)
    image[pixels[inside, 1], pixels[inside, 0]] = True
    return image


def in_camera_frame(
    directions: Float[Tensor, "*rays 3"], rotations: Float[Tensor, "*rays 9"]
) -> Float[Tensor, "*rays 3"]:
    """Directions in the camera's axes, ``R^T d``; rotations are camera-to-world, row by row.

    A sum instead of a matrix product, which automatic mixed precision would compute with half the digits.
    """
    return (rotations.unflatten(-1, (3, 3)) * directions[..., :, None]).sum(dim=-2)


def image_coordinates(
    directions: Float[Tensor, "*rays 3"], intrinsics: PinholeIntrinsics, distortion: tuple[float, float, float, float]
) -> tuple[Float[Tensor, "*rays 2"], Bool[Tensor, "*rays"]]:
    """Pixel coordinates (x, y; from the image's corner) of directions in the camera's frame, OpenGL axes.

    Lens distortion is OpenCV's (k1, k2, p1, p2), a polynomial that holds within the image: coordinates of directions
    far outside it are meaningless.

    Returns:
        The coordinates, and which directions point forward; the coordinates of the others are meaningless.
    """
    import torch

    forward = directions[..., 2] < 0.0
    depth = torch.where(forward, -directions[..., 2], 1.0)
    x, y = directions[..., 0] / depth, -directions[..., 1] / depth
    k1, k2, p1, p2 = distortion
    squared = x * x + y * y
    radial = 1.0 + squared * (k1 + squared * k2)
    distorted_x = x * radial + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x)
    distorted_y = y * radial + 2.0 * p2 * x * y + p1 * (squared + 2.0 * y * y)
    pixels = [intrinsics.fl_x * distorted_x + intrinsics.cx, intrinsics.fl_y * distorted_y + intrinsics.cy]
    return torch.stack(pixels, dim=-1), forward


def pixel_rays(
    intrinsics: PinholeIntrinsics, camera_to_world: Float[np.ndarray, "4 4"], pixels: Float[np.ndarray, "*n 2"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "*n 3"]]:
    """Origin and unit directions of the rays through pixel coordinates, in the object's frame."""
    in_camera = np.stack(
        [
            (pixels[..., 0] - intrinsics.cx) / intrinsics.fl_x,
            -(pixels[..., 1] - intrinsics.cy) / intrinsics.fl_y,
            -np.ones(pixels.shape[:-1]),
        ],
        axis=-1,
    )
    directions = in_camera @ camera_to_world[:3, :3].T
    return camera_to_world[:3, 3], unit_vectors(directions)


def closest_point_to_rays(
    origins: Float[np.ndarray, "*n 3"],
    directions: Float[np.ndarray, "*n 3"],
    index: Int[np.ndarray, "*n"] | None = None,
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p"]]:
    """Triangulate points: minimise the sum of squared distances to the rays of each point.

    Args:
        origins: a point on each ray, metres or any other unit; broadcast against ``directions``.
        directions: unit directions.
        index: the point that each ray belongs to, 0 to p - 1; one point for all rays if not given.

    Returns:
        The points, and the smallest eigenvalue of each normal matrix: 0 for parallel rays, at most 2/3 per ray.
    """
    perpendicular = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    vectors = (perpendicular @ origins[..., None])[..., 0]
    index = np.zeros(directions.shape[:-1], int) if index is None else index
    size = int(index.max(initial=-1)) + 1
    normal, right = np.zeros((size, 3, 3)), np.zeros((size, 3))
    np.add.at(normal, index, perpendicular)
    np.add.at(right, index, vectors)
    eigenvalues, axes = np.linalg.eigh(normal)
    along_axes = np.einsum("pij,pi->pj", axes, right)
    # The pseudo-inverse leaves out directions that the rays do not determine.
    known = eigenvalues > 1e-12 * eigenvalues[:, 2:]
    coordinates = np.where(known, along_axes / np.where(known, eigenvalues, 1.0), 0.0)
    return np.einsum("pij,pj->pi", axes, coordinates), eigenvalues[:, 0]


def unit_vectors(vectors: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n k"]:
    """Vectors of length 1 in the same directions; 0 stays 0."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def cross_matrix(v: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Matrices [v]x with [v]x w = v x w."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 2, 1], matrix[..., 0, 2], matrix[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return matrix - np.swapaxes(matrix, -1, -2)


def rotation_angle_deg(
    a: Float[np.ndarray, "*n rows columns"], b: Float[np.ndarray, "*n rows columns"]
) -> Float[np.ndarray, "*n"]:
    """Angle between the rotations of two poses or matrices, degrees (from the chord: accurate for tiny angles)."""
    chord = np.linalg.norm(a[..., :3, :3] - b[..., :3, :3], axis=(-2, -1)) / (2.0 * np.sqrt(2.0))
    return np.rad2deg(2.0 * np.arcsin(np.minimum(1.0, chord)))


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation."""

    scale: float = 1.0
    rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    translation: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The points moved."""
        return self.scale * points @ self.rotation.T + self.translation

    def after(self, first: Similarity) -> Similarity:
        """The transformation that does ``first`` and then this."""
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, self(first.translation[None])[0])

    def inverse(self) -> Similarity:
        """The transformation back."""
        back = self.rotation.T / self.scale
        return Similarity(1.0 / self.scale, self.rotation.T, -back @ self.translation)

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """The transformation as a homogeneous matrix."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix

    @classmethod
    def from_matrix(cls, matrix: Float[np.ndarray, "4 4"]) -> Similarity:
        """The transformation of a homogeneous matrix that is a similarity."""
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return cls(scale, matrix[:3, :3] / scale, matrix[:3, 3])

    def turn_deg(self) -> float:
        """Angle of the rotation, degrees."""
        return float(np.rad2deg(Rotation.from_matrix(self.rotation).magnitude()))
