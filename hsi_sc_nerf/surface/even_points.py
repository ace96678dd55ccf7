"""Points spread evenly over what is kept of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from jaxtyping import Float, Int

from hsi_sc_nerf.evaluation.spatial import sample_surface

_PILOT_POINTS = (1_000, 20_000)
_SPARE = 1.02
_LARGEST_ATTEMPT = 2_000_000
"""Places tried at a time, which take 200 bytes each."""
_TRIES_A_POINT = 50
"""Places tried in all: this many times the points asked for, or the largest attempt where that is more."""


class Selectable(Protocol):
    """Rows that can be counted and picked."""

    def __len__(self) -> int: ...

    def select(self, keep: Int[np.ndarray, "kept"]) -> Selectable:
        """The rows at these places."""
        ...


Kept = TypeVar("Kept", bound=Selectable)


def even_points(
    vertices: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    count: int,
    keep: Callable[[Float[np.ndarray, "n 3"]], Kept],
    seed: int = 0,
) -> list[Kept]:
    """Points that are spread evenly over a mesh's area, as many as asked for after ``keep`` has sorted some out.

    A first, small sample says which share is kept, and the next are as many and as large as it takes; what is too
    much is left out at random. Parts of the mesh that are never kept (a bottom that no frame sees) cost as much as
    the others.

    Args:
        vertices: of the mesh.
        triangles: of the mesh.
        count: points to return, all parts together.
        keep: what becomes of places on the mesh: fewer or as many rows.
        seed: of the random places.

    Returns:
        The rows, in parts; fewer than asked for where hardly any place is kept, and no part where none is.
    """
    if not len(triangles):
        return []
    rng = np.random.default_rng(seed)
    tried = int(np.clip(count, *_PILOT_POINTS))
    passed = len(keep(sample_surface(vertices, triangles, tried, seed=int(rng.integers(2**31)))))
    parts: list[Kept] = []
    found = 0
    most = _TRIES_A_POINT * max(count, _LARGEST_ATTEMPT)
    while found < count and tried < (most if passed else _LARGEST_ATTEMPT):
        needed = (count - found) * tried / passed * _SPARE if passed else 10 * tried
        attempt = min(int(needed) + 1, _LARGEST_ATTEMPT)
        part = keep(sample_surface(vertices, triangles, attempt, seed=int(rng.integers(2**31))))
        tried, passed = tried + attempt, passed + len(part)
        surplus = found + len(part) - count
        if surplus > 0:
            left = np.sort(rng.permutation(len(part))[surplus:])
            part = part.select(left)  # type: ignore[assignment]
        if len(part):
            parts.append(part)
        found += len(part)
    return parts
