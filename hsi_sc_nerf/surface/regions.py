"""Regions of interest: boxes and upright cylinders in the object frame, metres; and the bands that are asked for."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.spectra.bands import require_bands

_RANGE = re.compile(r"(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)")


@dataclass(frozen=True, eq=False)
class Region:
    """Which points are wanted.

    Attributes:
        holds: which points (scene units, with outward unit normals) it holds.
        bounds: minimum and maximum of a box around it, scene units; it spares the search elsewhere.
    """

    holds: Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]], Bool[np.ndarray, "n"]]
    bounds: Float[np.ndarray, "2 3"] = field(default_factory=lambda: np.array([[-np.inf] * 3, [np.inf] * 3]))

    def __and__(self, other: Region) -> Region:
        """What lies in both."""
        return Region(
            lambda points, facing: self.holds(points, facing) & other.holds(points, facing),
            np.stack([np.maximum(self.bounds[0], other.bounds[0]), np.minimum(self.bounds[1], other.bounds[1])]),
        )


EVERYWHERE = Region(lambda points, _: np.ones(len(points), bool))
"""The region that holds every point."""


def in_box(points_m: Float[np.ndarray, "n 3"], box_m: Float[np.ndarray, "2 3"]) -> Bool[np.ndarray, "n"]:
    """Which points lie in a box, given by its minimum and maximum, borders included."""
    return ((points_m >= box_m[0]) & (points_m <= box_m[1])).all(axis=1)


def in_cylinder(
    points_m: Float[np.ndarray, "n 3"], centre_m: Sequence[float], radius_m: float, z_m: tuple[float, float]
) -> Bool[np.ndarray, "n"]:
    """Which points lie in an upright cylinder.

    Args:
        points_m: object frame.
        centre_m: x and y of its axis, which is parallel to the turntable's.
        radius_m: its radius, included.
        z_m: its lower and upper end, included.
    """
    from_axis = np.hypot(points_m[:, 0] - centre_m[0], points_m[:, 1] - centre_m[1])
    return (from_axis <= radius_m) & (points_m[:, 2] >= z_m[0]) & (points_m[:, 2] <= z_m[1])


def around_cylinder(centre_m: Sequence[float], radius_m: float, z_m: tuple[float, float]) -> Float[np.ndarray, "2 3"]:
    """Minimum and maximum of the box around an upright cylinder, which is given as `in_cylinder` takes it."""
    x, y = centre_m
    return np.array([[x - radius_m, y - radius_m, z_m[0]], [x + radius_m, y + radius_m, z_m[1]]])


def chosen_bands(wavelengths_nm: Float[np.ndarray, "bands"], wanted: Sequence[str]) -> Int[np.ndarray, "chosen"]:
    """Indices, ascending, of the bands that are asked for; all without a wish.

    Args:
        wavelengths_nm: band centres.
        wanted: wavelengths in nm (``"670"``: the nearest band) and ranges (``"600-700"``: every band in it).

    Raises:
        InputError: a word is neither, or no band is there.
    """
    if not wanted:
        return np.arange(len(wavelengths_nm))
    chosen: set[int] = set()
    for word in wanted:
        if match := _RANGE.fullmatch(word):
            low, high = float(match[1]), float(match[2])
            inside = np.flatnonzero((wavelengths_nm >= low) & (wavelengths_nm <= high))
            if len(inside) == 0:
                raise InputError(
                    f"--bands {word}: the bands go from {wavelengths_nm.min():g} to {wavelengths_nm.max():g} nm and "
                    "none lies in this range; give another one, the smaller wavelength first."
                )
            chosen.update(inside.tolist())
        else:
            try:
                wavelength_nm = float(word)
            except ValueError as error:
                raise InputError(
                    f"--bands {word}: is neither a wavelength in nm, such as 670, nor a range, such as 600-700."
                ) from error
            chosen.update(require_bands(wavelengths_nm, [wavelength_nm], f"--bands {word}").tolist())
    return np.array(sorted(chosen))
