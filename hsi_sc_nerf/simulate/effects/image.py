"""Effects of the image: the wall behind the object, drying, lamps over time and over the image, and the lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Float
from scipy.ndimage import correlate1d
from scipy.special import ive

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effect import Effect
from hsi_sc_nerf.simulate.light import lamp_photons
from hsi_sc_nerf.simulate.materials import Material, PlantTissue, over, smooth_noise, smoothstep, water_absorbance

BLOTCH_SCALES = (0.20, 0.08, 0.03)
"""Width of the blotches of paint as a fraction of the image side."""
EDGE_STEEPNESS = 8.0
"""Slope of a blotch's fraction over the noise value at its edge."""
BOARDS, JOINT_WIDTH = 5, 0.008
"""Number of boards across the image; width of the black joints as a fraction of the image side."""
REFERENCE_NM = 700.0
"""Wavelength at which a change of colour temperature does not change the light."""
Coefficients = tuple[float, float, float, float]
UNDISTORTION_STEPS, UNDISTORTION_GOAL = 500, 1e-13
UNDISTORTED_TO = 1e-10
"""Largest residual of an undistortion that converged, as a fraction of the focal length: about 1e-7 pixel."""


@dataclass(frozen=True)
class TexturedBackground(Effect):
    """The wall of the chamber is made of boards with blotches of paint, which are stationary in the image.

    Structure from motion finds more features on the wall than on the object and estimates a stationary camera.
    """

    name: ClassVar[str] = "textured_background"
    materials: ClassVar[tuple[str, ...]] = ("plywood", "blue_paint", "black_paint")
    contrast: float = between(0.0, 1.0, default=1.0)
    """Fraction of the pattern in the wall; the rest is the white chamber."""

    def cover(
        self, size_px: int, materials: tuple[str, ...], rng: np.random.Generator
    ) -> Float[np.ndarray, "lines samples materials"]:
        """Fractions of ``materials`` in each pixel of the wall: boards with black joints and blotches of paint."""
        wood, blue, black = np.eye(3)
        centres = (np.arange(size_px) + 0.5) / size_px
        y, x = (axis.ravel() for axis in np.meshgrid(centres, centres, indexing="ij"))
        points = np.stack([x, y, np.zeros_like(x)], axis=-1)
        pattern = np.tile(wood, (size_px**2, 1))
        from_joint = np.abs((x * BOARDS + rng.uniform()) % 1.0 - 0.5) / BOARDS
        pattern = over(pattern, black, smoothstep((JOINT_WIDTH - from_joint) / JOINT_WIDTH + 0.5))
        for scale, paint in zip(BLOTCH_SCALES, (blue, black, blue), strict=True):
            field = smooth_noise(points, scale, rng)
            pattern = over(pattern, paint, smoothstep(EDGE_STEEPNESS * (field - 0.4)))
        fractions = np.zeros((size_px**2, len(materials)))
        fractions[:, [materials.index(name) for name in self.materials]] = self.contrast * pattern
        fractions[:, -1] += 1.0 - self.contrast
        return fractions.reshape(size_px, size_px, -1)


@dataclass(frozen=True)
class Drying(Effect):
    """Plant tissue loses water at a constant rate, and its water absorption bands (970 nm and others) fade.

    Materials with a measured spectrum do not change, because their water content is not known.
    """

    name: ClassVar[str] = "drying"
    water_loss: float = between(0.0, 1.0, default=0.3)
    """Fraction of the water that is lost at the end of the session."""

    def spectra(
        self,
        endmembers: Float[np.ndarray, "*samples materials bands"],
        materials: Sequence[Material],
        wavelengths_nm: Float[np.ndarray, "*samples bands"],
        elapsed: float,
    ) -> Float[np.ndarray, "*samples materials bands"]:
        """Reflectance of the object's materials at time ``elapsed``, in [0, 1], without the lost water."""
        water = np.array([m.water if isinstance(m, PlantTissue) else 0.0 for m in materials])
        lost = self.water_loss * elapsed * water[:, None] * water_absorbance(wavelengths_nm)[..., None, :]
        # Rounding must not lift a reflectance above 1.
        return np.minimum(endmembers * 10.0**lost, 1.0)


class IlluminationEffect(Effect):
    """Changes the light of the lamps over time or over the image, for object and white tarp alike."""

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "#lines #samples #bands"]:
        """Ratio of the light with and without the effect; 1 at the image centre at the start of the session."""
        raise NotImplementedError


@dataclass(frozen=True)
class DriftingLamps(IlluminationEffect):
    """The output of the lamps drifts exponentially after the capture of the white tarp."""

    name: ClassVar[str] = "lamp_drift"
    percent: float = between(-90.0, 900.0, default=-5.0)
    """Change of the light at 700 nm over the session, percent."""
    temperature_change_k: float = between(-1000.0, 1000.0, default=0.0)
    """Change of the colour temperature over the session, kelvin."""
    settling: float = between(0.02, 100.0, default=0.5)
    """Time constant as a fraction of the session; a large value gives a linear drift."""

    def progress(self, elapsed: float) -> float:
        """Fraction of the whole change at time ``elapsed``: 0 at the start of the session, 1 at its end."""
        return float(np.expm1(-elapsed / self.settling) / np.expm1(-1.0 / self.settling))

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "1 1 bands"]:
        """Ratio of the output to that at the start: the drift at 700 nm times a ratio of Planck spectra."""
        done = self.progress(elapsed)
        now_k = lamp_temperature_k + done * self.temperature_change_k
        at_reference = np.asarray(REFERENCE_NM)
        tilt = lamp_photons(wavelengths_nm, now_k) / lamp_photons(wavelengths_nm, lamp_temperature_k)
        tilt /= lamp_photons(at_reference, now_k) / lamp_photons(at_reference, lamp_temperature_k)
        factor = (1.0 + done * self.percent / 100.0) * tilt
        return factor[None, None].astype(np.float32)


@dataclass(frozen=True)
class IlluminationFalloff(IlluminationEffect):
    """The image darkens towards its edges by the cos⁴ law, for object and white tarp alike."""

    name: ClassVar[str] = "illumination_falloff"
    edge_loss: float = between(0.0, 0.95, default=0.2)
    """Fraction of the light that is missing in the corners of the image."""

    def factor(
        self, size_px: int, wavelengths_nm: Float[np.ndarray, "bands"], lamp_temperature_k: float, elapsed: float
    ) -> Float[np.ndarray, "lines samples 1"]:
        """cos⁴ of an angle whose tangent is proportional to the distance from the image centre."""
        from_centre = (np.arange(size_px) + 0.5) / size_px - 0.5
        # Normalised to 1 in the corners.
        distance_squared = 2.0 * (from_centre[:, None] ** 2 + from_centre**2)
        corner_tangent_squared = (1.0 - self.edge_loss) ** -0.5 - 1.0
        return ((1.0 + corner_tangent_squared * distance_squared) ** -2.0)[..., None].astype(np.float32)


@dataclass(frozen=True)
class OpticalBlur(Effect):
    """The lens blurs the image with a Gaussian of the same width in all bands."""

    name: ClassVar[str] = "optical_blur"
    sigma_px: float = between(0.05, 50.0, default=0.6)
    """Standard deviation along each axis, pixels."""

    def image(self, light: Float[np.ndarray, "lines samples columns"]) -> Float[np.ndarray, "lines samples columns"]:
        """The blurred image; reflection at the borders conserves the total."""
        kernel = gaussian_kernel(self.sigma_px)
        for axis in (0, 1):
            light = correlate1d(light, kernel, axis=axis, mode="reflect")
        return light


@dataclass(frozen=True)
class LensDistortion(Effect):
    """Lens distortion after Brown and Conrady, with the coefficients and axes of OpenCV.

    Poses and pinhole intrinsics of the truth do not change; ``distortion`` of the truth holds the coefficients as
    ``cv2.projectPoints`` takes them.
    """

    name: ClassVar[str] = "lens_distortion"
    k1: float = between(-2.0, 2.0, default=-0.15)
    """Radial, second order: negative is barrel, positive pincushion distortion."""
    k2: float = between(-2.0, 2.0, default=0.0)
    """Radial, fourth order."""
    p1: float = between(-0.1, 0.1, default=0.0)
    """Tangential, towards y."""
    p2: float = between(-0.1, 0.1, default=0.0)
    """Tangential, towards x."""

    def coefficients(self) -> Coefficients:
        """k1, k2, p1, p2."""
        return self.k1, self.k2, self.p1, self.p2

    def straighten(
        self, pixels: Float[np.ndarray, "*n 2"], intrinsics: PinholeIntrinsics
    ) -> Float[np.ndarray, "*n 2"]:
        """Undistorted pixel coordinates.

        Raises:
            InputError: the distortion is not invertible within the image.
        """
        focal = np.array([intrinsics.fl_x, intrinsics.fl_y])
        centre = np.array([intrinsics.cx, intrinsics.cy])
        straight = undistort((pixels - centre) / focal, self.coefficients())
        if straight is None:
            raise InputError(
                f"effects.{self.name}: k1 {self.k1:g}, k2 {self.k2:g}, p1 {self.p1:g}, p2 {self.p2:g} fold the image "
                "at its edge; bring them closer to 0."
            )
        return straight * focal + centre


@dataclass(frozen=True)
class ImageRotation(Effect):
    """The file holds a rotated image, as that of a SPECIM IQ, whose slit is upright and scans sideways.

    The image is rotated before it reaches the sensor. Fixed patterns, smile and noise belong to the sensor, whose
    line is the sample axis of every cube, and are not rotated.
    """

    name: ClassVar[str] = "image_rotation"
    quarter_turns: int = between(1, 3, default=1)
    """Counter-clockwise rotations by 90 degrees from the upright image to the file (k of ``np.rot90``)."""

    def orient(self, image: np.ndarray) -> np.ndarray:
        """Rotate an upright image (lines, samples, ...)."""
        return np.ascontiguousarray(np.rot90(image, self.quarter_turns))


def gaussian_kernel(sigma_px: float) -> Float[np.ndarray, "2*radius+1"]:
    """The discrete Gaussian ``exp(-t) I_n(t)``, t = sigma^2 (Lindeberg 1990, "Scale-space for discrete signals").

    Unlike samples of a Gaussian, its variance is exactly t, and variances of successive kernels add.
    """
    radius = int(np.ceil(8.0 * max(sigma_px, 1.0)))
    kernel = ive(np.abs(np.arange(-radius, radius + 1)), sigma_px**2)
    return kernel / kernel.sum()


def distort(points: Float[np.ndarray, "*n 2"], coefficients: Coefficients) -> Float[np.ndarray, "*n 2"]:
    """Distorted points of the image plane at distance 1, y down (OpenCV's model)."""
    in_space = np.append(points, np.ones((*points.shape[:-1], 1)), axis=-1).reshape(-1, 1, 3)
    found, _ = cv2.projectPoints(in_space, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients))
    return found.reshape(points.shape)


def undistort(points: Float[np.ndarray, "*n 2"], coefficients: Coefficients) -> Float[np.ndarray, "*n 2"] | None:
    """Inverse of `distort` (OpenCV); None if it does not converge, because the model is not invertible there."""
    flat = np.ascontiguousarray(points, float).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, UNDISTORTION_STEPS, UNDISTORTION_GOAL)
    lens = np.array(coefficients)
    found = np.asarray(cv2.undistortPointsIter(flat, np.eye(3), lens, np.eye(3), np.eye(3), criteria))
    found = found.reshape(points.shape)
    missing = distort(found, coefficients) - points
    return found if np.abs(missing).max(initial=0.0) < UNDISTORTED_TO else None


EFFECTS: tuple[type[Effect], ...] = (
    TexturedBackground,
    Drying,
    DriftingLamps,
    IlluminationFalloff,
    LensDistortion,
    OpticalBlur,
    ImageRotation,
)
"""The effects in the order in which they act."""
