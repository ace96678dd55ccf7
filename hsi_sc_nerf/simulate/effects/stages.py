"""The stages of the simulation at which an effect can act, in the order of the simulation.

An effect is a frozen dataclass whose fields are its settings. It derives from the base class of each stage in which
it acts and overrides that class's method. Within a stage, effects act in the order of `effects.EFFECTS`, whatever
their order in the scene file. A scene without effects runs no code of any effect.

    motion        which frames are taken, at which turntable angles and from which camera poses
    placement     position of disc, container and object relative to the turntable axis
    deformation   shape of the object in each frame
    lens          direction of the ray of each pixel
    light         light that each visible point sends to the camera
    chamber       what is visible where rays miss everything on the turntable
    optics        image on the sensor
    material      reflectance of the materials in each frame
    illumination  lamps, over time and over the image
    orientation   rotation of the image in the file
    detector      wavelength of each detector pixel
    exposure      integration time
    readout       noise-free counts to digitised counts
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
    """A departure from a matte object, even light and a perfect sensor."""

    name: ClassVar[str]
    """Name in scene files."""


def effect_rng(seed: int, effect: Effect, *exposure: int) -> np.random.Generator:
    """Random generator of one effect, for one exposure or, without ``exposure``, for the whole session.

    It depends on the scene's seed, the effect's name and the exposure only. Other effects and the order in which
    frames are simulated do not change it.
    """
    # The length is part of the seed because NumPy ignores trailing zeros of a seed.
    return np.random.default_rng([seed, zlib.crc32(effect.name.encode()), len(exposure), *exposure])


@dataclass(frozen=True)
class FramePlan:
    """The frames of a session, in the order in which they are taken.

    Attributes:
        room_camera: camera-to-world pose of the stationary camera, with the turntable at angle 0.
        angles_deg: true angle of the turntable in each frame, positive counter-clockwise.
        elapsed: time of each frame as a fraction of the session, in [0, 1].
        nominal_step_deg: step as the operator states it in ``session.json``, positive.
        direction: direction of rotation as the operator states it, seen from above.
        tilts: rotation of the turntable axis in each frame; None if the axis does not move.
    """

    room_camera: Float[np.ndarray, "4 4"]
    angles_deg: Float[np.ndarray, "n"]
    elapsed: Float[np.ndarray, "n"]
    nominal_step_deg: float
    direction: Literal["ccw", "cw"]
    tilts: Float[np.ndarray, "n 3 3"] | None = None

    @property
    def camera_to_world(self) -> Float[np.ndarray, "n 4 4"]:
        """Camera pose of each frame in the object frame.

        A point X of the object is at ``tilt Rot(z, angle) X`` in the room; the camera pose is transformed by the
        inverse.
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
        """The plan of the given frame indices, in that order, with their times."""
        return replace(
            self,
            angles_deg=self.angles_deg[frames],
            elapsed=self.elapsed[frames],
            tilts=None if self.tilts is None else self.tilts[frames],
        )


class MotionEffect(Effect):
    """Changes which frames are taken, and the camera poses."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """The plan under the effect."""
        raise NotImplementedError


class PlacementEffect(Effect):
    """Moves disc, container and object relative to the turntable axis."""

    def offset_m(self) -> Float[np.ndarray, "3"]:
        """Shift in the object frame, metres."""
        raise NotImplementedError


class DeformationEffect(Effect):
    """Changes the shape of the object during the session."""

    def deform(
        self, vertices: Float[np.ndarray, "v 3"], foot_m: Float[np.ndarray, "3"], elapsed: float
    ) -> Float[np.ndarray, "v 3"]:
        """Vertices of the object at time ``elapsed``, in [0, 1]; the object stands on the point ``foot_m``."""
        raise NotImplementedError


class LensEffect(Effect):
    """Bends the rays of the pinhole camera (a `render.Lens`)."""

    def coefficients(self) -> tuple[float, float, float, float]:
        """k1, k2, p1, p2 of OpenCV's model."""
        raise NotImplementedError

    def straighten(
        self, pixels: Float[np.ndarray, "*n 2"], intrinsics: PinholeIntrinsics
    ) -> Float[np.ndarray, "*n 2"]:
        """Pixel coordinates in the pinhole image of what the lens images at ``pixels``."""
        raise NotImplementedError


class LightEffect(Effect):
    """Changes the light that visible points send to the camera."""


class SurfaceLightEffect(LightEffect):
    """Changes the light that leaves the surface equally in all directions and rotates with the object."""

    def on_surface(self, light: SurfaceLight) -> SurfaceLight:
        """The light of the surface under the effect."""
        raise NotImplementedError


class ViewLightEffect(LightEffect):
    """Changes light that depends on the view; acts after all `SurfaceLightEffect`."""

    def at_hits(self, hits: Hits, light: HitLight, camera_to_world: Float[np.ndarray, "4 4"]) -> HitLight:
        """The light under the effect at the hits of the camera's rays."""
        raise NotImplementedError


class ChamberEffect(Effect):
    """Covers the wall of the chamber with a pattern that is stationary in the image."""

    materials: ClassVar[tuple[str, ...]]
    """Materials of the pattern."""

    def cover(
        self, size_px: int, materials: tuple[str, ...], rng: np.random.Generator
    ) -> Float[np.ndarray, "lines samples materials"]:
        """Fractions of ``materials`` in each pixel of the wall, summing to 1."""
        raise NotImplementedError


class OpticsEffect(Effect):
    """Changes the image on the sensor."""

    def image(self, light: Float[np.ndarray, "lines samples columns"]) -> Float[np.ndarray, "lines samples columns"]:
        """The image on the sensor; each column is filtered alone, and its sum over the image stays the same."""
        raise NotImplementedError


class MaterialEffect(Effect):
    """Changes the reflectance of the object during the session."""

    def spectra(
        self,
        endmembers: Float[np.ndarray, "*samples materials bands"],
        materials: Sequence[Material],
        wavelengths_nm: Float[np.ndarray, "*samples bands"],
        elapsed: float,
    ) -> Float[np.ndarray, "*samples materials bands"]:
        """Reflectance of the object's materials at time ``elapsed``; one table a sample under a spectral smile."""
        raise NotImplementedError


class IlluminationEffect(Effect):
    """Changes the light of the lamps over time or over the image, for object and white tarp alike."""

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "#lines #samples #bands"]:
        """Ratio of the light with and without the effect; 1 at the image centre at the start of the session."""
        raise NotImplementedError


class DetectorEffect(Effect):
    """Changes the wavelength of detector pixels."""

    def wavelengths_nm(
        self, centres_nm: Float[np.ndarray, "bands"], samples: int
    ) -> Float[np.ndarray, "samples bands"]:
        """Wavelength of each detector pixel, for the band centres that the header states."""
        raise NotImplementedError


class ExposureEffect(Effect):
    """Changes the integration time."""

    def factor(self, of_white: bool) -> float:
        """Ratio of the integration time to the one at which the white tarp counts the sensor's ``white_level``.

        Args:
            of_white: whether the capture is that of the white tarp; all other frames have one integration time.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class ReadoutContext:
    """Properties of the sensor and of the exposure that a read-out effect needs.

    Attributes:
        largest_count: largest count of the digitiser.
        dark_level: counts without light.
        electrons_per_count: gain of the sensor.
        maps: result of the effect's `ReadoutEffect.detector_maps`.
        rng: random generator of this exposure.
    """

    largest_count: int
    dark_level: int
    electrons_per_count: float
    maps: Mapping[str, np.ndarray]
    rng: np.random.Generator


class ReadoutEffect(Effect):
    """Changes counts before they are digitised, in frames, white and dark cubes alike."""

    def detector_maps(self, samples: int, bands: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Maps (samples, bands) that are the same in every exposure, by name; stored with the truth."""
        return {}

    def read_out(
        self, counts: Float[np.ndarray, "lines samples bands"], context: ReadoutContext
    ) -> Float[np.ndarray, "lines samples bands"]:
        """Counts under the effect, dark level included, neither rounded nor clipped; may overwrite ``counts``."""
        raise NotImplementedError


class OrientationEffect(Effect):
    """Rotates the image on the sensor, whose line is the sample axis of the file."""

    def orient(self, image: np.ndarray) -> np.ndarray:
        """An upright image (lines, samples, ...) as the file holds it."""
        raise NotImplementedError
