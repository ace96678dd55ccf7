"""Several objects on one table: the pieces of a cloud that stand apart from each other."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, thinned
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import SpectralCloud

LEAST_FRACTION = 0.05
"""Smallest piece, as a fraction of the seen surface; what is smaller is a speck, and belongs to the nearest piece."""
STANDING_M = 0.005
"""Largest height of a piece's lowest point above the base: the last millimetres are rarely seen. What begins higher,
as a stem that training left apart from its fruit, belongs to the nearest piece."""
NEIGHBOURS, BRIDGED_SPACINGS = 6, 1.5
"""Points within so many times the usual distance to so many neighbours are linked: random points on a closed surface
then hang together, however few they are."""
SPACING_POINTS = 10_000
"""Points whose neighbours are looked up."""


def one_piece(cloud: SpectralCloud, piece: int | None, config: MeshConfig) -> SpectralCloud:
    """The points of one of the objects that stand on the table.

    Args:
        cloud: metres, z up.
        piece: its number; 1 for that of the largest surface. None where there is but one.
        config: how the cloud is meshed; parts are apart if neither the smoothing nor the usual distance between
            points bridges what is between them.

    Raises:
        InputError: no such piece, or several and none is chosen.

    Example:
        >>> left_berry = one_piece(read_spectral_ply("point_cloud.ply"), 1, MeshConfig())
    """
    pieces = standing_pieces(cloud.points, config)
    if piece is None and len(pieces) > 1:
        raise InputError(
            f"the cloud holds {len(pieces)} objects that stand apart, and sizes are those of one; measure them one "
            f"by one with --piece 1 to --piece {len(pieces)}, each into its own --output-dir (1 is the largest)."
        )
    if piece is None:
        return cloud
    if not 1 <= piece <= len(pieces):
        raise InputError(f"--piece is {piece}, but the cloud holds {len(pieces)}; choose 1 to {len(pieces)}.")
    return cloud.select(pieces[piece - 1])


def standing_pieces(points_m: Float[np.ndarray, "n 3"], config: MeshConfig) -> list[Int[np.ndarray, "piece"]]:
    """Rows of the points of each object that stands on the table, the object of the largest surface first."""
    if len(points_m) == 0:
        return [np.arange(0)]
    # A point for each cell, so that numbers stand for areas; cells that touch at a corner are no gap.
    cell_m = config.smoothing_radius_m
    cells, _ = thinned(points_m, points_m, cell_m)
    reach_m = max(2.0 * cell_m, BRIDGED_SPACINGS * _spacing_m(points_m))
    pairs = cKDTree(cells).query_pairs(reach_m, output_type="ndarray")
    linked = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(cells), len(cells)))
    _, part = connected_components(linked, directed=False)
    lowest_m = np.full(part.max() + 1, np.inf)
    np.minimum.at(lowest_m, part, cells[:, 2])
    base_m = lowest_m.min() if config.base_height_m is None else config.base_height_m
    size = np.bincount(part)
    standing = np.flatnonzero((size >= LEAST_FRACTION * len(cells)) & (lowest_m <= base_m + STANDING_M))
    if len(standing) < 2:
        return [np.arange(len(points_m))]
    order = standing[np.argsort(-size[standing], kind="stable")]
    of_piece = np.isin(part, order)
    nearest = cKDTree(cells[of_piece]).query(points_m, workers=-1)[1]
    return [np.flatnonzero(part[of_piece][nearest] == one) for one in order]


def _spacing_m(points_m: Float[np.ndarray, "n 3"]) -> float:
    """Median distance to the `NEIGHBOURS`-th neighbour; to the last one where there are fewer."""
    neighbours = min(NEIGHBOURS + 1, len(points_m))  # the nearest is the point itself
    some = points_m[:: max(1, len(points_m) // SPACING_POINTS)]
    return float(np.median(cKDTree(points_m).query(some, k=[neighbours], workers=-1)[0]))
