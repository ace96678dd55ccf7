"""How large everything is: from the markers' side, from the container, and how far the two disagree."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.poses.adjust import Problem
from hsi_sc_nerf.poses.initialise import Turntable

# A marker stands upright if its normal leaves the horizontal by less than this sine, about 12 degrees.
_UPRIGHT_SINE = 0.2
# A marker belongs to the container if its plane is this near the circle through all of them, in marker sides.
_ON_CONTAINER_SIDES = 0.15
_FEWEST_TO_FIND_THE_CENTRE = 3


@dataclass(frozen=True)
class Scale:
    """What gives the scale, and how well it is known. Shares are of a length on the turntable."""

    source: Literal["markers", "container"]
    marker_side_m: float
    """As given; as measured against the container where that gives the scale."""
    uncertainty: float
    """Standard deviation of the scale as a share: by the fit of the corners, and by the markers' own spread."""
    marker_sides: dict[int, float]
    """Each marker's apparent side over the mean of all; empty for a single marker."""
    marker_side_sigmas: dict[int, float]
    """Standard deviations of these."""
    container_diameter_m: float | None
    """As given."""
    measured_container_diameter_m: float | None
    """Of the circle that the upright markers' planes touch; None where there are none.

    A plaque stands off the wall and makes it wider than the container by twice that.
    """

    @property
    def disagreement_percent(self) -> float | None:
        """By how much the container is wider by the markers than as given; None where one is not known."""
        if self.container_diameter_m is None or self.measured_container_diameter_m is None:
            return None
        return 100.0 * (self.measured_container_diameter_m / self.container_diameter_m - 1.0)


def container_diameter(
    normals: Float[np.ndarray, "m 3"],
    centres: Float[np.ndarray, "m 3"],
    side: float,
    disc: float,
    container_height: float | None,
) -> float | None:
    """Diameter of the upright cylinder whose wall the markers around the container touch; any unit of length.

    The container need not stand on the axis: three or more markers tell its centre. Fewer are taken to stand around
    the axis. None where no upright marker faces outwards, or their planes touch no common circle.

    Args:
        normals: of the markers, unit vectors out of their faces; z is the axis.
        centres: of the markers.
        side: the markers' side.
        disc: height of the disc.
        container_height: markers whose centre is above this height over the disc are not on the container.
    """
    upright = (np.abs(normals[:, 2]) < _UPRIGHT_SINE) & ((normals[:, :2] * centres[:, :2]).sum(-1) > 0)
    if container_height is not None:
        upright &= centres[:, 2] - disc < container_height
    normals = normals[upright, :2] / np.linalg.norm(normals[upright, :2], axis=-1, keepdims=True)
    away = (normals * centres[upright, :2]).sum(-1)
    if len(away) == 0:
        return None
    # n.p = n.centre + radius
    design = np.column_stack([normals, np.ones(len(normals))])
    if len(away) < _FEWEST_TO_FIND_THE_CENTRE or np.linalg.cond(design) > 20.0:
        design[:, :2] = 0.0
    solution = np.linalg.lstsq(design, away, rcond=None)[0]
    if np.abs(design @ solution - away).max() > _ON_CONTAINER_SIDES * side or solution[2] <= 0.0:
        return None
    return 2.0 * float(solution[2])


def resized(turntable: Turntable, factor: float) -> Turntable:
    """The same machine with all lengths times a factor: it looks the same in the images."""
    poses = turntable.marker_poses.copy()
    poses[:, :3, 3] *= factor
    return replace(
        turntable,
        distance_m=turntable.distance_m * factor,
        marker_poses=poses,
        shifts_m=None if turntable.shifts_m is None else turntable.shifts_m * factor,
    )


def length_sigma(turntable: Turntable, problem: Problem, covariance: Float[np.ndarray, "p p"]) -> float:
    """Standard deviation, as a share, of lengths on the turntable: of the markers' distance from the axis (RMS).

    The markers' side is taken for exact; the corners are not.
    """
    centres = turntable.marker_poses[:, :2, 3]
    slope = np.zeros(len(covariance))
    slope[problem.columns.marker[:, 3:5]] = centres / (centres**2).sum()
    return float(np.sqrt(slope @ covariance @ slope))


def apparent_sides(
    turntable: Turntable, problem: Problem, loss_scale: float
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Each marker's side over the mean of all, if each had its own, and standard deviations (for unit variance).

    One Gauss-Newton step from the adjusted machine with the logs of the sides as further unknowns, whose mean is 0.
    """
    columns, values = problem.rows(turntable)
    sides = problem.columns.size + 1 + np.arange(len(turntable.markers))
    columns = np.column_stack([columns, sides[problem.marker]])
    values = np.concatenate([values, problem.side_slopes(turntable)[..., None]], axis=2)
    normal, gradient = problem.assemble(turntable, columns, values, sides[-1] + 1, loss_scale)
    normal[np.ix_(sides, sides)] += normal.diagonal().max() / len(sides)
    keep = np.delete(np.arange(len(normal)), problem.columns.size)
    inverse = np.linalg.inv(normal[np.ix_(keep, keep)])
    of_sides = slice(-len(sides), None)
    return np.exp(-(inverse @ gradient[keep])[of_sides]), np.sqrt(inverse.diagonal()[of_sides])
