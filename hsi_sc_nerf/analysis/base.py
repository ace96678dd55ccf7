"""The base of an upright object, which no camera sees: where the seen surface ends, and how it goes on below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d

from hsi_sc_nerf.errors import InputError

SECTORS = 72
# Fraction of a sector's points taken for outliers below its edge.
_OUTLIERS = 0.005
# Height of the strip above the edge whose median radius is the radius of its lower half.
_STRIP_M = 0.003
# Height of the strip above the edge whose normals give the arc that goes on under the object, and its largest
# fraction of the object's height.
_ARC_STRIP_M = 0.01
_ARC_STRIP_FRACTION = 0.25
# Largest sine of the surface's angle to the vertical at the edge: a flatter one would reach far on little evidence.
_FLATTEST = 0.9
# Errors of the cloud and of the base's height may place the edge this far below the base.
_BELOW_BASE_M = 0.005


def find_base(points_m: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], height_m: float) -> Base:
    """Extrapolate the surface of an upright object (z up) down to the base's plane, on the arc of its lowest part.

    The sine of a circle's angle to the vertical changes evenly with height, so a line through the sines of the lowest
    normals gives the arc.

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
    sine = -normals[:, 2] / np.maximum(np.hypot(outwards, normals[:, 2]), 1e-12)
    arc_m = min(_ARC_STRIP_M, _ARC_STRIP_FRACTION * float(np.ptp(z)))

    edge_z = _edges(z, sector)
    edge_r, edge_sine, curvature = (np.full(SECTORS, np.nan) for _ in range(3))
    for index in np.unique(sector):
        here = np.flatnonzero(sector == index)
        strip = here[z[here] <= edge_z[index] + _STRIP_M]
        edge_r[index] = np.median(radius[strip][z[strip] <= np.median(z[strip])])
        arc = here[(z[here] <= edge_z[index] + arc_m) & (outwards[here] > 0.0)]
        edge_sine[index], curvature[index] = _line(edge_z[index] - z[arc], sine[arc])
    edge_z, edge_r, edge_sine, curvature = (_smooth_around(one) for one in (edge_z, edge_r, edge_sine, curvature))
    if (edge_m := float(np.median(edge_z))) < height_m - _BELOW_BASE_M:
        raise InputError(
            f"the cloud ends at a height of {edge_m:.4f} m, below the base at {height_m:g} m; take away what is "
            "under the object (export without --keep-turntable), or correct the base's height (metres)."
        )
    edge_sine, curvature = np.clip(edge_sine, 0.0, _FLATTEST), np.maximum(curvature, 0.0)
    return Base(centre, height_m, edge_z, edge_r, edge_sine, curvature)


@dataclass(frozen=True)
class Base:
    """Edge of the seen surface and the arc on which it goes on to the base, by sectors of azimuth about ``centre_m``.

    Attributes:
        centre_m: x and y of the centre.
        height_m: z of the plane that the object stands on.
        edge_height_m: z at which the seen surface ends.
        edge_radius_m: distance of that edge from the centre.
        edge_sine: sine of the surface's angle to the vertical at the edge, from 0 (vertical) to 1.
        curvature_per_m: by how much that sine grows per metre downwards: the arc's curvature, 0 for a straight line.
        hollow: depth of a hollow in the base, a cone, as a fraction of the base's radius.
    """

    centre_m: Float[np.ndarray, "2"]
    height_m: float
    edge_height_m: Float[np.ndarray, "sectors"]
    edge_radius_m: Float[np.ndarray, "sectors"]
    edge_sine: Float[np.ndarray, "sectors"]
    curvature_per_m: Float[np.ndarray, "sectors"]
    hollow: float = 0.0

    @property
    def drop_m(self) -> Float[np.ndarray, "sectors"]:
        """From the edge down to the base."""
        return np.maximum(self.edge_height_m - self.height_m, 0.0)

    @property
    def foot_radius_m(self) -> Float[np.ndarray, "sectors"]:
        """Distance of the base's outline from the centre."""
        return self._wall(self.drop_m)[0]

    def points(self, spacing_m: float) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Points ``spacing_m`` apart on the wall (edge to outline) and the flat base, with outward unit normals."""
        edge_m, foot_m = float(self.edge_radius_m.max()), self.foot_radius_m
        around = max(SECTORS, int(np.ceil(2.0 * np.pi * edge_m / spacing_m)))
        azimuth = 2.0 * np.pi * np.arange(around) / around
        length_m = self._at(np.hypot(self.edge_radius_m - foot_m, self.drop_m), azimuth)
        steps = int(np.ceil(length_m.max() / spacing_m))
        # Steps of equal radius where the arc flattens, of equal height where it is steep.
        fraction = np.sin(0.5 * np.pi * (np.arange(steps) + 0.5) / max(steps, 1))[:, None]
        radius, sine = (self._at(values, azimuth) for values in self._wall(fraction * self.drop_m))
        z = self._at(self.edge_height_m, azimuth) - fraction * self._at(self.drop_m, azimuth)
        out = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
        wall = np.concatenate([radius[..., None] * out, z[..., None]], axis=-1)
        wall_normals = np.concatenate([np.sqrt(1.0 - sine**2)[..., None] * out, -sine[..., None]], axis=-1)
        # Where the seen surface reaches the base there is no wall.
        real = np.broadcast_to(length_m > spacing_m, wall.shape[:2])

        along = np.arange(-edge_m, edge_m + spacing_m, spacing_m)
        x, y = (grid.ravel() for grid in np.meshgrid(along, along))
        from_outline_m = self._at(foot_m, np.arctan2(y, x) % (2.0 * np.pi)) - np.hypot(x, y)
        floor = np.stack([x, y, self.height_m + self.hollow * from_outline_m], axis=-1)[from_outline_m > 0.0]
        inwards = -self.hollow * floor[:, :2] / np.maximum(np.hypot(*floor[:, :2].T), 1e-12)[:, None]
        down = np.concatenate([inwards, np.full((len(floor), 1), -1.0)], axis=1) / np.hypot(1.0, self.hollow)

        points = np.concatenate([wall[real], floor])
        points[:, :2] += self.centre_m
        return points, np.concatenate([wall_normals[real], down])

    def _wall(self, below_m: Float[np.ndarray, "*n sectors"]) -> tuple[np.ndarray, np.ndarray]:
        """Radius of the arc so far below the edge, and the sine of its angle to the vertical there.

        The arc is nowhere lower than the base: where it would be level before, it is less curved.
        """
        most = (1.0 - self.edge_sine) / np.maximum(self.drop_m, 1e-12)
        sine = self.edge_sine + np.minimum(self.curvature_per_m, most) * below_m
        # The difference of the cosines over the curvature, in a form that holds for a straight line as well.
        cosines = np.sqrt(1.0 - self.edge_sine**2) + np.sqrt(1.0 - np.minimum(sine, 1.0) ** 2)
        inwards_m = below_m * (self.edge_sine + sine) / cosines
        return np.maximum(self.edge_radius_m - inwards_m, 0.0), np.minimum(sine, 1.0)

    def _at(self, values: Float[np.ndarray, "*n sectors"], azimuth: Float[np.ndarray, "a"]) -> np.ndarray:
        middles = 2.0 * np.pi * (np.arange(SECTORS) + 0.5) / SECTORS
        rows = [np.interp(azimuth, middles, row, period=2.0 * np.pi) for row in np.atleast_2d(values)]
        return np.array(rows).reshape(*values.shape[:-1], len(azimuth))


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


def _line(x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]) -> tuple[float, float]:
    """Value at 0 and slope of the line through the points by least squares; level where they do not tell a slope."""
    if len(x) == 0:
        return 0.0, 0.0
    about = x - x.mean()
    slope = float((about * (y - y.mean())).sum() / max((about**2).sum(), 1e-12))
    return float(y.mean() - slope * x.mean()), slope


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
