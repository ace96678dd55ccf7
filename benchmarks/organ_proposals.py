"""How well `hsi-sc-nerf traits --propose-regions` finds the organs of simulated objects, as a table.

    uv run python benchmarks/organ_proposals.py
    uv run python benchmarks/organ_proposals.py --objects --trained RUNS/apple-12 RUNS/apple-13  # of trained clouds
    uv run python benchmarks/organ_proposals.py --picture docs/images/organs.png  # that alone

The clouds are those that runs would give: the true surface as cameras see it, with the errors of a run
(`another_day.CloudErrors`). Trained clouds are those of `benchmarks/trait_uncertainty.py RUNS`, of
`benchmarks/change_of_runs.py RUNS`, or of any folder with a simulated ``session`` and the cloud that a run exported.
A point is an organ's if its material is more than half of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from another_day import CloudErrors, SetDown, cloud_of, set_down
from matplotlib import rc_context
from results_table import Benchmark, write_results
from rich.progress import track
from true_object import TrueObject

from hsi_sc_nerf.analysis.drawn_regions import points_of_page, propose_regions
from hsi_sc_nerf.analysis.organs import BODY, CALYX, HUSK, KERNELS, STEM
from hsi_sc_nerf.analysis.spectral_edges import LEAST_POINTS
from hsi_sc_nerf.export.cloud import SpectralCloud, read_spectral_ply
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.plotting import COLOURS, STYLE, new_figure, save_figure
from hsi_sc_nerf.simulate.assemble import object_part
from hsi_sc_nerf.simulate.materials import endmembers
from hsi_sc_nerf.simulate.render import Part
from hsi_sc_nerf.simulate.scene import load_scene
from hsi_sc_nerf.simulate.truth import load_truth

NM = np.linspace(400.0, 1000.0, 25)
SEEDS = range(11, 14)
"""Not those on which the settings of the method were chosen."""
UPSIDE_DOWN = "apple upside down"
ORGANS: dict[str, dict[str, str]] = {
    "pear": {STEM: STEM},
    "apple": {STEM: STEM, "part 1": "bruise"},
    UPSIDE_DOWN: {CALYX: CALYX, "part 1": "bruise"},
    "maize": {HUSK: HUSK},
    "tomato": {},
    "sphere": {},
    "cylinder": {},
}
"""What each object has beside its body, by the name of the proposal, and its material; the scar of the tomato lies
where no camera sees it."""
TRAINED = {STEM: STEM, HUSK: HUSK, "part 1": "bruise"}
"""What is looked for on a trained cloud, where enough of its points have the material."""
STEMS = {"pepper": "pepper_stem"}
"""Materials of stems that have another name."""
CALYX_RADIUS_M = 0.008
ERRORS = {
    "usual errors": CloudErrors(),
    "twice the errors": CloudErrors(position_m=0.0004, shape_m=0.0002, white=0.04, smooth=0.03, session=0.01),
    "errors smooth over 5 mm": CloudErrors(smooth_over_m=0.005),
}
COLUMNS = ("object", "cloud", "material", "clouds", "found in", "overlap, mean", "overlap, worst", "false organs")


@dataclass(frozen=True, eq=False)
class Case:
    """A cloud, the surface that it is of, and the materials of the parts that should be proposed."""

    cloud: SpectralCloud
    true: TrueObject
    organs: dict[str, str]


@dataclass(frozen=True)
class OrganProposals(Benchmark):
    """Propose organs of simulated objects and compare them with their materials."""

    points: int = 50_000
    """Of each cloud, before what no camera sees is left out."""
    objects: tuple[str, ...] = tuple(ORGANS)
    """Which objects are measured."""
    errors: tuple[str, ...] = tuple(ERRORS)
    """Which errors their clouds have."""
    trained: tuple[Path, ...] = ()
    """Folders of simulated sessions, runs of them and the clouds that these exported, whose rows are added: a row for
    all of one object, preset and size."""
    picture: Path | None = None
    """Draw nothing but a picture of objects with organs, to this file."""

    def main(self) -> None:
        """Measure, print, write."""
        if self.picture is not None:
            _draw(self.picture, [self._simulated(name, CloudErrors(), 1).cloud for name in ORGANS if ORGANS[name]])
            return
        for errors, name in track([(errors, name) for errors in self.errors for name in self.objects], "Proposing"):
            self._write(name, errors, [self._simulated(name, ERRORS[errors], seed) for seed in SEEDS])
        trained: dict[tuple[str, str], list[Path]] = {}
        for folder in self.trained:
            truth = load_truth(folder / "session")
            preset = (
                next(folder.rglob("config.yml")).read_text(encoding="utf-8").partition("\npreset: ")[2].split()[0]
            )
            cloud = f"trained by {preset} on {len(truth.captures)} views of {truth.intrinsics.w} px"
            trained.setdefault((truth.object, cloud), []).append(folder)
        for (name, cloud), folders in track(trained.items(), "Proposing on trained clouds"):
            self._write(name, cloud, [_trained(folder) for folder in folders], " ".join(one.name for one in folders))

    def _write(self, name: str, cloud: str, cases: list[Case], seed: str = "11 to 13") -> None:
        """As soon as an object is measured; what stops later loses nothing."""
        rows = _rows(name, cloud, cases)
        write_results("organ_proposals", COLUMNS, rows, keys=3, seed=seed, folder=self.results)

    def _simulated(self, name: str, errors: CloudErrors, seed: int) -> Case:
        part = object_part(replace(load_scene(name.split()[0]), seed=seed))
        if name == UPSIDE_DOWN:
            part = _upside_down(part)
        spectra = endmembers([STEM if one == CALYX else one for one in part.materials], NM)
        true = TrueObject(part.materials, part.mesh, part.weights, spectra, NM)
        cloud = cloud_of(true, SetDown(keeps_stem=name != UPSIDE_DOWN), errors, self.points, seed)
        placed = set_down(SetDown(), true.mesh.vertices)(true.mesh.vertices)
        return Case(cloud, replace(true, mesh=Mesh(placed, true.mesh.triangles)), ORGANS[name])


def _upside_down(apple: Part) -> Part:
    """An apple that lost its stem and stands on its head: its calyx, a spot of the stem's tissue, is at the top."""
    low, high = apple.mesh.vertices[:, 2].min(), apple.mesh.vertices[:, 2].max()
    vertices = apple.mesh.vertices * [1.0, -1.0, -1.0] + [0.0, 0.0, low + high]
    weights = np.column_stack([apple.weights, np.zeros(len(vertices))])
    aside_m = np.linalg.norm(vertices[:, :2], axis=1)
    weights[(aside_m < CALYX_RADIUS_M) & (vertices[:, 2] > (low + high) / 2.0)] = np.eye(weights.shape[1])[-1]
    return replace(
        apple, mesh=Mesh(vertices, apple.mesh.triangles), weights=weights, materials=(*apple.materials, CALYX)
    )


def _trained(folder: Path) -> Case:
    """The cloud of a run, and what of `TRAINED` is on it."""
    paths = (folder / "export" / "point_cloud.ply", folder / "point_cloud.ply")
    cloud = points_of_page(read_spectral_ply(next((path for path in paths if path.is_file()), paths[0])))
    truth = load_truth(folder / "session")
    true, organs = TrueObject.of(truth), TRAINED | ({STEM: STEMS[truth.object]} if truth.object in STEMS else {})
    counts = dict(zip(true.materials, (true.nearest(cloud.points.astype(float))[1] > 0.5).sum(axis=0), strict=True))
    return Case(cloud, true, {name: one for name, one in organs.items() if counts.get(one, 0) >= LEAST_POINTS})


def _rows(name: str, cloud: str, cases: list[Case]) -> list[list[str]]:
    """A row for each organ. Overlap: points that are the organ's in both, over those in either."""
    overlaps: dict[str, list[float]] = {}
    there: dict[str, int] = {}
    false = 0
    for case in cases:
        proposed = {one.name: one.chosen for one in propose_regions(case.cloud)}
        weights = case.true.nearest(points_of_page(case.cloud).points.astype(float))[1]
        for material in case.organs.values():
            there[material] = there.get(material, 0) + 1
        for organ, chosen in proposed.items():
            material = case.organs.get(organ)
            if material is None:
                false += organ not in (BODY, KERNELS)
                continue
            of_organ = weights[:, case.true.materials.index(material)] > 0.5
            overlap = (chosen & of_organ).sum() / (chosen | of_organ).sum()
            overlaps.setdefault(material, []).append(float(overlap))
    if not there:
        return [[name, cloud, "none", f"{len(cases)}", "", "", "", f"{false}"]]
    rows = []
    for material, count in there.items():
        found = overlaps.get(material, [])
        told = [f"{len(found)}", f"{np.mean(found):.3f}", f"{min(found):.3f}"] if found else ["0", "", ""]
        rows.append([name, cloud, material, f"{count}", *told, f"{false}"])
    return rows


@rc_context(STYLE)
def _draw(path: Path, clouds: list[SpectralCloud]) -> None:
    """From one side, to one scale each, a colour an organ."""
    figure = new_figure(6.5, 3.2)
    for axes, cloud in zip(figure.subplots(1, len(clouds)), clouds, strict=True):
        for colour, region in zip(COLOURS, propose_regions(cloud), strict=False):
            facing = region.chosen & (points_of_page(cloud).normals[:, 1] < 0.0)
            x_mm, _, z_mm = 1e3 * region.points_m[facing].T
            axes.scatter(x_mm, z_mm, s=0.6, c=colour, linewidths=0.0, rasterized=True)
            axes.plot([], [], "o", c=colour, label=f"{region.name}, {region.chosen.sum():,} points")
        axes.set(aspect="equal", xlabel="x (mm)", ylabel="z (mm)")
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=7, frameon=False)
    save_figure(figure, path)


if __name__ == "__main__":
    tyro.cli(OrganProposals).main()
