"""The places in the simulation where an effect can act, in the order in which they are passed.

An effect is a frozen dataclass whose fields are its strengths; it derives from the stages that it acts in and
overrides their one method. A stage is a loop over the named effects of its kind: without any, no code of any effect
runs. Within a stage effects act in the order of `effects.EFFECTS`, whatever the order in the scene file.

    motion        which frames are taken, at which angles, from where
    placement     where disc, container and object lie with respect to the axis
    deformation   the object's shape in each frame
    lens          which ray each pixel looks along
    light         how much light each visible point sends to the camera, and of which materials' colours
    chamber       what is seen where the rays miss everything that turns
    optics        the image on the sensor
    material      the materials' spectra in each frame
    illumination  the lamps, in time and over the image
    orientation   how the image lies on the sensor, and so in the file
    detector      which wavelength each detector pixel sees
    exposure      how long the sensor collects light
    readout       from noise-free counts to what is digitised
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, turntable_camera_to_world

if TYPE_CHECKING:
    from hsi_sc_nerf.simulate.light import HitLight, SurfaceLight
    from hsi_sc_nerf.simulate.materials import Material
    from hsi_sc_nerf.simulate.render import Hits


class Effect:
    """A physical phenomenon beyond a matte object under even light that a perfect sensor sees."""

    name: ClassVar[str]
    """As it is written in a scene file."""


def effect_rng(seed: int, effect: Effect, *exposure: int) -> np.random.Generator:
    """The random numbers of one effect, in one exposure or (without) for the whole session.

    They depend on the scene's seed, the effect's name and the exposure alone, so that neither another effect nor the
    order in which frames are made changes them.
    """
    # The length goes with them, because NumPy takes a seed that ends in zeros for the shorter one.
    return np.random.default_rng([seed, zlib.crc32(effect.name.encode()), len(exposure), *exposure])


@dataclass(frozen=True)
class FramePlan:
    """The frames of a session, in the order in which they are taken.

    Attributes:
        room_camera: camera-to-world of the camera that stands still, for a turntable at angle 0.
        angles_deg: the turntable's true angle in each frame, positive counter-clockwise.
        elapsed: time of each frame as a fraction of the session, 0 to 1.
        nominal_step_deg: what the operator believes the step to be, positive.
        direction: what the operator believes the turn to be, seen from above.
        tilts: rotation of the turntable's axis out of its place in each frame, or None where it keeps its place.
    """

    room_camera: Float[np.ndarray, "4 4"]
    angles_deg: Float[np.ndarray, "n"]
    elapsed: Float[np.ndarray, "n"]
    nominal_step_deg: float
    direction: Literal["ccw", "cw"]
    tilts: Float[np.ndarray, "n 3 3"] | None = None

    @property
    def camera_to_world(self) -> Float[np.ndarray, "n 4 4"]:
        """Pose of the camera in each frame, object frame.

        A point X of the object lies at ``tilt Rot(z, angle) X`` in the room, so the camera lies at the inverse of
        that times its place in the room.
        """
        poses = []
        for i, angle in enumerate(self.angles_deg):
            camera = self.room_camera
            if self.tilts is not None:
                camera = camera.copy()
                camera[:3] = self.tilts[i].T @ camera[:3]
            poses.append(turntable_camera_to_world(camera, angle))
        return np.stack(poses)

    def select(self, frames: np.ndarray) -> FramePlan:
        """Only the given frames, by index, in the given order; the times stay the ones of their places."""
        return replace(
            self,
            angles_deg=self.angles_deg[frames],
            elapsed=self.elapsed[frames],
            tilts=None if self.tilts is None else self.tilts[frames],
        )


class MotionEffect(Effect):
    """Changes which frames are taken and from where."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """The plan with the effect in it."""
        raise NotImplementedError


class PlacementEffect(Effect):
    """Puts all that turns somewhere else with respect to the axis."""

    def offset_m(self) -> Float[np.ndarray, "3"]:
        """Shift of disc, markers, container and object in the object frame, metres."""
        raise NotImplementedError


class DeformationEffect(Effect):
    """Changes the object's shape in the course of the session."""

    def deform(
        self, vertices: Float[np.ndarray, "v 3"], foot_m: Float[np.ndarray, "3"], elapsed: float
    ) -> Float[np.ndarray, "v 3"]:
        """The object's vertices at a time of the session; ``foot_m`` is the point that it stands on."""
        raise NotImplementedError


class LensEffect(Effect):
    """Bends the rays of the pinhole camera."""

    def coefficients(self) -> tuple[float, float, float, float]:
        """k1, k2, p1, p2 of OpenCV's model."""
        raise NotImplementedError

    def straighten(
        self, pixels: Float[np.ndarray, "*n 2"], intrinsics: PinholeIntrinsics
    ) -> Float[np.ndarray, "*n 2"]:
        """Where a camera without the effect sees what is seen at these pixel coordinates."""
        raise NotImplementedError


class LightEffect(Effect):
    """Changes how much light each visible point sends to the camera, and of which colours."""


class SurfaceLightEffect(LightEffect):
    """Changes the light of the surface, which is the same from everywhere and turns with the object."""

    def on_surface(self, light: SurfaceLight) -> SurfaceLight:
        """The surface's light with the effect."""
        raise NotImplementedError


class ViewLightEffect(LightEffect):
    """Changes what the surface's light becomes on its way to the camera; acts after those on the surface."""

    def at_hits(self, hits: Hits, light: HitLight, camera_to_world: Float[np.ndarray, "4 4"]) -> HitLight:
        """The light with the effect, where the camera's rays hit."""
        raise NotImplementedError


class ChamberEffect(Effect):
    """Puts something in front of the chamber's wall: it stands still in the image."""

    materials: ClassVar[tuple[str, ...]]
    """Materials that it needs beside the scene's."""

    def cover(
        self, size_px: int, materials: tuple[str, ...], rng: np.random.Generator
    ) -> Float[np.ndarray, "lines samples materials"]:
        """What each pixel sees where it sees the chamber: fractions of ``materials`` that sum to 1."""
        raise NotImplementedError


class OpticsEffect(Effect):
    """Changes the image between the object and the sensor."""

    def image(self, light: Float[np.ndarray, "lines samples columns"]) -> Float[np.ndarray, "lines samples columns"]:
        """The image on the sensor; acts on each column alone and keeps their sum over the image."""
        raise NotImplementedError


class MaterialEffect(Effect):
    """Changes the object's spectra in the course of the session."""

    def spectra(
        self,
        endmembers: Float[np.ndarray, "*samples materials bands"],
        materials: Sequence[Material],
        wavelengths_nm: Float[np.ndarray, "*samples bands"],
        elapsed: float,
    ) -> Float[np.ndarray, "*samples materials bands"]:
        """Reflectance of the object's materials at a time of the session; tables a sample for a detector's smile."""
        raise NotImplementedError


class IlluminationEffect(Effect):
    """Changes the lamps in time or over the image, for the object and the white tarp alike."""

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "#lines #samples #bands"]:
        """Light with the effect over light without it; 1 at the image's centre at the start of the session."""
        raise NotImplementedError


class DetectorEffect(Effect):
    """Changes which wavelength a detector pixel sees."""

    def wavelengths_nm(
        self, centres_nm: Float[np.ndarray, "bands"], samples: int
    ) -> Float[np.ndarray, "samples bands"]:
        """Wavelength at each sample of the detector's line, for the band centres that the header states."""
        raise NotImplementedError


class ExposureEffect(Effect):
    """Changes how long the sensor collects light."""

    def factor(self, of_white: bool) -> float:
        """The integration time over the one for which the sensor's ``white_level`` is right.

        ``of_white`` asks for that of the white tarp's capture, otherwise it is the one that all frames share.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class ReadoutContext:
    """What a read-out knows beside the counts.

    Attributes:
        largest_count: of the digitiser.
        dark_level: counts without light.
        electrons_per_count: the sensor's gain.
        maps: of this effect, from its `ReadoutEffect.detector_maps`.
        rng: random numbers of this exposure.
    """

    largest_count: int
    dark_level: int
    electrons_per_count: float
    maps: Mapping[str, np.ndarray]
    rng: np.random.Generator


class ReadoutEffect(Effect):
    """Changes counts between the light and the digitiser: of frames, white and dark cubes alike."""

    def detector_maps(self, samples: int, bands: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """What belongs to the detector's pixels (samples, bands) and is the same in every exposure, by name.

        It is drawn once and kept in the truth; by default there is nothing.
        """
        return {}

    def read_out(
        self, counts: Float[np.ndarray, "lines samples bands"], context: ReadoutContext
    ) -> Float[np.ndarray, "lines samples bands"]:
        """Counts with the effect, not yet rounded or clipped; dark counts are in them already.

        ``counts`` (float32) may be overwritten.
        """
        raise NotImplementedError


class OrientationEffect(Effect):
    """Changes how the image lies on the sensor, whose line is the samples of the file."""

    def orient(self, image: np.ndarray) -> np.ndarray:
        """An upright image (lines, samples, ...) as it lies in the file."""
        raise NotImplementedError
