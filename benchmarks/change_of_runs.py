"""What `hsi-sc-nerf change` finds between trained runs of a fruit: a bruise that grows, and no change where none is.

    uv run python benchmarks/change_of_runs.py FOLDER
    uv run python benchmarks/change_of_runs.py FOLDER --kind pear --fruits 10
    uv run python benchmarks/change_of_runs.py FOLDER --height-m 0.045 --fruits 11

Each fruit has four sessions: of the first day, of the same day set down anew twice, and of a day when its bruise has
grown. They are simulated in even light that grows weaker, with photon and read noise, processed, trained by the
preset fast and exported by the commands that a user would type; what is there is not done again, neither these nor
the days brought to one mesh (days-N.pkl).
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from another_day import HEIGHT_M, STAND_M, Kind, SetDown, bruise_cm2, dried_materials, fruit_of, set_down
from change_over_time import AGAIN, GROWN, MESH, NEAR_M, SESSION_SD, beside
from jaxtyping import Bool, Float
from results_table import Benchmark, write_results
from rich.progress import track
from scipy.spatial import cKDTree
from true_object import TrueObject

from hsi_sc_nerf.analysis.change import DayComparison, compare_days
from hsi_sc_nerf.analysis.change_days import Day, days_on_one_mesh
from hsi_sc_nerf.analysis.change_maps import BRIGHTNESS
from hsi_sc_nerf.benchmark.steps import run_step, typed_command
from hsi_sc_nerf.export.cloud import MAX_INCIDENCE_DEG, SpectralCloud, read_spectral_ply
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.indices.catalogue import find_indices
from hsi_sc_nerf.simulate.render import Part
from hsi_sc_nerf.simulate.scene import OwnMesh, load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import write_true_mesh

BANDS, FRAMES, SIZE_PX, POINTS = 25, 36, 128, 200_000
EVERY = 4
"""So many points for each one that is compared, to save time."""
EFFECTS = ("photon_noise", "read_noise", "{lamp_drift: {percent: -3.0}}")
NM = np.linspace(400.0, 1000.0, BANDS)
REPEAT, SECOND = "repeat", "second capture"
DAYS = {
    "first": SetDown(AGAIN),
    REPEAT: SetDown(AGAIN, turn_deg=90.0, tip_deg=2.0),
    SECOND: SetDown(AGAIN, turn_deg=200.0, tip_deg=4.0),
    "grown, 10 % dried": SetDown(GROWN, dried=0.1, turn_deg=30.0, tip_deg=3.0),
}
COLUMNS = (
    *("fruit", "day", "second capture of the first day", "turn, °", "turn found, °", "bruise grew, cm²"),
    *("by brightness, cm²", "false change, cm²", "largest undecided, cm²", "in quantities"),
)
AFTER_REPEAT = f"{REPEAT}, then second capture"
"""Another pair of captures of the first day."""


@dataclass(frozen=True)
class ChangeOfRuns(Benchmark):
    """Train the runs, compare them, and write the table."""

    folder: tyro.conf.Positional[Path]
    """For sessions and runs."""
    fruits: tuple[int, ...] = (3, 4, 5, 6)
    """Seeds, each of another fruit."""
    kind: Kind = "apple"
    height_m: float = HEIGHT_M
    days: tuple[str, ...] = tuple(DAYS)
    """Of `DAYS`, the first one among them; without "repeat", nothing is compared with --repeat."""

    def main(self) -> None:
        """Measure, print, write."""
        rows = [row for fruit in track(self.fruits, "Fruits") for row in self._rows(fruit)]
        write_results(
            "change_of_runs", COLUMNS, rows, keys=3, seed=" ".join(map(str, self.fruits)), folder=self.results
        )

    def _rows(self, fruit: int) -> list[list[str]]:
        first, *later = self.days_of(fruit)
        indices, rows = find_indices((), first.surface.wavelengths_nm), []
        # Without --repeat, that capture of the first day is a day as well.
        for given in (None, *(day for day in later if day.name == REPEAT)):
            days = [first, *(day for day in later if day is not given)]
            found = compare_days(days, (), indices, SESSION_SD, repeat=given)
            rows += [self._row(fruit, one, given) for one in found]
        blank = [day for day in later if day.name in (REPEAT, SECOND)]
        if len(blank) == 2:
            (one,) = compare_days(blank, (), indices, SESSION_SD)
            rows.append(self._row(fruit, one, None, AFTER_REPEAT))
        return rows

    def days_of(self, fruit: int) -> list[Day]:
        """The days of a fruit on the first one's mesh, trained if they are not kept."""
        kept = self.folder / f"days-{fruit}.pkl"
        if not kept.is_file():
            clouds = [self._cloud(fruit, name) for name in self.days]
            kept.write_bytes(pickle.dumps(days_on_one_mesh(clouds, self.days, MESH, MAX_INCIDENCE_DEG)))
        days: list[Day] = pickle.loads(kept.read_bytes())
        return [day for day in days if day.name in self.days]

    def _name(self, fruit: int) -> str:
        return f"{self.kind} {fruit}" + f", {1e3 * self.height_m:g} mm" * (self.height_m != HEIGHT_M)

    def _fruit(self, seed: int, day: SetDown) -> TrueObject:
        return fruit_of(day, NM, self.kind, seed, self.height_m)

    def _row(self, fruit: int, one: DayComparison, repeat: Day | None, name: str = "") -> list[str]:
        day, attitude, brightness = DAYS[one.after.name], one.after.attitude, one.quantities[BRIGHTNESS]
        assert attitude is not None
        grew = by_brightness = ""
        before, after = (self._fruit(fruit, each) for each in (DAYS["first"], day))
        if day.bruise_diameter_m != AGAIN:
            true_cm2 = bruise_cm2(after) - bruise_cm2(before)
            grew, by_brightness = f"{true_cm2:.2f}", "none"
            if brightness.counted:
                by_brightness = beside(1e4 * brightness.regions[0].area_m2, true_cm2)
        surface = one.after.surface
        placed = on_the_table(before)
        bruise = before.materials.index("bruise")
        differs = np.abs(after.weights[:, bruise] - before.weights[:, bruise]) > 0.02
        far = np.ones(len(surface.mesh.vertices), bool)
        if differs.any():
            far = cKDTree(placed[differs]).query(surface.mesh.vertices)[0] > NEAR_M
        false = {name: one.changed & far for name, one in one.quantities.items()}
        false_cm2 = 1e4 * surface.areas_m2[np.any([*false.values()], axis=0)].sum()
        undecided = _undecided_cm2(one, far)
        named = ", ".join(quantity for quantity in false if false[quantity].any() or undecided[quantity])
        cells = [
            f"{day.turn_deg:g}",
            f"{attitude.turn_deg % 360:.2f} ± {attitude.turn_sd_deg:.2f}",
            grew,
            by_brightness,
        ]
        cells += [f"{false_cm2:.2f}", f"{max(undecided.values()):.2f}", named]
        return [self._name(fruit), name or one.after.name, "yes" if repeat else "no", *cells]

    def _cloud(self, seed: int, name: str) -> SpectralCloud:
        """The cloud of a short training on a simulated session of the fruit on that day."""
        day, at = DAYS[name], [*DAYS].index(name)
        folder = self.folder / f"{seed}-{at}"
        session, data, run = folder / "session", folder / "data", folder / "training" / "hsi-sc-nerf" / "run"
        cloud = folder / "export" / "point_cloud.ply"
        if not session.exists():
            folder.mkdir(parents=True, exist_ok=True)
            fruit = self._fruit(seed, day)
            placed = Mesh(set_down(day, fruit.mesh.vertices)(fruit.mesh.vertices), fruit.mesh.triangles)
            write_true_mesh(folder / "fruit.ply", Part(placed, fruit.materials, fruit.weights))
            own = OwnMesh("mesh", folder / "fruit.ply", fruit.materials)
            scene = replace(load_scene("apple"), object=own, materials=dried_materials(day, self.kind))
            scene = override(scene, frames=FRAMES, size_px=SIZE_PX, bands=BANDS, seed=10 * seed + at, effects=EFFECTS)
            simulate_session(scene, session)
        training = ["ns-train", "hsi-sc-nerf", "--data", data, "--output-dir", folder]
        training += ["--experiment-name", "training", "--timestamp", "run", "--vis", "tensorboard"]
        training += ["--preset", "fast", "--evaluate-stages", "False"]
        exporting = ["ns-export", "pointcloud", "--load-config", run / "config.yml", "--output-dir", cloud.parent]
        steps: Sequence[tuple[str, Path, Sequence[object]]] = (
            ("process", data / "transforms.json", ["hsi-sc-nerf", "process", session, "--output-dir", data]),
            ("train", run / "stage-masked", training),
            ("export", cloud, [*exporting, "--num-points", POINTS]),
        )
        for name, left, words in steps:
            if not left.exists():
                run_step(name, typed_command(words), folder / f"{name}.log")
        return read_spectral_ply(cloud).select(slice(None, None, EVERY))


def on_the_table(fruit: TrueObject) -> Float[np.ndarray, "v 3"]:
    """Vertices of a fruit on its first day: a simulated session has its object on the axis."""
    placed = set_down(DAYS["first"], fruit.mesh.vertices)(fruit.mesh.vertices)
    centre = (placed.min(axis=0) + placed.max(axis=0)) / 2.0
    return placed + np.array([-centre[0], -centre[1], STAND_M - placed[:, 2].min()])


def _undecided_cm2(one: DayComparison, far: Bool[np.ndarray, "v"]) -> dict[str, float]:
    """Area of the largest undecided region of each quantity that lies away from what changed; 0 for none."""
    areas_m2, largest = one.after.surface.areas_m2, {}
    for name, quantity in one.quantities.items():
        insides = [quantity.region == number for number in range(quantity.counted, len(quantity.regions))]
        away = [inside for inside in insides if np.average(far[inside], weights=areas_m2[inside]) > 0.5]
        largest[name] = 1e4 * max((areas_m2[inside].sum() for inside in away), default=0.0)
    return largest


if __name__ == "__main__":
    tyro.cli(ChangeOfRuns).main()
