"""How well `hsi-sc-nerf traits --propose-regions` finds the organs of simulated objects, as a table.

    uv run python benchmarks/organ_proposals.py
    uv run python benchmarks/organ_proposals.py --trained OUT  # and of an object that `hsi-sc-nerf demo` trained
    uv run python benchmarks/organ_proposals.py --picture docs/images/organs.png  # that alone

The clouds are those that runs would give: the true surface as cameras see it, with the errors of a run
(`another_day.CloudErrors`). A point is an organ's if its material is more than half of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from another_day import CloudErrors, SetDown, cloud_of, set_down
from matplotlib import rc_context
from results_table import RESULTS, write_results
from rich.progress import track
from true_object import TrueObject

from hsi_sc_nerf.analysis.drawn_regions import points_of_page, propose_regions
from hsi_sc_nerf.analysis.organs import BODY, CALYX, HUSK, KERNELS, STEM
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
CALYX_RADIUS_M = 0.008
ERRORS = {
    "usual errors": CloudErrors(),
    "twice the errors": CloudErrors(position_m=0.0004, shape_m=0.0002, white=0.04, smooth=0.03, session=0.01),
    "errors smooth over 5 mm": CloudErrors(smooth_over_m=0.005),
}
COLUMNS = ("object", "cloud", "material", "clouds", "found in", "overlap, mean", "overlap, worst", "false organs")


@dataclass(frozen=True)
class OrganProposals:
    """Propose organs of simulated objects and compare them with their materials."""

    points: int = 50_000
    """Of each cloud, before what no camera sees is left out."""
    objects: tuple[str, ...] = tuple(ORGANS)
    """Which objects are measured."""
    errors: tuple[str, ...] = tuple(ERRORS)
    """Which errors their clouds have."""
    trained: tuple[Path, ...] = ()
    """Folders that `hsi-sc-nerf demo` wrote, whose rows are added."""
    results: Path = RESULTS
    """Folder of the CSV file."""
    picture: Path | None = None
    """Draw nothing but a picture of objects with organs, to this file."""

    def main(self) -> None:
        """Measure, print, write."""
        if self.picture is not None:
            _draw(self.picture, [self._simulated(name, CloudErrors(), 1)[0] for name in ORGANS if ORGANS[name]])
            return
        for errors, name in track([(errors, name) for errors in self.errors for name in self.objects], "Proposing"):
            self._write(name, errors, [self._simulated(name, ERRORS[errors], seed) for seed in SEEDS])
        for folder in self.trained:
            truth = load_truth(folder / "session")
            case = read_spectral_ply(folder / "point_cloud.ply"), TrueObject.of(truth)
            self._write(truth.object, f"trained on {truth.intrinsics.w} px", [case])

    def _write(self, name: str, errors: str, cases: list[tuple[SpectralCloud, TrueObject]]) -> None:
        """As soon as an object is measured; what stops later loses nothing."""
        rows = _rows(name, errors, cases)
        write_results("organ_proposals", COLUMNS, rows, keys=3, seed="11 to 13", folder=self.results)

    def _simulated(self, name: str, errors: CloudErrors, seed: int) -> tuple[SpectralCloud, TrueObject]:
        part = object_part(replace(load_scene(name.split()[0]), seed=seed))
        if name == UPSIDE_DOWN:
            part = _upside_down(part)
        spectra = endmembers([STEM if one == CALYX else one for one in part.materials], NM)
        true = TrueObject(part.materials, part.mesh, part.weights, spectra, NM)
        cloud = cloud_of(true, SetDown(keeps_stem=name != UPSIDE_DOWN), errors, self.points, seed)
        placed = set_down(SetDown(), true.mesh.vertices)(true.mesh.vertices)
        return cloud, replace(true, mesh=Mesh(placed, true.mesh.triangles))


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


def _rows(name: str, errors: str, cases: list[tuple[SpectralCloud, TrueObject]]) -> list[list[str]]:
    """A row for each organ. Overlap: points that are the organ's in both, over those in either."""
    overlaps: dict[str, list[float]] = {material: [] for material in ORGANS[name].values()}
    false = 0
    for cloud, true in cases:
        proposed = {one.name: one.chosen for one in propose_regions(cloud)}
        weights = true.nearest(points_of_page(cloud).points.astype(float))[1]
        for organ, chosen in proposed.items():
            material = ORGANS[name].get(organ)
            if material is None:
                false += organ not in (BODY, KERNELS)
                continue
            of_organ = weights[:, true.materials.index(material)] > 0.5
            overlaps[material].append((chosen & of_organ).sum() / (chosen | of_organ).sum())
    rows = []
    for material, found in (overlaps or {"none": []}).items():
        told = [f"{len(found)}", f"{np.mean(found):.3f}", f"{min(found):.3f}"] if found else ["0", "", ""]
        rows.append([name, errors, material, f"{len(cases)}", *(told if overlaps else [""] * 3), f"{false}"])
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
