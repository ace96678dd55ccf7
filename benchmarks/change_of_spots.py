"""How small a change of a trained run `hsi-sc-nerf change` counts, without and with a second capture, as a table.

    uv run python benchmarks/change_of_spots.py FOLDER

FOLDER holds the days that `change_of_runs.py` keeps. Into the spectra of the second capture of the first day, spots
are painted that are darker by 5 or 20 %, or rims around the bruise with its spectrum; all else is what two trainings
differ by.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from another_day import fruit_of
from change_of_runs import DAYS, NM, REPEAT, SECOND, ChangeOfRuns, on_the_table
from change_over_time import AGAIN, SESSION_SD, beside
from jaxtyping import Float
from results_table import Benchmark, write_results

from hsi_sc_nerf.analysis.change_days import Day
from hsi_sc_nerf.analysis.change_maps import BRIGHTNESS, Quantity, changes
from hsi_sc_nerf.indices.catalogue import find_indices
from hsi_sc_nerf.simulate.materials import smoothstep

COLUMNS = ("fruit", "painted", "area, cm²", "found without --repeat, cm²", "it is", "found with --repeat, cm²")
SPOTS_M = ((0.010, 0.014, 0.018), (0.012, 0.016, 0.020))
"""Diameters of spots that one day has at three sides; they lie at the equator, none on the bruise."""
DARKER = (0.05, 0.2)
RIMS_M = (0.018, 0.020, 0.022)
"""Diameters that a bruise of 16 mm grew to."""
EDGE_M = 0.002
INDICES = find_indices((), NM)


@dataclass(frozen=True)
class ChangeOfSpots(Benchmark):
    """Paint, compare, and write the table."""

    folder: tyro.conf.Positional[Path]
    """That `change_of_runs.py` was given."""
    fruits: tuple[int, ...] = (7, 8, 9)
    """Seeds, each of another apple."""

    def main(self) -> None:
        """Measure, print, write."""
        rows = [row for fruit in self.fruits for row in self._rows(fruit)]
        write_results(
            "change_of_spots", COLUMNS, rows, keys=2, seed=" ".join(map(str, self.fruits)), folder=self.results
        )

    def _rows(self, fruit: int) -> list[list[str]]:
        days = {day.name: day for day in ChangeOfRuns(self.folder).days_of(fruit)}
        first, repeat, second = days["first"], days[REPEAT], days[SECOND]
        true, vertices_m, rows = fruit_of(DAYS["first"], NM, seed=fruit), first.surface.mesh.vertices, []
        bruised = true.weights[:, true.materials.index("bruise")]
        bruise_m = np.average(on_the_table(true), axis=0, weights=bruised)
        facing = np.arctan2(bruise_m[1], bruise_m[0])
        for darker, diameters_m in itertools.product(DARKER, SPOTS_M):
            sides = zip(diameters_m, facing + np.deg2rad([80.0, 180.0, 280.0]), strict=True)
            spots = [(diameter_m, _equator(vertices_m, azimuth)) for diameter_m, azimuth in sides]
            inside = [_disc(vertices_m, centre_m, diameter_m) for diameter_m, centre_m in spots]
            spectra = second.surface.spectra * (1.0 - darker * np.sum(inside, axis=0)[:, None])
            alone, told = _compared(first, second, repeat, spectra)
            for (diameter_m, centre_m), part in zip(spots, inside, strict=True):
                name = f"spot of {1e3 * diameter_m:g} mm, {100 * darker:g} % darker"
                cells = _cells(alone, told, centre_m, diameter_m, _area_cm2(first, part))
                rows.append([f"apple {fruit}", name, *cells])
        core = np.linalg.norm(vertices_m - bruise_m, axis=1) < AGAIN / 4.0
        bruise = np.median(second.surface.spectra[core], axis=0)
        for diameter_m in RIMS_M:
            rim = np.maximum(_disc(vertices_m, bruise_m, diameter_m) - _disc(vertices_m, bruise_m, AGAIN), 0.0)
            spectra = second.surface.spectra * (1.0 - rim[:, None]) + bruise * rim[:, None]
            both = _compared(first, second, repeat, spectra)
            cells = _cells(*both, bruise_m, diameter_m, _area_cm2(first, rim))
            rows.append([f"apple {fruit}", f"bruise of 16 mm grown to {1e3 * diameter_m:g} mm", *cells])
        return rows


def _area_cm2(day: Day, painted: Float[np.ndarray, "v"]) -> float:
    return float(1e4 * day.surface.areas_m2[painted > 0.5].sum())


def _equator(vertices_m: Float[np.ndarray, "v 3"], azimuth: float) -> Float[np.ndarray, "3"]:
    """Vertex of the widest height at an azimuth."""
    radius_m = np.hypot(vertices_m[:, 0], vertices_m[:, 1])
    widest_m = vertices_m[np.argmax(radius_m), 2]
    off = np.abs(np.angle(np.exp(1j * (np.arctan2(vertices_m[:, 1], vertices_m[:, 0]) - azimuth))))
    centre: Float[np.ndarray, "3"] = vertices_m[np.argmin(off * radius_m.max() + np.abs(vertices_m[:, 2] - widest_m))]
    return centre


def _disc(
    vertices_m: Float[np.ndarray, "v 3"], centre_m: Float[np.ndarray, "3"], diameter_m: float
) -> Float[np.ndarray, "v"]:
    """1 inside, 0 outside, half at the edge."""
    inside_m = diameter_m / 2.0 - np.linalg.norm(vertices_m - centre_m, axis=1)
    edge: Float[np.ndarray, "v"] = smoothstep(inside_m / EDGE_M + 0.5)
    return edge


def _compared(first: Day, second: Day, repeat: Day, spectra: Float[np.ndarray, "v b"]) -> tuple[Quantity, Quantity]:
    """Brightness without and with the repeat."""
    painted = replace(second, surface=replace(second.surface, spectra=spectra))
    alone, told = (changes(first, painted, (), INDICES, SESSION_SD, given)[BRIGHTNESS] for given in (None, repeat))
    return alone, told


def _cells(
    alone: Quantity, told: Quantity, centre_m: Float[np.ndarray, "3"], diameter_m: float, area_cm2: float
) -> list[str]:
    def found(quantity: Quantity) -> tuple[int, float]:
        """Number and area of the largest region around a place."""
        for number, region in enumerate(quantity.regions):
            if np.linalg.norm(np.subtract(region.centre_m, centre_m)) < diameter_m:
                return number, 1e4 * region.area_m2
        return -1, 0.0

    number, alone_cm2 = found(alone)
    _, told_cm2 = found(told)
    said = "not found" if number < 0 else "counted" if number < alone.counted else "undecided"
    cells = [beside(each_cm2, area_cm2) if each_cm2 else "" for each_cm2 in (alone_cm2, told_cm2)]
    return [f"{area_cm2:.2f}", cells[0], said, cells[1]]


if __name__ == "__main__":
    tyro.cli(ChangeOfSpots).main()
