"""The turntable model: a fixed camera, one axis, one angle per frame; its projection and the Jacobian of it.

Symbols: f frames, m markers, p points, n rows of one observed point each. The turntable frame has z along the axis,
up, and the camera at (distance, 0, 0). In frame i a point X of the object has the OpenCV camera coordinates

    camera_rotation (T_i X + s_i - (distance, 0, 0)),    T_i = tilt_i Rot(z, angle_i),

where tilt_i and the shift s_i are small motions of a wobbling table; a perfect turntable has none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from typing_extensions import Self

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL, cross_matrix

FEWEST_FRAMES = 3
"""Fewer frames do not determine a turntable's axis."""
_LEAST_DISTANCE = 0.02
"""Least distance of the camera from the axis, over its distance from the object: where it is smaller, all frames see
the object from within two degrees."""


def require_parallax(distance: float, object_distances: Float[np.ndarray, "n"]) -> None:
    """Refuse an axis through the camera, which is found if the camera turned in its place.

    Args:
        distance: distance of the camera from the axis.
        object_distances: distances of the camera from points of the object, in the same unit.

    Raises:
        InputError: all frames see the object from one side.
    """
    if distance < _LEAST_DISTANCE * np.median(object_distances):
        raise InputError(
            "the axis goes through the camera, so all frames show the object from one side: the camera seems to have "
            "turned in its place; keep it still, and turn the table"
        )


class _Observations:
    """Arrays with one row an observation of a landmark in a frame: the frame, the landmark's number, the rest."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def select(self, keep: np.ndarray) -> Self:
        """The rows that ``keep`` (a mask or indices) selects."""
        return type(self)(*(values[keep] for values in vars(self).values()))


@dataclass(frozen=True)
class MarkerObservations(_Observations):
    """Corners of markers in frames. Pixel origin: the image's upper left corner."""

    frame: Int[np.ndarray, "n"]
    marker: Int[np.ndarray, "n"]
    corners_px: Float[np.ndarray, "n 4 2"]
    covariance_px2: Float[np.ndarray, "n 8 8"]

    def append(self, more: MarkerObservations) -> MarkerObservations:
        """These rows followed by others."""
        pairs = zip(vars(self).values(), vars(more).values(), strict=True)
        return MarkerObservations(*(np.concatenate(pair) for pair in pairs))

    def without_frames(self, frames: np.ndarray | list[int]) -> MarkerObservations:
        """The rows of other frames."""
        return self.select(~np.isin(self.frame, frames))


@dataclass(frozen=True)
class Tracks(_Observations):
    """Points of the object in frames. Pixel origin: the image's upper left corner."""

    frame: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "n"]
    pixels: Float[np.ndarray, "n 2"]


@dataclass(frozen=True, kw_only=True)
class Turntable:
    """Camera, motion, and landmarks that turn with the object: square markers and points.

    Lengths are metres, or distances of the camera from the axis where no scale is known. ``frames``, ascending, are
    the session's frames that the rows of ``angles_rad`` (and of the motions) belong to.
    """

    focal_px: float
    centre_px: tuple[float, float]
    """Principal point."""
    radial: tuple[float, float] = (0.0, 0.0)
    """Lens distortion: OpenCV's k1 and k2."""
    camera_rotation: Float[np.ndarray, "3 3"]
    """Rotation from the turntable frame to OpenCV camera axes."""
    distance: float = 1.0
    """Distance of the camera from the axis."""
    frames: Int[np.ndarray, "f"]
    angles_rad: Float[np.ndarray, "f"]
    """Counter-clockwise seen from above."""
    motion: Float[np.ndarray, "f 5"] | None = None
    """Rotation vectors (x, y, 0; rad) and shifts (3) of a wobbling table; None for a table that does not wobble."""
    side: float = 1.0
    """Side of the markers' black square."""
    markers: Int[np.ndarray, "m"] = field(default_factory=lambda: np.zeros(0, int))
    """Ids, ascending."""
    marker_poses: Float[np.ndarray, "m 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """Marker to object."""
    points: Int[np.ndarray, "p"] = field(default_factory=lambda: np.zeros(0, int))
    """The tracks' numbers of the points, ascending."""
    points_3d: Float[np.ndarray, "p 3"] = field(default_factory=lambda: np.zeros((0, 3)))

    def motions(self) -> tuple[Float[np.ndarray, "f 3 3"], Float[np.ndarray, "f 3"]]:
        """Rotation T and shift s of the object in each frame."""
        turns = rotations_about_z(self.angles_rad)
        if self.motion is None:
            return turns, np.zeros((len(turns), 3))
        return Rotation.from_rotvec(_tilts(self.motion)).as_matrix() @ turns, self.motion[:, 2:]

    def camera_positions(self) -> Float[np.ndarray, "f 3"]:
        """The camera in the object's axes, frame by frame."""
        rotations, shifts = self.motions()
        return np.einsum("fji,fj->fi", rotations, [self.distance, 0.0, 0.0] - shifts)

    def camera_to_world(self) -> Float[np.ndarray, "f 4 4"]:
        """Camera-to-world in OpenGL axes; the world is the object at the angle 0, z = 0 at the camera's height."""
        rotations, _ = self.motions()
        poses = np.tile(np.eye(4), (len(rotations), 1, 1))
        poses[:, :3, :3] = np.swapaxes(self.camera_rotation @ rotations, 1, 2)
        poses[:, :3, 3] = self.camera_positions()
        return poses @ OPENCV_TO_OPENGL

    def relative_angles_deg(self) -> Float[np.ndarray, "f"]:
        """Angles relative to the first frame, unwrapped."""
        angles_deg = np.rad2deg(np.unwrap(self.angles_rad))
        return angles_deg - angles_deg[0]

    def over_session(self, values: Float[np.ndarray, "f *shape"], size: int) -> Float[np.ndarray, "n *shape"]:
        """Values of the turntable's frames as rows of the session's ``size`` frames, nan for the others."""
        rows = np.full((size, *values.shape[1:]), np.nan)
        rows[self.frames] = values
        return rows

    def rows(self, seen: MarkerObservations | Tracks) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Rows of ``frames``, and of ``markers`` or ``points``, that the observations belong to."""
        known, landmark, _, _ = self._landmarks(seen)
        return np.searchsorted(self.frames, seen.frame), np.searchsorted(known, landmark)

    def knows(self, seen: MarkerObservations | Tracks) -> np.ndarray:
        """Mask of the observations whose frame and landmark the turntable has."""
        known, landmark, _, _ = self._landmarks(seen)
        return np.isin(seen.frame, self.frames) & np.isin(landmark, known)

    def restricted(self, *seen: MarkerObservations | Tracks) -> Turntable:
        """The turntable with only the frames and landmarks that are seen; angles keep their zero."""
        keep = np.isin(self.frames, np.concatenate([part.frame for part in seen]))
        numbers = [
            np.concatenate([np.zeros(0, int), *(self._landmarks(s)[1] for s in seen if isinstance(s, kind))])
            for kind in (MarkerObservations, Tracks)
        ]
        markers, points = np.isin(self.markers, numbers[0]), np.isin(self.points, numbers[1])
        return replace(
            self,
            frames=self.frames[keep],
            angles_rad=self.angles_rad[keep],
            motion=None if self.motion is None else self.motion[keep],
            markers=self.markers[markers],
            marker_poses=self.marker_poses[markers],
            points=self.points[points],
            points_3d=self.points_3d[points],
        )

    def corners(self) -> Float[np.ndarray, "m 4 3"]:
        """Corners of the markers, at the angle 0."""
        return self.corner_offsets() + self.marker_poses[:, None, :3, 3]

    def corner_offsets(self) -> Float[np.ndarray, "m 4 3"]:
        """Corners relative to their marker's centre, in the object's axes."""
        return np.einsum("mij,kj->mki", self.marker_poses[:, :3, :3], square_corners(self.side))

    def reproject(self, seen: MarkerObservations | Tracks) -> Float[np.ndarray, "n *corners 2"]:
        """Pixels of each observation: of a marker's four corners, or of a point."""
        return self.project(seen).pixels.reshape(self._landmarks(seen)[3].shape)

    def project(self, seen: MarkerObservations | Tracks) -> Projection:
        """Projections of each observation's corners, one after the other, or of its point."""
        frame, landmark = self.rows(seen)
        points = self._landmarks(seen)[2][landmark]
        return project(self, np.repeat(frame, points.shape[1]), points.reshape(-1, 3))

    def errors_px(self, seen: MarkerObservations | Tracks) -> Float[np.ndarray, "n"]:
        """Distance of each observation from its projection; of a marker the root mean square over its corners."""
        difference = self.reproject(seen) - self._landmarks(seen)[3]
        return np.sqrt((difference**2).sum(axis=-1).reshape(len(seen), -1).mean(axis=-1))

    def frame_errors_px(self, seen: MarkerObservations | Tracks, size: int) -> tuple[Float[np.ndarray, "n"], float]:
        """Root mean square error in each of the session's ``size`` frames, nan without observations; and in all."""
        squared = self.errors_px(seen) ** 2
        with np.errstate(invalid="ignore"):
            of_frames = np.bincount(seen.frame, squared, size) / np.bincount(seen.frame, minlength=size)
        return np.sqrt(of_frames), float(np.sqrt(squared.mean()))

    def resized(self, factor: float) -> Turntable:
        """The turntable with all lengths times a factor: its images stay the same."""
        poses = self.marker_poses.copy()
        poses[:, :3, 3] *= factor
        return replace(
            self,
            distance=self.distance * factor,
            side=self.side * factor,
            marker_poses=poses,
            points_3d=self.points_3d * factor,
            motion=None if self.motion is None else self.motion * [1.0, 1.0, factor, factor, factor],
        )

    def turned_over(self) -> Turntable:
        """The same turntable, without motions, with the axis pointing the other way (a half turn about x)."""
        half_turn = np.diag([1.0, -1.0, -1.0, 1.0])
        return replace(
            self,
            camera_rotation=self.camera_rotation @ half_turn[:3, :3],
            angles_rad=-self.angles_rad,
            marker_poses=half_turn @ self.marker_poses,
            points_3d=self.points_3d @ half_turn[:3, :3],
        )

    def _landmarks(self, seen):
        """Numbers of this kind's landmarks, of the seen ones; points (l, c, 3) of the former, the latter's pixels."""
        if isinstance(seen, Tracks):
            return self.points, seen.point, self.points_3d[:, None], seen.pixels
        return self.markers, seen.marker, self.corners(), seen.corners_px


@dataclass(frozen=True)
class Projection:
    """Pixels of points, and what the Jacobian needs."""

    pixels: Float[np.ndarray, "n 2"]
    rotation: Float[np.ndarray, "n 3 3"]
    """T of the row's frame."""
    rotated: Float[np.ndarray, "n 3"]
    """T X."""
    in_camera: Float[np.ndarray, "n 3"]
    normalised: Float[np.ndarray, "n 2"]
    """``in_camera`` over its depth."""


@dataclass(frozen=True)
class Jacobian:
    """Derivatives of the pixels."""

    camera: Float[np.ndarray, "n 2 5"]
    """Derivatives by the log of the focal length, a small camera rotation (3, rad), the log of the distance."""
    radial: Float[np.ndarray, "n 2 2"]
    """Derivatives by k1 and k2."""
    angle: Float[np.ndarray, "n 2 1"]
    """Derivatives by the frame's angle, rad."""
    motion: Float[np.ndarray, "n 2 5"] | None
    """Derivatives by the frame's tilt (2, rad) and shift (3); None for a turntable without motions."""
    point: Float[np.ndarray, "n 2 3"]
    """Derivatives by the point, in the object's axes."""
    hidden: Float[np.ndarray, "n 2 k"] | None = None
    """Derivatives by the amplitudes of displacements that the residuals hardly show."""

    def mapped(self, function: Callable[[np.ndarray], np.ndarray]) -> Jacobian:
        """The derivatives after ``function``, which acts on the pixels' axes."""
        return Jacobian(**{name: None if by is None else function(by) for name, by in vars(self).items()})  # type: ignore[arg-type]


def project(turntable: Turntable, frame: Int[np.ndarray, "n"], points: Float[np.ndarray, "n 3"]) -> Projection:
    """Project points of the object in frames (rows of ``turntable.frames``).

    A direction (x, y, 1) appears at (1 + k1 r^2 + k2 r^4) (x, y), as in OpenCV.
    """
    rotations, shifts = turntable.motions()
    rotation = rotations[frame]
    rotated = np.einsum("nij,nj->ni", rotation, points)
    in_camera = (rotated + (shifts - [turntable.distance, 0.0, 0.0])[frame]) @ turntable.camera_rotation.T
    normalised = in_camera[:, :2] / in_camera[:, 2:]
    k1, k2 = turntable.radial
    r2 = (normalised**2).sum(-1, keepdims=True)
    pixels = turntable.focal_px * (1.0 + r2 * (k1 + k2 * r2)) * normalised + turntable.centre_px
    return Projection(pixels, rotation, rotated, in_camera, normalised)


def projection_jacobian(turntable: Turntable, frame: Int[np.ndarray, "n"], projection: Projection) -> Jacobian:
    """Derivatives of ``project``."""
    xy, n = projection.normalised, len(projection.normalised)
    k1, k2 = turntable.radial
    r2 = (xy**2).sum(-1)[:, None, None]
    by_xy = turntable.focal_px * (
        (1.0 + r2 * (k1 + k2 * r2)) * np.eye(2) + (2.0 * k1 + 4.0 * k2 * r2) * xy[:, :, None] * xy[:, None, :]
    )
    depth = projection.in_camera[:, 2, None, None]
    by_camera_point = by_xy @ np.concatenate([np.tile(np.eye(2), (n, 1, 1)), -xy[:, :, None]], axis=-1) / depth
    by_room = by_camera_point @ turntable.camera_rotation
    camera = [
        (projection.pixels - turntable.centre_px)[:, :, None],
        np.cross(projection.in_camera[:, None, :], by_camera_point),
        -turntable.distance * by_room[..., :1],
    ]
    # A tilted table turns about its own axis: the last column of T.
    by_angle = np.cross(projection.rotation[:, :, 2], projection.rotated)
    motion = None
    if turntable.motion is not None:
        left = _left_jacobian(_tilts(turntable.motion))[frame]
        motion = np.concatenate([(by_room @ -cross_matrix(projection.rotated) @ left)[..., :2], by_room], axis=-1)
    return Jacobian(
        camera=np.concatenate(camera, axis=-1),
        radial=turntable.focal_px * xy[:, :, None] * np.concatenate([r2, r2**2], axis=-1),
        angle=by_room @ by_angle[:, :, None],
        motion=motion,
        point=by_room @ projection.rotation,
    )


def square_corners(side_m: float) -> Float[np.ndarray, "4 3"]:
    """A marker's corners in its own frame (x right, y up, z out of the paper), in ArUco's order."""
    return side_m / 2 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def rotations_about_z(angles_rad: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotations about z, counter-clockwise seen from +z."""
    return Rotation.from_rotvec(np.outer(angles_rad, [0.0, 0.0, 1.0])).as_matrix()


def _tilts(motion):
    """Rotation vectors of the table in each frame."""
    return np.pad(motion[:, :2], ((0, 0), (0, 1)))


def _left_jacobian(rotvec):
    """The left Jacobian J of SO(3): d(exp(w) x) = -[exp(w) x]x J(w) dw."""
    angle = np.linalg.norm(rotvec, axis=-1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    cross = cross_matrix(rotvec)
    return np.eye(3) + a * cross + b * (cross @ cross)
