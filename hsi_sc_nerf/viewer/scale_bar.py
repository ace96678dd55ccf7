"""A bar of a round length in the viewer's picture, as long as it is at the depth of the object's centre."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from viser.transforms import SO3

if TYPE_CHECKING:
    from viser import CameraHandle

_LONGEST = 0.25
"""Fraction of the picture's smaller side that the bar may take."""
_CORNER = 0.88
"""Where the bar begins, from the middle of the picture (0) to its left and lower edges (1)."""
_NEAR = 0.1
"""The bar hangs at this fraction of the depth of the object's centre, so that nothing of the scene hides it."""
_UNDER, _OVER = ((20, 20, 20), 7.0, 1.0), ((255, 255, 255), 3.0, 0.999)
"""Colour, width in pixels and depth of two lines, the second on the first: one is seen on any ground."""


def scale_bar(
    camera: CameraHandle, centre: Float[np.ndarray, "3"], units_per_m: float
) -> tuple[float, Float[np.ndarray, "2 3"]] | None:
    """The length (metres) that the bar for a browser's camera stands for, and its left and right end (scene).

    The bar hangs near the camera and is smaller by as much, so that it looks as it would at the centre's depth. None
    if the object's centre is not in front of the camera.

    Args:
        camera: camera of the browser: its place, turn, vertical field of view (rad) and width over height.
        centre: centre of the object, scene.
        units_per_m: of the scene.
    """
    right, down, ahead = SO3(np.asarray(camera.wxyz)).as_matrix().T
    depth = float(ahead @ (centre - camera.position))
    half_height = depth * math.tan(camera.fov / 2.0)
    half_width = half_height * camera.aspect
    longest_m = _LONGEST * 2.0 * min(half_width, half_height) / units_per_m
    if not (longest_m > 0.0 and math.isfinite(longest_m)):  # a browser that is being laid out has no size
        return None
    length_m = round_length(longest_m)
    start = depth * ahead - _CORNER * half_width * right + _CORNER * half_height * down
    end = start + length_m * units_per_m * right
    return length_m, camera.position + _NEAR * np.stack([start, end])


def round_length(longest: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is no longer.

    Example:
        >>> round_length(0.047)
        0.02
    """
    power = math.floor(math.log10(longest))
    lengths = (float(f"{digit}e{exponent}") for exponent in (power + 1, power, power - 1) for digit in (5, 2, 1))
    return next(length for length in lengths if length <= longest)


def draw_scale_bar(client: Any, centre: Float[np.ndarray, "3"], units_per_m: float) -> None:
    """Draw the bar in a browser in place of its last one; nothing where there is none to draw."""
    camera = client.camera
    bar = scale_bar(camera, centre, units_per_m)
    length_m, at = bar or (0.0, np.zeros((2, 3)))
    for number, (colour, width_px, depth) in enumerate((_UNDER, _OVER)):
        ends = camera.position + depth * (at - camera.position)
        client.scene.add_spline_catmull_rom(
            f"/scale_bar/{number}", ends, line_width=width_px, color=colour, segments=1, visible=bar is not None
        )
    words = f"{1e3 * length_m:g} mm" if bar else ""
    client.scene.add_label("/scale_bar/length", words, position=at.mean(axis=0), visible=bar is not None)
