"""Regions that are drawn on the object in the report, as its page saves and opens them; proposals to begin with."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from hsi_sc_nerf.analysis.organs import propose_organs
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import SpectralCloud
from hsi_sc_nerf.files import atomic_write, read_json

KIND = "hsi-sc-nerf regions"
PAGE_POINTS = 50_000
"""Points of the cloud that a page shows by default."""
_AGAIN = "save the regions again in the report's 3D view"
_FAR_SPACINGS = 4.0
"""A surface farther from all points than so many times their distance is not the one that they lie on."""


@dataclass(frozen=True, eq=False)
class DrawnRegion:
    """The surface that is nearer to a region's points than to any other.

    Attributes:
        name: name of the region.
        points_m: all points that it was drawn among (object frame).
        chosen: those in the region.
    """

    name: str
    points_m: Float[np.ndarray, "n 3"]
    chosen: Bool[np.ndarray, "n"]

    def of(self, surface: SpectralMesh) -> Bool[np.ndarray, "v"]:
        """The seen vertices in the region.

        Raises:
            InputError: there are none, or the points lie on another object.
        """
        tree = cKDTree(self.points_m)
        spacing_m = np.median(tree.query(self.points_m, k=[2])[0])
        distance_m, nearest = tree.query(surface.mesh.vertices)
        near = distance_m <= _FAR_SPACINGS * spacing_m
        if not near[surface.seen].mean() > 0.5:
            raise InputError(
                f"region {self.name}: was drawn on another object, or in another position; {_AGAIN} of this cloud."
            )
        inside = surface.seen & near & self.chosen[nearest]
        if not inside.any():
            raise InputError(f"region {self.name}: holds no seen surface; draw it larger.")
        return inside


def points_of_page(cloud: SpectralCloud, most: int = PAGE_POINTS) -> SpectralCloud:
    """The points that a page shows: of those with a complete spectrum, at most ``most``, at random.

    Raises:
        InputError: no point has a whole spectrum.
    """
    whole = np.flatnonzero(np.isfinite(cloud.spectra).all(axis=1) & np.isfinite(cloud.points).all(axis=1))
    if not len(whole):
        raise InputError("the cloud has no point with a spectrum; export it again from the run.")
    if len(whole) > most:
        whole = np.sort(np.random.default_rng(0).choice(whole, most, replace=False))
    return cloud.select(whole)


def propose_regions(cloud: SpectralCloud) -> list[DrawnRegion]:
    """Organs of an object (`propose_organs`) as regions on the points of its page, to be corrected there.

    Raises:
        InputError: no point has a whole spectrum.

    Example:
        >>> proposed = propose_regions(read_spectral_ply("point_cloud.ply"))
        >>> write_drawn_regions("regions_proposed.json", proposed)
        >>> [region.name for region in proposed]
        ['body', 'stem']
    """
    page = points_of_page(cloud)
    points_m = page.points.astype(float)
    return [DrawnRegion(name, points_m, where) for name, where in propose_organs(points_m, page.spectra).items()]


def write_drawn_regions(path: Path | str, regions: Sequence[DrawnRegion]) -> None:
    """Write regions on the same points, as the report's page saves them.

    Raises:
        InputError: there is no region, they lie on different points, or the file cannot be written.

    Example:
        >>> points_m = np.array([[0.0, 0.0, 0.01], [0.0, 0.0, 0.09]])
        >>> write_drawn_regions("regions.json", [DrawnRegion("top", points_m, points_m[:, 2] > 0.05)])
        >>> read_drawn_regions("regions.json")[0].chosen
        array([False,  True])
    """
    points = [one.points_m.round(6) for one in regions]
    if not points or not all(
        one.shape == points[0].shape and np.allclose(one, points[0], 0.0, 1e-5) for one in points
    ):
        raise InputError(f"{path}: takes regions that were drawn among the same points; write those of a page alone.")
    content = {
        "kind": KIND,
        "points_m": points[0].tolist(),
        "regions": [{"name": one.name, "points": np.flatnonzero(one.chosen).tolist()} for one in regions],
    }
    with atomic_write(Path(path)) as (temporary,):
        temporary.write_text(json.dumps(content), encoding="utf-8")


def read_drawn_regions(path: Path | str) -> list[DrawnRegion]:
    """The regions in a file that the report's 3D view saved.

    Raises:
        InputError: it is no such file.

    Example:
        >>> stem, body = read_drawn_regions("regions.json")
        >>> stem.name, stem.points_m.shape, stem.chosen.sum()
        ('stem', (50000, 3), 412)
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; {_AGAIN}.")
    content = read_json(path, _AGAIN)
    try:
        if content["kind"] != KIND:
            raise ValueError(f"its kind is not {KIND}")
        points_m = np.array(content["points_m"], dtype=float)
        if points_m.ndim != 2 or points_m.shape[1] != 3 or len(points_m) < 2 or not np.isfinite(points_m).all():
            raise ValueError("points_m is no list of points")
        regions = [_region(points_m, one) for one in content["regions"]]
    except (LookupError, OverflowError, TypeError, ValueError) as error:
        raise InputError(f"{path}: holds no regions ({error}); {_AGAIN}.") from error
    if not regions:
        raise InputError(f"{path}: holds no region; {_AGAIN}.")
    return regions


def _region(points_m: Float[np.ndarray, "n 3"], one: Any) -> DrawnRegion:
    name, indices = one["name"], one["points"]
    if not isinstance(name, str) or not name.strip() or not indices:
        raise ValueError("a region has no name or no points")
    if not all(type(index) is int and 0 <= index < len(points_m) for index in indices):
        raise ValueError(f"region {name} has a point that is not there")
    chosen = np.zeros(len(points_m), bool)
    chosen[indices] = True
    return DrawnRegion(name, points_m, chosen)
