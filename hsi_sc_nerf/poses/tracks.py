"""Points of the object that are seen in several frames, and the machine that explains where they are seen.

Features alone do not tell a scale: the unit of length is the distance between camera and axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL, rotation_about_z


@dataclass(frozen=True)
class Tracks:
    """Points of the object that were found in several frames: one row a point seen in a frame.

    Pixel coordinates have their origin at the image's upper left corner.
    """

    frame: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "n"]
    pixels: Float[np.ndarray, "n 2"]

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, keep: np.ndarray) -> Tracks:
        """The rows that ``keep`` (a mask or indices) picks."""
        return Tracks(self.frame[keep], self.point[keep], self.pixels[keep])


@dataclass(frozen=True)
class TrackedTurntable:
    """Camera, motion and points, in units of the distance between camera and axis.

    The frame: z is the turntable's axis, up; the camera sits at (1, 0, 0). A point X of the object is in frame i at
    the camera's coordinates ``camera_rotation @ (Rot(z, angle_i) X - (1, 0, 0))``, in OpenCV's axes. ``frames`` and
    ``points``, ascending, say which frame and point of the tracks the rows of ``angles_rad`` and ``places`` are.
    """

    focal_px: float
    centre_px: tuple[float, float]
    radial: tuple[float, float]
    """OpenCV's k1, k2."""
    camera_rotation: Float[np.ndarray, "3 3"]
    frames: Int[np.ndarray, "f"]
    angles_rad: Float[np.ndarray, "f"]
    points: Int[np.ndarray, "p"]
    places: Float[np.ndarray, "p 3"]

    def rows(self, tracks: Tracks) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Rows of ``angles_rad`` and of ``places`` that the tracks' rows belong to."""
        return np.searchsorted(self.frames, tracks.frame), np.searchsorted(self.points, tracks.point)

    def restricted(self, tracks: Tracks) -> TrackedTurntable:
        """The turntable with only the frames and points of the tracks; angles keep their zero."""
        frames, points = np.isin(self.frames, tracks.frame), np.isin(self.points, tracks.point)
        return replace(
            self,
            frames=self.frames[frames],
            angles_rad=self.angles_rad[frames],
            points=self.points[points],
            places=self.places[points],
        )

    def camera_to_world(self) -> Float[np.ndarray, "f 4 4"]:
        """Camera-to-world in OpenGL axes; the world is the object at angle 0, its origin at the camera's height."""
        first = np.eye(4)
        first[:3, :3], first[0, 3] = self.camera_rotation.T, 1.0
        return np.stack([rotation_about_z(-np.rad2deg(a)) @ first @ OPENCV_TO_OPENGL for a in self.angles_rad])


def reproject(turntable: TrackedTurntable, tracks: Tracks) -> Float[np.ndarray, "n 2"]:
    """Where the turntable puts each row of the tracks, pixels."""
    return project(turntable, *turntable.rows(tracks))[0]


def project(
    turntable: TrackedTurntable, frame: Int[np.ndarray, "n"], point: Int[np.ndarray, "n"]
) -> tuple[
    Float[np.ndarray, "n 2"],
    Float[np.ndarray, "n 3"],
    Float[np.ndarray, "n 3"],
    Float[np.ndarray, "n 2"],
    Float[np.ndarray, "n 3 3"],
]:
    """Pixels of the turntable's points in its frames (rows of its arrays), and what their derivatives need.

    These are the points in the room and before the camera, the latter over their depth, and the turns.
    """
    turn = Rotation.from_rotvec(np.outer(turntable.angles_rad, [0.0, 0.0, 1.0])).as_matrix()[frame]
    in_room = np.einsum("nij,nj->ni", turn, turntable.places[point])
    in_camera = (in_room - [1.0, 0.0, 0.0]) @ turntable.camera_rotation.T
    flat = in_camera[:, :2] / in_camera[:, 2:]
    squared = (flat**2).sum(-1, keepdims=True)
    k1, k2 = turntable.radial
    pixels = turntable.focal_px * (1.0 + squared * (k1 + k2 * squared)) * flat + turntable.centre_px
    return pixels, in_room, in_camera, flat, turn
