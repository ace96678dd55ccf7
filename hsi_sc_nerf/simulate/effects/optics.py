"""Effects of the camera optics: blur, lens distortion and rotation of the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from scipy.ndimage import correlate1d
from scipy.special import ive

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.settings_file import between
from hsi_sc_nerf.simulate.effect import Effect

Coefficients = tuple[float, float, float, float]
NEWTON_STEPS = 20
UNDISTORTED_TO = 1e-10
"""Residual of the undistortion as a fraction of the focal length, about 1e-7 pixel."""


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


def gaussian_kernel(sigma_px: float) -> Float[np.ndarray, "2*radius+1"]:
    """The discrete Gaussian ``exp(-t) I_n(t)``, t = sigma^2 (Lindeberg 1990, "Scale-space for discrete signals").

    Unlike samples of a Gaussian, its variance is exactly t, and variances of successive kernels add.
    """
    radius = int(np.ceil(8.0 * max(sigma_px, 1.0)))
    kernel = ive(np.abs(np.arange(-radius, radius + 1)), sigma_px**2)
    return kernel / kernel.sum()


def distort(points: Float[np.ndarray, "*n 2"], coefficients: Coefficients) -> Float[np.ndarray, "*n 2"]:
    """Distorted points of the image plane at distance 1, y down (OpenCV's model)."""
    k1, k2, p1, p2 = coefficients
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + (k1 + k2 * r2) * r2
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def undistort(points: Float[np.ndarray, "*n 2"], coefficients: Coefficients) -> Float[np.ndarray, "*n 2"] | None:
    """Inverse of `distort` by Newton's method; None if it does not converge or the model is not invertible there."""
    k1, k2, p1, p2 = coefficients
    found = points
    for _ in range(NEWTON_STEPS):
        missing_x, missing_y = np.moveaxis(points - distort(found, coefficients), -1, 0)
        x, y = found[..., 0], found[..., 1]
        r2 = x * x + y * y
        radial, slope = 1.0 + (k1 + k2 * r2) * r2, 2.0 * k1 + 4.0 * k2 * r2
        xx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        # The Jacobian is symmetric.
        determinant = xx * yy - xy * xy
        if not (determinant > 0.0).all() or not (xx > 0.0).all():
            return None
        if np.hypot(missing_x, missing_y).max(initial=0.0) < UNDISTORTED_TO:
            return found
        step_x = (yy * missing_x - xy * missing_y) / determinant
        step_y = (xx * missing_y - xy * missing_x) / determinant
        found = found + np.stack([step_x, step_y], axis=-1)
    return None


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
