"""Effects of the turntable and of the camera pose: angles, missing frames, tilt, wobble and eccentricity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import rotation_about_z, turntable_camera_to_world
from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effect import Effect


@dataclass(frozen=True)
class FramePlan:
    """The frames of a session, in the order in which they are taken.

    Attributes:
        room_camera: camera-to-world pose of the stationary camera, with the turntable at angle 0.
        angles_deg: true angle of the turntable in each frame, positive counter-clockwise.
        elapsed: time of each frame as a fraction of the session, in [0, 1].
        nominal_step_deg: step as the operator states it in ``session.json``, positive.
        direction: direction of rotation as the operator states it, seen from above.
        tilts: rotation of the turntable axis in each frame.
    """

    room_camera: Float[np.ndarray, "4 4"]
    angles_deg: Float[np.ndarray, "n"]
    elapsed: Float[np.ndarray, "n"]
    nominal_step_deg: float
    direction: Literal["ccw", "cw"]
    tilts: Float[np.ndarray, "n 3 3"]

    @property
    def camera_to_world(self) -> Float[np.ndarray, "n 4 4"]:
        """Camera pose of each frame in the object frame.

        A point X of the object is at ``tilt Rot(z, angle) X`` in the room; the camera pose is transformed by the
        inverse.
        """
        cameras = np.tile(self.room_camera, (len(self.angles_deg), 1, 1))
        cameras[:, :3] = self.tilts.swapaxes(1, 2) @ cameras[:, :3]
        return np.stack([turntable_camera_to_world(*one) for one in zip(cameras, self.angles_deg, strict=True)])

    def select(self, frames: np.ndarray) -> FramePlan:
        """The plan of the given frame indices, in that order, with their times."""
        of_frames = {name: getattr(self, name)[frames] for name in ("angles_deg", "elapsed", "tilts")}
        return replace(self, **of_frames)


class MotionEffect(Effect):
    """Changes which frames are taken, and the camera poses."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """The plan under the effect."""
        raise NotImplementedError


@dataclass(frozen=True)
class PartialTurn(MotionEffect):
    """The turntable covers less than a full turn, in the same number of frames."""

    name: ClassVar[str] = "partial_turn"
    span_deg: float = between(1.0, 360.0, default=180.0)
    """Angle from the first to the last frame, degrees."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Scale all steps; ``session.json`` states the scaled step."""
        step_deg = self.span_deg / max(len(plan.angles_deg) - 1, 1)
        return replace(
            plan, angles_deg=plan.angles_deg * (step_deg / plan.nominal_step_deg), nominal_step_deg=step_deg
        )


@dataclass(frozen=True)
class Clockwise(MotionEffect):
    """The turntable rotates clockwise seen from above; ``session.json`` says so."""

    name: ClassVar[str] = "clockwise"

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Reverse the plan."""
        return replace(plan, angles_deg=-plan.angles_deg, direction="cw")


@dataclass(frozen=True)
class AngleJitter(MotionEffect):
    """The angle of each frame but the first has a random error."""

    name: ClassVar[str] = "angle_jitter"
    spread_deg: float = between(0.0, 10.0, default=1.0)
    """Largest error, degrees; errors are uniform in [-spread_deg, spread_deg]."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Add an error to each angle but the first."""
        errors_deg = rng.uniform(-self.spread_deg, self.spread_deg, len(plan.angles_deg))
        errors_deg[0] = 0.0
        return replace(plan, angles_deg=plan.angles_deg + errors_deg)


@dataclass(frozen=True)
class AxisTilt(MotionEffect):
    """The camera is rolled about its optical axis, so the turntable axis is tilted in the image."""

    name: ClassVar[str] = "axis_tilt"
    tilt_deg: float = between(-180.0, 180.0, default=3.0)
    """Roll of the camera, degrees; a positive roll tilts the turntable axis to the right in the image."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Roll the camera."""
        return replace(plan, room_camera=plan.room_camera @ rotation_about_z(self.tilt_deg))


@dataclass(frozen=True)
class Wobble(MotionEffect):
    """The turntable axis precesses: it is tilted by a constant angle towards an azimuth that rotates with the disc.

    The axis is tilted about the point where it meets the disc; in the first frame it is tilted towards the camera.
    """

    name: ClassVar[str] = "wobble"
    amplitude_deg: float = between(0.0, 20.0, default=0.3)
    """Angle between the axis with and without wobble, degrees."""
    cycles_per_turn: float = between(0.0, 100.0, default=2.0)
    """Turns of the azimuth in one turn of the disc.

    With 1 the disc is tilted on a fixed axis, with 0 a fixed axis is tilted; the camera then moves on a circle around
    the object. With any other value it does not.
    """

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Tilt the axis in each frame."""
        tilts = [_tilt(self.amplitude_deg, self.cycles_per_turn * angle) for angle in plan.angles_deg]
        return replace(plan, tilts=np.stack(tilts))


@dataclass(frozen=True)
class RepeatedFrames(MotionEffect):
    """The turntable does not step, and the same view is captured twice."""

    name: ClassVar[str] = "repeated_frames"
    count: int = between(0, 3600, default=2)
    """Number of randomly chosen frames that are captured twice in a row."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Insert the second captures; times are evenly spaced over the session.

        Raises:
            InputError: ``count`` exceeds the number of frames.
        """
        frames = len(plan.angles_deg)
        if self.count > frames:
            raise InputError(
                f"effects.{self.name}.count is {self.count}, but the turntable takes {frames} frames; repeat fewer."
            )
        twice = rng.choice(frames, self.count, replace=False)
        longer = plan.select(np.sort(np.concatenate([np.arange(frames), twice])))
        return replace(longer, elapsed=np.linspace(0.0, plan.elapsed[-1], frames + self.count))


@dataclass(frozen=True)
class MissingFrames(MotionEffect):
    """Some frames are missing, and the captures are numbered without gaps."""

    name: ClassVar[str] = "missing_frames"
    count: int = between(0, 3600, default=2)
    """Number of randomly chosen frames that are missing; the first frame is never missing."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Remove frames; the others keep their angles and times.

        Raises:
            InputError: ``count`` leaves no frame.
        """
        frames = len(plan.angles_deg)
        if self.count >= frames:
            raise InputError(
                f"effects.{self.name}.count is {self.count}, but of the turntable's {frames} frames the first is "
                "always taken; leave out fewer."
            )
        missing = rng.permutation(np.arange(1, frames))[: self.count]
        return plan.select(np.delete(np.arange(frames), missing))


@dataclass(frozen=True)
class OffCentre(Effect):
    """Disc, container and object are not centred on the turntable axis."""

    name: ClassVar[str] = "off_centre"
    shift_m: float = between(0.0, 0.1, default=0.005)
    """Distance of the disc's centre from the axis, metres."""
    azimuth_deg: float = between(-360.0, 360.0, default=90.0)
    """Direction of the disc's centre in the first frame, counter-clockwise from the camera, degrees."""

    def offset_m(self) -> Float[np.ndarray, "3"]:
        """Shift in the plane of the disc."""
        azimuth = np.deg2rad(self.azimuth_deg)
        return self.shift_m * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])


def _tilt(angle_deg: float, azimuth_deg: float) -> Float[np.ndarray, "3 3"]:
    """Shortest rotation that tilts the z axis by ``angle_deg`` towards ``azimuth_deg``."""
    a = np.deg2rad(angle_deg)
    about_y = np.array([[np.cos(a), 0.0, np.sin(a)], [0.0, 1.0, 0.0], [-np.sin(a), 0.0, np.cos(a)]])
    to_azimuth = rotation_about_z(azimuth_deg)[:3, :3]
    return to_azimuth @ about_y @ to_azimuth.T


EFFECTS: tuple[type[Effect], ...] = (
    PartialTurn,
    Clockwise,
    AngleJitter,
    AxisTilt,
    Wobble,
    RepeatedFrames,
    MissingFrames,
    OffCentre,
)
"""The effects in the order in which they act."""
