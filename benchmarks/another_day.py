"""The cloud that a run would give of a simulated fruit on some day, as it was set down then, with its errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from true_object import TrueObject

from hsi_sc_nerf.export.cloud import SpectralCloud
from hsi_sc_nerf.geometry.camera import Similarity
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate.materials import MATERIALS, Material, PlantTissue, endmembers, smooth_noise
from hsi_sc_nerf.simulate.plants import FRUIT_MATERIALS, apple, fruit_weights, pear
from hsi_sc_nerf.simulate.scene import Fruit

Kind: TypeAlias = Literal["apple", "pear"]
HEIGHT_M = 0.075
"""Of a fruit with its stem."""
STAND_M = 0.07
"""Height of the container."""
BASE_M = 0.006
"""Height of what counts as the base."""
BRUISED = 0.45
"""Half of the largest fraction of bruise: where its outline is."""
_SMOOTH_SD = 0.7
"""Standard deviation of `smooth_noise`."""


@dataclass(frozen=True)
class SetDown:
    """A fruit on a day.

    Attributes:
        bruise_diameter_m: 0 for none.
        dried: fraction of its water that it lost.
        turn_deg: about the table's axis.
        tip_deg: of its own axis, towards x.
        growth: size relative to the first day.
        keeps_stem: False if it was lost.
    """

    bruise_diameter_m: float = 0.0
    dried: float = 0.0
    turn_deg: float = 0.0
    tip_deg: float = 0.0
    growth: float = 1.0
    keeps_stem: bool = True


@dataclass(frozen=True)
class CloudErrors:
    """Standard deviations of the errors of a run's cloud.

    Attributes:
        position_m: of points, white.
        shape_m: of the surface along its normal, smooth.
        white: of reflectance, relative, each point and band on its own.
        smooth: of reflectance, relative, smooth over the surface; one part common to all bands, one along them.
        smooth_over_m: size of the smooth errors' features.
        session: of reflectance, relative, common to the whole session, and its slope from one end of the bands to
            the other.
        at_base: the smooth errors at the base, which cameras see at grazing angles, relative to those elsewhere;
            they fall to the latter within `BASE_M`.
    """

    position_m: float = 0.0002
    shape_m: float = 0.0001
    white: float = 0.02
    smooth: float = 0.015
    smooth_over_m: float = 0.02
    session: float = 0.005
    at_base: float = 1.0


def fruit_of(
    day: SetDown,
    wavelengths_nm: Float[np.ndarray, "bands"],
    kind: Kind = "apple",
    seed: int = 3,
    height_m: float = HEIGHT_M,
) -> TrueObject:
    """The true surface of an apple or a pear on that day, as it grew, not turned."""
    rng = np.random.default_rng(seed)
    fruit = Fruit(
        kind, height_m=height_m, blush=0.8, lenticel_diameter_m=0.002, bruise_diameter_m=day.bruise_diameter_m
    )
    shape = (apple if kind == "apple" else pear)(fruit.height_m, rng)
    weights = fruit_weights(shape, fruit, rng)
    spectra = endmembers(FRUIT_MATERIALS[kind], wavelengths_nm, dried_materials(day, kind))
    return TrueObject(FRUIT_MATERIALS[kind], shape.mesh, weights, spectra, wavelengths_nm)


def bruise_cm2(fruit: TrueObject) -> float:
    """True area of the bruise."""
    bruised = fruit.weights[:, fruit.materials.index("bruise")] > BRUISED
    return float(1e4 * fruit.mesh.vertex_areas_m2()[bruised].sum())


def dried_materials(day: SetDown, kind: Kind) -> dict[str, Material]:
    """The fruit's tissues with the water that they have left on that day, by name."""
    return {
        name: replace(tissue, water=tissue.water * (1.0 - day.dried))
        for name in FRUIT_MATERIALS[kind]
        if isinstance(tissue := MATERIALS[name], PlantTissue)
    }


def cloud_of(true: TrueObject, day: SetDown, errors: CloudErrors, points: int, seed: int) -> SpectralCloud:
    """What a run would export of the fruit as it was set down: visible points, with errors that ``seed`` draws.

    The columns ``views`` and ``spectral_std`` state the white errors only, as those of a run do.
    """
    rng = np.random.default_rng(seed)
    placed = set_down(day, true.mesh.vertices)
    there = replace(true, mesh=Mesh(placed(true.mesh.vertices), true.mesh.triangles))
    azimuth = 2.0 * np.pi * np.arange(12) / 12
    eyes_m = np.stack([0.42 * np.cos(azimuth), 0.42 * np.sin(azimuth), np.full(12, 0.28)], axis=-1)
    cloud = there.cloud(points, eyes_m, 0.0)
    if not day.keeps_stem:
        cloud = cloud.select(there.nearest(cloud.points)[1][:, there.materials.index("stem")] < 0.5)
    at, count = cloud.points.astype(float), len(cloud)
    base = np.clip(1.0 - (at[:, 2] - at[:, 2].min()) / BASE_M, 0.0, 1.0)

    def smooth() -> np.ndarray:
        factor = 1.0 + (errors.at_base - 1.0) * base
        return factor * smooth_noise(at, errors.smooth_over_m, rng) / _SMOOTH_SD

    along = np.linspace(-1.0, 1.0, len(cloud.wavelengths_nm))
    level, slope = (errors.smooth * smooth()[:, None] for _ in range(2))
    shared = errors.session * rng.standard_normal(2) @ np.stack([np.ones_like(along), along])
    factor = 1.0 + level + slope * along + shared + errors.white * rng.standard_normal(cloud.spectra.shape)
    points_m = at + errors.position_m * rng.standard_normal(at.shape)
    points_m += errors.shape_m * smooth()[:, None] * cloud.normals
    spectra = cloud.spectra * factor
    spread = errors.white * spectra.mean(axis=1) * np.sqrt(8.0)
    extra = {"views": np.full(count, 8.0, np.float32), "spectral_std": spread.astype(np.float32)}
    return replace(cloud, points=points_m.astype(np.float32), spectra=spectra.astype(np.float32), extra=extra)


def set_down(day: SetDown, vertices_m: Float[np.ndarray, "v 3"]) -> Similarity:
    """How the fruit of the first day, at the axis on z = 0, was brought onto the container."""
    turn = Rotation.from_euler("yz", [day.tip_deg, day.turn_deg], degrees=True).as_matrix()
    lowest_m = float((day.growth * vertices_m @ turn.T)[:, 2].min())
    turn_rad = np.deg2rad(day.turn_deg)
    aside_m = 0.003 * np.array([np.cos(turn_rad), np.sin(turn_rad)])
    return Similarity(day.growth, turn, np.array([*aside_m, STAND_M - lowest_m]))
