"""Effects of the turntable: which frames are taken, at which angles, from where, and where the disc lies on it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import rotation_about_z
from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effects.stages import FramePlan, MotionEffect, PlacementEffect


@dataclass(frozen=True)
class PartialTurn(MotionEffect):
    """The turntable does not come round: as many frames, in smaller steps."""

    name: ClassVar[str] = "partial_turn"
    span_deg: float = between(1.0, 360.0, default=180.0)
    """Turn from the first to the last frame, degrees."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Shrink all steps alike; the operator knows."""
        step_deg = self.span_deg / max(len(plan.angles_deg) - 1, 1)
        return replace(
            plan, angles_deg=plan.angles_deg * (step_deg / plan.nominal_step_deg), nominal_step_deg=step_deg
        )


@dataclass(frozen=True)
class Clockwise(MotionEffect):
    """The turntable turns clockwise seen from above, whatever the scene's turntable says; the operator knows."""

    name: ClassVar[str] = "clockwise"

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Turn the other way, if it is the other way."""
        if plan.direction == "cw":
            return plan
        return replace(plan, angles_deg=-plan.angles_deg, direction="cw")


@dataclass(frozen=True)
class AngleJitter(MotionEffect):
    """The turntable's steps are not all of one size: each frame but the first is off its angle by chance."""

    name: ClassVar[str] = "angle_jitter"
    spread_deg: float = between(0.0, 10.0, default=1.0)
    """Angles are off by at most this, evenly spread, degrees."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Move each angle but the first."""
        errors_deg = rng.uniform(-self.spread_deg, self.spread_deg, len(plan.angles_deg))
        errors_deg[0] = 0.0
        return replace(plan, angles_deg=plan.angles_deg + errors_deg)


@dataclass(frozen=True)
class AxisTilt(MotionEffect):
    """The camera is not level: it is rolled about its optical axis, so that the turntable leans in the image."""

    name: ClassVar[str] = "axis_tilt"
    tilt_deg: float = between(-180.0, 180.0, default=3.0)
    """Roll of the camera, degrees; where it is positive, the turntable's axis leans to the right in the image."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Roll the camera in its place."""
        return replace(plan, room_camera=plan.room_camera @ rotation_about_z(self.tilt_deg))


@dataclass(frozen=True)
class Wobble(MotionEffect):
    """The turntable's axis sways: it leans by a constant small angle to a side that goes round as the disc turns.

    The axis leans about the point where it meets the disc, in the first frame towards the camera.
    """

    name: ClassVar[str] = "wobble"
    amplitude_deg: float = between(0.0, 20.0, default=0.3)
    """Angle between the axis and its place without wobble, degrees."""
    cycles_per_turn: float = between(0.0, 100.0, default=2.0)
    """How often the side goes round while the disc turns once.

    With 1 the disc sits askew on a steady axis, with 0 a steady axis leans: then the camera's path around the object
    is a circle. With any other number it is not.
    """

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Lean the axis in each frame."""
        tilts = np.stack([_leaning(self.amplitude_deg, self.cycles_per_turn * a) for a in plan.angles_deg])
        return replace(plan, tilts=tilts if plan.tilts is None else tilts @ plan.tilts)


@dataclass(frozen=True)
class RepeatedFrames(MotionEffect):
    """The turntable does not step, and the same view is taken twice."""

    name: ClassVar[str] = "repeated_frames"
    count: int = between(0, 3600, default=2)
    """How many frames are taken twice, one after the other; chance chooses which."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Insert the second exposures; all exposures are evenly spread over the session.

        Raises:
            InputError: there are fewer frames than are to be repeated.
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
    """Some frames were never taken, and files are numbered without gaps all the same."""

    name: ClassVar[str] = "missing_frames"
    count: int = between(0, 3600, default=2)
    """How many frames are missing; chance chooses which, but never the first."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Leave frames out; the others keep their angles and times.

        Raises:
            InputError: not even the first frame would be left.
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
class OffCentre(PlacementEffect):
    """The disc, with all that it carries, does not lie on the turntable's axis."""

    name: ClassVar[str] = "off_centre"
    shift_m: float = between(0.0, 0.1, default=0.005)
    """From the axis to the disc's centre, metres."""
    azimuth_deg: float = between(-360.0, 360.0, default=90.0)
    """Where the disc's centre lies in the first frame, counter-clockwise from the side of the camera, degrees."""

    def offset_m(self) -> Float[np.ndarray, "3"]:
        """Shift along the disc."""
        azimuth = np.deg2rad(self.azimuth_deg)
        return self.shift_m * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])


def _leaning(angle_deg: float, azimuth_deg: float) -> Float[np.ndarray, "3 3"]:
    """The shortest rotation that takes z to the direction ``angle_deg`` off z towards ``azimuth_deg``."""
    a = np.deg2rad(angle_deg)
    about_y = np.array([[np.cos(a), 0.0, np.sin(a)], [0.0, 1.0, 0.0], [-np.sin(a), 0.0, np.cos(a)]])
    to_azimuth = rotation_about_z(azimuth_deg)[:3, :3]
    return to_azimuth @ about_y @ to_azimuth.T
