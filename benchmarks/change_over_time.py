"""How well `hsi-sc-nerf change` finds turns, bruises that grow and drying, and no change where none is, as a table.

    uv run python benchmarks/change_over_time.py
    uv run python benchmarks/change_over_time.py --points 60000 --picture docs/images/change.png  # that alone

The clouds are those that runs would give of simulated fruit (`another_day`): the true surface
with the errors of a run, of which those that are smooth over centimetres count; other ones on each day.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import tyro
from another_day import CloudErrors, Kind, SetDown, bruise_cm2, cloud_of, fruit_of, set_down
from results_table import Benchmark, write_results
from rich.progress import track
from scipy.spatial import cKDTree
from true_object import TrueObject

from hsi_sc_nerf.analysis.change import DayComparison, compare_days
from hsi_sc_nerf.analysis.change_days import days_on_one_mesh
from hsi_sc_nerf.analysis.change_features import surface_samples
from hsi_sc_nerf.analysis.change_maps import BRIGHTNESS
from hsi_sc_nerf.analysis.change_pictures import draw_change
from hsi_sc_nerf.analysis.change_registration import find_attitude
from hsi_sc_nerf.analysis.closed_mesh import MeshConfig
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.analysis.pictures import SideViews
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import MAX_INCIDENCE_DEG
from hsi_sc_nerf.indices.catalogue import CATALOGUE, find_indices
from hsi_sc_nerf.indices.formula import index_values
from hsi_sc_nerf.paper import CLASSIFICATION_ANGLE_RAD
from hsi_sc_nerf.simulate.materials import endmembers
from hsi_sc_nerf.simulate.mesh import sphere

NM = np.linspace(400.0, 1000.0, 25)
MESH = MeshConfig(octree_depth=7)
SESSION_SD = 0.01
WATER = CATALOGUE["WI"]
SKINS = 4
"""Materials of the library: skin, blush, lenticel, bruise; the stem's spectrum lies between two of them."""
AGAIN, GROWN = 0.016, 0.024
COLUMNS = (
    *("fruit", "day", "turn, °", "turn found, °", "size", "size found", "bruise grew, cm²", "by brightness, cm²"),
    *("by class, cm²", "water index changed", "found", "false change, cm²"),
)
FIRST = SetDown(AGAIN)
NEAR_M = 0.004
"""As far from what changed a pixel or a patch may call a change."""
Row: TypeAlias = tuple[str, SetDown, CloudErrors]
"""Name, day and errors."""
ROUGH = {
    "errors smooth over 1 cm": CloudErrors(smooth_over_m=0.01),
    "errors smooth over 4 cm": CloudErrors(smooth_over_m=0.04),
    "errors of 3 %": CloudErrors(smooth=0.03),
}
SERIES: dict[Kind, list[Row]] = {
    "apple": [
        *(("second capture", SetDown(AGAIN, turn_deg=turn), CloudErrors()) for turn in (0.0, 30.0, 90.0, 180.0)),
        *((f"second capture, {name}", SetDown(AGAIN, turn_deg=30.0), errors) for name, errors in ROUGH.items()),
        ("grown", SetDown(GROWN), CloudErrors()),
        ("grown, 5 % dried", SetDown(GROWN, 0.05, turn_deg=30.0), CloudErrors()),
        ("grown, 10 % dried, tipped by 3°", SetDown(GROWN, 0.1, turn_deg=90.0, tip_deg=3.0), CloudErrors()),
        (
            "grown, 20 % dried, 2 % larger, stem lost",
            SetDown(GROWN, 0.2, turn_deg=180.0, growth=1.02, keeps_stem=False),
            CloudErrors(),
        ),
    ],
    "pear": [
        ("second capture", SetDown(AGAIN, turn_deg=90.0), CloudErrors()),
        ("grown, 10 % dried", SetDown(GROWN, 0.1, turn_deg=180.0), CloudErrors()),
    ],
}


@dataclass(frozen=True)
class ChangeOverTime(Benchmark):
    """Simulate days, compare them, and write the table."""

    points: int = 40_000
    """Of each cloud, before what no camera sees is left out."""
    picture: Path | None = None
    """Draw nothing but a picture of the last apple of the table, to this file."""

    def main(self) -> None:
        """Measure, print, write."""
        if self.picture is not None:
            _draw(self.picture, self.points)
            return
        rows = [row for kind in SERIES for row in self._series(kind)]
        write_results("change_over_time", COLUMNS, [*rows, self._ball()], seed="0 to 11", folder=self.results)

    def _series(self, kind: Kind) -> list[list[str]]:
        days = [("first", FIRST, CloudErrors()), *SERIES[kind]]
        first, *later = fruits = [fruit_of(day, NM, kind) for _, day, _ in days]
        each = enumerate(zip(fruits, days, strict=True))
        clouds = [cloud_of(fruit, day, error, self.points, seed) for seed, (fruit, (_, day, error)) in each]
        on_mesh = days_on_one_mesh(clouds, [str(number) for number in range(len(days))], MESH, MAX_INCIDENCE_DEG)
        library = SpectralLibrary(first.materials[:SKINS], NM, first.endmembers[:SKINS])
        # Each day beside the first one; what grew since the day before plays no part here.
        compared = compare_days(on_mesh, (), find_indices((), NM), SESSION_SD, library, CLASSIFICATION_ANGLE_RAD)
        found = list(track(compared, f"Comparing {kind}s", total=len(later)))
        table = zip(SERIES[kind], later, found, strict=True)
        return [_row(kind, name, day, first, fruit, one) for (name, day, _), fruit, one in table]

    def _ball(self) -> list[str]:
        mesh = sphere(0.07)
        skin = TrueObject(
            ("apple_skin",), mesh, np.ones((len(mesh.vertices), 1)), endmembers(("apple_skin",), NM), NM
        )
        clouds = [cloud_of(skin, SetDown(), CloudErrors(), self.points, seed) for seed in (0, 1)]
        samples = surface_samples(clouds, [cloud.spectra for cloud in clouds], ("first", "second"))
        try:
            told = f"{find_attitude(samples[1], samples[0]).turn_deg:.2f}"
        except InputError as error:
            told = f"refused: {str(error).split(';')[0]}"
        return ["ball of one colour", "second capture", "0", told, *[""] * (len(COLUMNS) - 4)]


def _draw(path: Path, points: int) -> None:
    """What `change` shows of the brightness of the apple that lost its stem."""
    last = SERIES["apple"][-1][1]
    clouds = [cloud_of(fruit_of(day, NM), day, CloudErrors(), points, seed) for seed, day in enumerate((FIRST, last))]
    first, later = days_on_one_mesh(clouds, ["first", "last"], MeshConfig(), MAX_INCIDENCE_DEG)
    (found,) = compare_days([first, later], (), (), SESSION_SD)
    draw_change(path, first, found, found.quantities[BRIGHTNESS], SideViews(first.surface.mesh))


def _false_cm2(first: TrueObject, now: TrueObject, day: SetDown, one: DayComparison) -> float:
    """Area that any quantity calls changed, away from what did: bruise, and the place of a lost stem."""
    bruise, stem = first.materials.index("bruise"), first.materials.index("stem")
    differs = np.abs(now.weights[:, bruise] - first.weights[:, bruise]) > 0.02
    if not day.keeps_stem:
        differs |= first.weights[:, stem] > 0.5
    surface = one.after.surface
    changed = np.any([quantity.changed for quantity in one.quantities.values()], axis=0)
    if differs.any():
        true = set_down(FIRST, first.mesh.vertices)(first.mesh.vertices)[differs]
        changed &= cKDTree(true).query(surface.mesh.vertices)[0] > NEAR_M
    return float(1e4 * surface.areas_m2[changed].sum())


def _row(kind: str, name: str, day: SetDown, first: TrueObject, now: TrueObject, one: DayComparison) -> list[str]:
    attitude, brightness = one.after.attitude, one.quantities[BRIGHTNESS]
    assert attitude is not None
    grew, by_brightness, by_class = [""] * 3
    whole, whole_sd = one.quantities[WATER.name].whole
    water_found = f"{whole:+.4f} ± {whole_sd:.4f}"
    water = f"{_water_change(first, now):+.4f}"
    if day.bruise_diameter_m != AGAIN:
        true_cm2 = bruise_cm2(now) - bruise_cm2(first)
        largest = brightness.regions[0] if brightness.regions else None
        of_class = one.classes["bruise"][0]
        grew = f"{true_cm2:.2f}"
        by_brightness = beside(1e4 * largest.area_m2, true_cm2) if largest else "none"
        by_class = beside(1e4 * (of_class.after_m2 - of_class.before_m2), true_cm2)
    cells = [f"{day.turn_deg:g}", f"{attitude.turn_deg % 360:.2f} ± {attitude.turn_sd_deg:.2f}", f"{day.growth:g}"]
    cells += [f"{attitude.growth:.4f} ± {attitude.growth_sd:.4f}", grew, by_brightness, by_class]
    return [kind, name, *cells, water, water_found, f"{_false_cm2(first, now, day, one):.2f}"]


def beside(found: float, true: float) -> str:
    """An area and by how much it differs from the true one."""
    return f"{found:.2f} ({100 * (found / true - 1):+.0f} %)"


def _water_change(first: TrueObject, now: TrueObject) -> float:
    """Median over the surface."""
    areas_m2 = first.mesh.vertex_areas_m2()
    drawn = np.random.default_rng(0).choice(len(areas_m2), 20_000, p=areas_m2 / areas_m2.sum())
    before, after = (
        index_values(WATER, one.weights[drawn] @ one.endmembers, one.wavelengths_nm) for one in (first, now)
    )
    return float(np.median(after - before))


if __name__ == "__main__":
    tyro.cli(ChangeOverTime).main()
