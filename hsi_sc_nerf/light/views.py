"""Visibility between elements and of open directions, measurements of the elements, and their irradiance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.geometry.mesh import Mesh, ray_scene
from hsi_sc_nerf.light.stationary_light import (
    LOBE_WIDTH_RAD,
    StationaryLight,
    harmonics,
    lobes,
    relative_nearness,
    tangents,
)

RAYS_AT_ONCE = 1 << 21
BOUNCES = 4
"""Diffuse reflections between elements that are followed."""
FAINT = 1e-6
"""Directions of less radiance than this, relative to the brightest one, are left out: a lamp fills few of them."""
SMALLEST = 1e-3
"""Reflectance that noise does not exceed."""
CELLS_ACROSS = 4
"""Cells across the object; elements in one of them share errors of mesh and poses."""
FACING_SIDE = 0.35
"""Cells of normals in the camera's frame, 20 degrees wide; elements in one of them share errors of the model."""


@dataclass(frozen=True, eq=False)
class Transfer:
    """How light reaches points: ``open_weights @ radiance + form_factors @ radiosity`` is their irradiance.

    The weights of a point sum to 1 over both, so that in a world of radiance 1 every irradiance is 1.

    Attributes:
        open_weights: part of each direction in a point's irradiance, 0 where it is occluded or behind the surface.
        form_factors: part of each element in the irradiance of each point.
    """

    open_weights: Float[np.ndarray, "n directions"]
    form_factors: scipy.sparse.csr_array

    @property
    def sky(self) -> Float[np.ndarray, "n"]:
        """Irradiance in an even chamber with black occluders, 0 to 1."""
        return self.open_weights.sum(axis=1)

    def mean(self, weights: scipy.sparse.csr_array) -> Transfer:
        """Means over points, weighted by each row."""
        means = np.asarray(weights @ self.open_weights, np.float32)
        return Transfer(means, scipy.sparse.csr_array(weights @ self.form_factors).astype(np.float32))


def transfer(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    occluders: Mesh,
    element_of_triangle: Int[np.ndarray, "t"],
    elements: int,
    directions: Float[np.ndarray, "directions 3"],
    lift_m: float,
) -> Transfer:
    """Cast rays from points into evenly spread directions.

    Args:
        points: on the surface, in the unit of the occluders.
        normals: outward unit normals.
        occluders: surfaces that occlude light, the points' own included.
        element_of_triangle: element that each of their triangles belongs to.
        elements: their number.
        directions: unit vectors, evenly spread over the sphere.
        lift_m: distance of the rays' origins from the surface, so that its roughness does not occlude them.
    """
    scene = ray_scene(occluders.vertices, occluders.triangles)
    along = directions.astype(np.float32)
    weights = np.zeros((len(points), len(directions)), np.float32)
    factors = []
    some = max(1, RAYS_AT_ONCE // len(directions))
    for first in range(0, len(points), some):
        rows = slice(first, first + some)
        cosines = normals[rows].astype(np.float32) @ along.T
        point, direction = np.nonzero(cosines > 0.0)
        start = (points[rows] + lift_m * normals[rows]).astype(np.float32)
        hits = scene.cast_rays(np.concatenate([start[point], along[direction]], axis=1))
        hit = np.isfinite(hits["t_hit"].numpy())
        fraction = cosines[point, direction]
        fraction /= np.bincount(point, fraction, minlength=len(start))[point].astype(np.float32)
        weights[first + point[~hit], direction[~hit]] = fraction[~hit]
        met = element_of_triangle[hits["primitive_ids"].numpy()[hit]]
        shape = len(start), elements
        factors.append(scipy.sparse.coo_array((fraction[hit], (point[hit], met)), shape=shape).tocsr())
    return Transfer(weights, scipy.sparse.csr_array(scipy.sparse.vstack(factors, format="csr")))


@dataclass(frozen=True, eq=False)
class ElementViews:
    """Measurements, one of an element in a frame each.

    Attributes:
        element: index of the element.
        frame: index of the frame.
        reflectance: as measured, relative to the white reference.
        on_object: whether the element belongs to the object.
        shows_light: whether the light is fitted to it; the others determine their element's material only.
        own_std: the known part of the standard deviation, relative to the reflectance.
    """

    element: Int[np.ndarray, "m"]
    frame: Int[np.ndarray, "m"]
    reflectance: Float[np.ndarray, "m bands"]
    on_object: Bool[np.ndarray, "m"]
    shows_light: Bool[np.ndarray, "m"]
    own_std: Float[np.ndarray, "m"]


@dataclass(frozen=True, eq=False)
class LampUnits:
    """Irradiance of measurements by each lamp of strength 1 at infinity, and its changes.

    Attributes:
        irradiance: by each lamp.
        by_direction: change with the lamp's direction along its two `tangents`, per rad.
        by_nearness: change with the lamps' nearness, m.
    """

    irradiance: Float[np.ndarray, "m lamps"]
    by_direction: Float[np.ndarray, "m lamps 2"]
    by_nearness: Float[np.ndarray, "m lamps"]


@dataclass(frozen=True, eq=False)
class TurningElements:
    """Elements that turn under light that is stationary in the camera's frame.

    Attributes:
        positions: relative to the object's centre; metres, object frame.
        normals: outward unit normals, object frame.
        on_object: which of them belong to the object.
        transfer: how light reaches them.
        directions: directions of the transfer's open weights, evenly spread, object frame.
        rotations: camera-to-object rotation of each frame.
    """

    positions: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    on_object: Bool[np.ndarray, "n"]
    transfer: Transfer
    directions: Float[np.ndarray, "directions 3"]
    rotations: Float[np.ndarray, "frames 3 3"]

    def direct(self, light: StationaryLight, frame: int) -> Float[np.ndarray, "n bands"]:
        """Irradiance of all elements in a frame by chamber and lamps alone."""
        to_lamps = light.to_lamps @ self.rotations[frame].T
        chamber = self._chamber[frame] @ light.chamber.astype(np.float32)
        lamps = self._by_radiance(lobes(self.directions, to_lamps))
        lamps = lamps * (1.0 + light.nearness * relative_nearness(self.positions, self.normals, to_lamps))
        return chamber[:, None] * light.chamber_colour + (lamps @ light.lamps)[:, None] * light.lamp_colour

    def bounced(
        self, direct: Float[np.ndarray, "n frames bands"], material: Float[np.ndarray, "n bands"]
    ) -> Float[np.ndarray, "n frames bands"]:
        """Irradiance of all elements by each other, after up to `BOUNCES` diffuse reflections of `direct` light."""
        direct, material = direct.astype(np.float32), material[:, None].astype(np.float32)
        arriving = np.zeros_like(direct)
        for _ in range(BOUNCES):
            leaving = (material * (direct + arriving)).reshape(len(direct), -1)
            arriving = (self.transfer.form_factors @ leaving).reshape(direct.shape)
        return arriving

    def chamber_at(self, views: ElementViews) -> Float[np.ndarray, "m terms"]:
        """Direct irradiance at measurements by each harmonic."""
        return self._chamber[views.frame, views.element]

    def by_each_lamp(
        self, views: ElementViews, to_lamps: Float[np.ndarray, "lamps 3"]
    ) -> Float[np.ndarray, "m lamps"]:
        """Direct irradiance at measurements by each of some lamps of strength 1 at infinity."""
        units = np.empty((len(views.element), len(to_lamps)), np.float32)
        for frame, rows in _by_frame(views):
            there = lobes(self.directions, to_lamps @ self.rotations[frame].T)
            units[rows] = self._by_radiance(there)[views.element[rows]]
        return units

    def lamps_at(self, views: ElementViews, to_lamps: Float[np.ndarray, "lamps 3"]) -> LampUnits:
        """Direct irradiance at measurements by lamps of strength 1, and its changes."""
        count, lamps = len(views.element), len(to_lamps)
        units = np.empty((count, 4 * lamps), np.float32)
        for frame, rows in _by_frame(views):
            rotation, seen = self.rotations[frame], views.element[rows]
            there, along = to_lamps @ rotation.T, tangents(to_lamps) @ rotation.T
            radiance = lobes(self.directions, there)
            slope = np.einsum("ltk,dk->dlt", along, self.directions) / LOBE_WIDTH_RAD**2
            columns = np.hstack([radiance, (radiance[..., None] * slope).reshape(len(radiance), -1)])
            units[rows, : 3 * lamps] = self._by_radiance(columns)[seen]
            units[rows, 3 * lamps :] = relative_nearness(self.positions[seen], self.normals[seen], there)
        irradiance = units[:, :lamps]
        by_direction = units[:, lamps : 3 * lamps].reshape(count, lamps, 2)
        return LampUnits(irradiance, by_direction, irradiance * units[:, 3 * lamps :])

    @cached_property
    def cells(self) -> Int[np.ndarray, "n"]:
        """The cell that each element lies in."""
        side = np.cbrt(np.ptp(self.positions[self.on_object], axis=0).prod()) / CELLS_ACROSS
        return _cell_numbers(self.positions / side)

    def facing(self, views: ElementViews) -> Int[np.ndarray, "m"]:
        """The cell of normals in the camera's frame that each measurement lies in."""
        return _cell_numbers(self.normals_in_camera(views) / FACING_SIDE)

    def normals_in_camera(self, views: ElementViews) -> Float[np.ndarray, "m 3"]:
        """The normal of each measurement in the camera's frame."""
        return np.einsum("mk,mkj->mj", self.normals[views.element], self.rotations[views.frame])

    def _by_radiance(self, radiance: Float[np.ndarray, "directions columns"]) -> Float[np.ndarray, "n columns"]:
        """Irradiance of all elements by radiance from the given directions."""
        largest = np.abs(radiance).max(axis=1, initial=0.0)
        bright = np.flatnonzero(largest > FAINT * largest.max())
        return self._by_direction[bright].T @ radiance[bright].astype(np.float32)

    @cached_property
    def _by_direction(self) -> Float[np.ndarray, "directions n"]:
        """The transfer's open weights, those of a direction side by side."""
        return np.ascontiguousarray(self.transfer.open_weights.T)

    @cached_property
    def _chamber(self) -> Float[np.ndarray, "frames n terms"]:
        """Direct irradiance of all elements in each frame by each harmonic."""
        weights = self.transfer.open_weights
        turned = (harmonics(self.directions @ rotation).astype(np.float32) for rotation in self.rotations)
        return np.stack([weights @ radiance for radiance in turned])


def _cell_numbers(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Number of the unit cube that each point lies in."""
    return np.unique(np.floor(points).astype(int), axis=0, return_inverse=True)[1].ravel()


def _by_frame(views: ElementViews) -> list[tuple[int, Int[np.ndarray, "rows"]]]:
    return [(int(frame), np.flatnonzero(views.frame == frame)) for frame in np.unique(views.frame)]
