"""The unseen base: the seen surface is continued down to the plane that the object stands on, and closed there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d

from hsi_sc_nerf.errors import InputError

SECTORS = 72
# Fraction of a sector's points taken for outliers below its edge.
_OUTLIERS = 0.005
# Height of the strip above the edge whose mean slope is the slope at the edge.
_STRIP_M = 0.003
# Largest slope (radius over height) of the extrapolated surface: a flatter one would reach far on little evidence.
_FLATTEST = 2.0
# Errors of the cloud and of the base's height may place the edge this far below the base.
_BELOW_BASE_M = 0.005


@dataclass(frozen=True)
class Base:
    """Edge of the seen surface and outline of the base, by sectors of azimuth about ``centre_m``.

    Attributes:
        centre_m: x and y of the centre.
        height_m: z of the plane that the object stands on.
        edge_height_m: z at which the seen surface ends.
        edge_radius_m: distance of that edge from the centre.
        foot_radius_m: distance of the base's outline from the centre.
    """

    centre_m: Float[np.ndarray, "2"]
    height_m: float
    edge_height_m: Float[np.ndarray, "sectors"]
    edge_radius_m: Float[np.ndarray, "sectors"]
    foot_radius_m: Float[np.ndarray, "sectors"]

    def points(self, spacing_m: float) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Points ``spacing_m`` apart on the wall (edge to outline) and the flat base, with outward unit normals."""
        edge_m = float(self.edge_radius_m.max())
        around = max(SECTORS, int(np.ceil(2.0 * np.pi * edge_m / spacing_m)))
        azimuth = 2.0 * np.pi * np.arange(around) / around
        edge_z, edge_r, foot_r = (
            self._at(values, azimuth) for values in (self.edge_height_m, self.edge_radius_m, self.foot_radius_m)
        )
        out = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
        drop_m = np.maximum(edge_z - self.height_m, 0.0)
        length_m = np.hypot(edge_r - foot_r, drop_m)
        steps = int(np.ceil(length_m.max() / spacing_m))
        fraction = (np.arange(steps) + 0.5)[:, None] / max(steps, 1)
        radius, z = edge_r + fraction * (foot_r - edge_r), edge_z - fraction * drop_m
        wall = np.concatenate([radius[..., None] * out, z[..., None]], axis=-1)
        wall_normals = np.concatenate([drop_m[:, None] * out, (foot_r - edge_r)[:, None]], axis=-1)
        wall_normals = np.broadcast_to(wall_normals, wall.shape)
        # Where the seen surface reaches the base there is no wall.
        real = np.broadcast_to(length_m > spacing_m, wall.shape[:2])

        along = np.arange(-edge_m, edge_m + spacing_m, spacing_m)
        x, y = (grid.ravel() for grid in np.meshgrid(along, along))
        inside = np.hypot(x, y) < self._at(self.foot_radius_m, np.arctan2(y, x) % (2.0 * np.pi))
        floor = np.stack([x, y, np.full_like(x, self.height_m)], axis=-1)[inside]
        down = np.broadcast_to([0.0, 0.0, -1.0], floor.shape)

        points = np.concatenate([wall[real], floor])
        points[:, :2] += self.centre_m
        normals = np.concatenate([wall_normals[real], down])
        return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def _at(self, values: Float[np.ndarray, "sectors"], azimuth: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        middles = 2.0 * np.pi * (np.arange(SECTORS) + 0.5) / SECTORS
        return np.interp(azimuth, middles, values, period=2.0 * np.pi)


def find_base(points_m: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], height_m: float) -> Base:
    """Extrapolate the surface of an upright object (z up) straight down to the base's plane.

    Args:
        points_m: the seen surface.
        normals: unit normals, outwards.
        height_m: z of the plane that the object stands on.

    Raises:
        InputError: the surface ends clearly below that plane.
    """
    z, centre = points_m[:, 2], _centre(points_m)
    offset = points_m[:, :2] - centre
    radius, sector = np.hypot(*offset.T), _sectors(offset)
    outwards = (normals[:, :2] * offset).sum(axis=1) / np.maximum(radius, 1e-12)

    edge_z = _edges(z, sector)
    edge_r, slope = (np.full(SECTORS, np.nan) for _ in range(2))
    for index in np.unique(sector):
        here = np.flatnonzero(sector == index)
        strip = here[z[here] <= edge_z[index] + _STRIP_M]
        edge_r[index] = np.median(radius[strip][z[strip] <= np.median(z[strip])])
        slope[index] = np.clip(-normals[strip, 2].mean() / max(outwards[strip].mean(), 1e-6), 0.0, _FLATTEST)
    edge_z, edge_r, slope = (_smooth_around(values) for values in (edge_z, edge_r, slope))
    if (edge_m := float(np.median(edge_z))) < height_m - _BELOW_BASE_M:
        raise InputError(
            f"the cloud ends at a height of {edge_m:.4f} m, below the base at {height_m:g} m; take away what is "
            "under the object (export without --keep-turntable), or correct the base's height (metres)."
        )
    foot_r = np.maximum(edge_r - slope * np.maximum(edge_z - height_m, 0.0), 0.0)
    return Base(centre, height_m, edge_z, edge_r, foot_r)


def lower_rim(points_m: Float[np.ndarray, "n 3"], width_m: float) -> Bool[np.ndarray, "n"]:
    """Points less than ``width_m`` above the lower edge of an upright object.

    Rays graze the surface there and masks end, so that the last reconstructed millimetres often hang straight down.
    """
    z, sector = points_m[:, 2], _sectors(points_m[:, :2] - _centre(points_m))
    return z < _edges(z, sector)[sector] + width_m


def lowest_edge_m(points_m: Float[np.ndarray, "n 3"]) -> float:
    """Lowest z of the lower edge of an upright object."""
    sector = _sectors(points_m[:, :2] - _centre(points_m))
    return float(_smooth_around(_edges(points_m[:, 2], sector)).min())


def _centre(points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2"]:
    """x and y of the centre of the lowest strip."""
    low = points_m[points_m[:, 2] < np.quantile(points_m[:, 2], _OUTLIERS) + _STRIP_M, :2]
    return (low.min(axis=0) + low.max(axis=0)) / 2.0


def _sectors(offset_m: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n"]:
    azimuth = np.arctan2(offset_m[:, 1], offset_m[:, 0]) % (2.0 * np.pi)
    return (azimuth * (SECTORS / (2.0 * np.pi))).astype(int) % SECTORS


def _edges(z_m: Float[np.ndarray, "n"], sector: Int[np.ndarray, "n"]) -> Float[np.ndarray, "sectors"]:
    """Height of the lowest points of each sector, without outliers; NaN where it has no points."""
    edges = np.full(SECTORS, np.nan)
    for index in np.unique(sector):
        edges[index] = np.quantile(z_m[sector == index], _OUTLIERS)
    return edges


def _smooth_around(values: Float[np.ndarray, "sectors"]) -> Float[np.ndarray, "sectors"]:
    known = np.flatnonzero(np.isfinite(values))
    filled = np.interp(np.arange(SECTORS), known, values[known], period=SECTORS)
    return gaussian_filter1d(filled, 1.0, mode="wrap")
