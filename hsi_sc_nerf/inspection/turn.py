"""How far the table turned between frames, from markers that lie on the disc, without a camera model.

The disc keeps its place in the image. One rectification of its plane makes the quadrilaterals of all its markers in
all frames squares of one size; there, a turn of the table is a rotation of the squares.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.optimize import least_squares

from hsi_sc_nerf.poses.marker_detection import Detections

FORESHORTENINGS = (1.0, 1.5, 2.5, 4.0)
"""Starts of the rectification: height over width of a square on the disc, inverted."""
LARGEST_DEFECT = 0.15
"""A quadrilateral lies on the disc if it differs from a square by less than this fraction of its side."""
FEWEST_QUADS = 6
"""Fewest quadrilaterals that fix the plane."""


def frame_angles_deg(detections: Sequence[Detections]) -> Float[np.ndarray, "frames"]:
    """Angle of the table in each frame relative to the first that has one, good to a few degrees.

    Args:
        detections: markers of each frame.

    Returns:
        Degrees in (-180, 180], counter-clockwise seen from above; nan where no marker on the disc links a frame.
    """
    frames = np.array([i for i, seen in enumerate(detections) for _ in seen], int)
    markers = np.array([marker for seen in detections for marker in seen], int)
    angles = np.full(len(detections), np.nan)
    if len(frames) < FEWEST_QUADS:
        return angles
    corners = np.stack([corners for seen in detections for corners in seen.values()])
    centre, size = corners.mean(axis=(0, 1)), np.ptp(corners, axis=(0, 1)).max()
    edges, on_disc = _rectify((corners - centre) / size)
    # A marker on the container may look like a square by chance, in a few of the frames.
    for marker in np.unique(markers):
        of_marker = markers == marker
        if on_disc[of_marker].mean() < 0.5:
            on_disc[of_marker] = False
    if on_disc.sum() < FEWEST_QUADS:
        return angles
    turns = edges[on_disc].conj()  # the image's y axis points down
    known = _synchronise(frames[on_disc], markers[on_disc], turns / np.abs(turns))
    for frame, phase in known.items():
        angles[frame] = np.rad2deg(np.angle(phase))
    return angles


def _rectify(corners: Float[np.ndarray, "n 4 2"]) -> tuple[Complex[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Mean edge of each quadrilateral in the rectified plane (as the first one, complex), and which are squares."""

    def edges_of(parameters: Float[np.ndarray, "4"]) -> Complex[np.ndarray, "n 4"]:
        tilt, shear = parameters[:2], parameters[2:]
        scale = 1.0 / np.maximum(1.0 + corners @ tilt, 0.05)
        plane = corners[..., 0] * scale + 1j * (corners @ shear) * scale
        # Corners run clockwise: each edge is the one before, turned by a quarter.
        return (np.roll(plane, -1, axis=1) - plane) * (-1j) ** np.arange(4)

    def residuals(parameters: Float[np.ndarray, "4"]) -> Float[np.ndarray, "n 9"]:
        edges = edges_of(parameters)
        mean = edges.mean(axis=1)
        side = np.abs(mean) + 1e-9
        unequal = (edges - mean[:, None]) / side[:, None]
        size = np.log(side / np.median(side))
        return np.column_stack([unequal.real, unequal.imag, size])

    fits = [
        least_squares(
            lambda parameters: residuals(parameters).ravel(), [0.0, 0.0, 0.0, start], loss="soft_l1", f_scale=0.05
        )
        for start in FORESHORTENINGS
    ]
    best = min(fits, key=lambda fit: fit.cost)
    defect = np.sqrt(np.square(residuals(best.x)).mean(axis=1))
    return edges_of(best.x).mean(axis=1), defect < LARGEST_DEFECT


def _synchronise(frames: np.ndarray, markers: np.ndarray, turns: Complex[np.ndarray, "n"]) -> dict[int, complex]:
    """Phase of each frame such that ``turns = frame's phase * marker's phase``; the first frame's is 1.

    Only frames that share markers with the first, directly or through others, are returned.
    """
    of_frame: dict[int, complex] = {int(frames[0]): 1.0 + 0.0j}
    of_marker: dict[int, complex] = {}
    # A link reaches one frame farther in each round; more rounds average.
    for _ in range(len(set(frames.tolist())) + 10):
        for target, keys, others, other_keys in (
            (of_marker, markers, of_frame, frames),
            (of_frame, frames, of_marker, markers),
        ):
            sums: dict[int, complex] = {}
            for key, other, turn in zip(keys.tolist(), other_keys.tolist(), turns, strict=True):
                if other in others:
                    sums[key] = sums.get(key, 0.0) + turn * np.conj(others[other])
            target.update({key: value / abs(value) for key, value in sums.items() if abs(value) > 1e-9})
    first = of_frame[int(frames[0])]
    return {frame: phase * np.conj(first) for frame, phase in of_frame.items()}
