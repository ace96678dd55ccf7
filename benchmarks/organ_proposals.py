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

from hsi_sc_nerf.analysis.drawn_regions import points_of_page, propose_regions
from hsi_sc_nerf.analysis.organs import BODY, HUSK, KERNELS, STEM
from hsi_sc_nerf.export.cloud import SpectralCloud, read_spectral_ply
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.plotting import COLOURS, STYLE, new_figure, save_figure
from hsi_sc_nerf.simulate.assemble import object_part
from hsi_sc_nerf.simulate.materials import endmembers
from hsi_sc_nerf.simulate.scene import load_scene
from hsi_sc_nerf.simulate.true_surface import TrueSurface
from hsi_sc_nerf.simulate.truth import load_truth

NM = np.linspace(400.0, 1000.0, 25)
SEEDS = range(11, 16)
"""Not those on which the settings of the method were chosen."""
ORGAN = {"pear": STEM, "apple": STEM, "maize": HUSK, "tomato": "", "sphere": "", "cylinder": ""}
"""What each object has beside its body; the scar of the tomato lies where no camera sees it."""
ERRORS = {
    "usual errors": CloudErrors(),
    "twice the errors": CloudErrors(position_m=0.0004, shape_m=0.0002, white=0.04, smooth=0.03, session=0.01),
    "errors smooth over 5 mm": CloudErrors(smooth_over_m=0.005),
}
COLUMNS = ("object", "cloud", "organ", "clouds", "found in", "overlap, mean", "overlap, worst", "false organs")


@dataclass(frozen=True)
class OrganProposals:
    """Propose organs of simulated objects and compare them with their materials."""

    points: int = 50_000
    """Of each cloud, before what no camera sees is left out."""
    trained: tuple[Path, ...] = ()
    """Folders that `hsi-sc-nerf demo` wrote, whose rows are added."""
    results: Path = RESULTS
    """Folder of the CSV file."""
    picture: Path | None = None
    """Draw nothing but a picture of objects with organs, to this file."""

    def main(self) -> None:
        """Measure, print, write."""
        if self.picture is not None:
            _draw(self.picture, [self._simulated(name, CloudErrors(), 1)[0] for name in ORGAN if ORGAN[name]])
            return
        rows = []
        for name, errors in track([(name, errors) for name in ORGAN for errors in ERRORS], "Proposing"):
            cases = [self._simulated(name, ERRORS[errors], seed) for seed in SEEDS]
            rows.append(_row(name, errors, cases))
        for folder in self.trained:
            truth = load_truth(folder / "session")
            case = read_spectral_ply(folder / "point_cloud.ply"), TrueSurface.of(truth)
            rows.append(_row(truth.object, f"trained on {truth.intrinsics.w} px", [case]))
        write_results("organ_proposals", COLUMNS, rows, seed="11 to 15", folder=self.results)

    def _simulated(self, name: str, errors: CloudErrors, seed: int) -> tuple[SpectralCloud, TrueSurface]:
        part = object_part(replace(load_scene(name), seed=seed))
        spectra = endmembers(part.materials, NM)
        true = TrueSurface(part.materials, part.mesh, part.weights, spectra, NM)
        cloud = cloud_of(true, SetDown(), errors, self.points, seed)
        placed = set_down(SetDown(), true.mesh.vertices)(true.mesh.vertices)
        return cloud, replace(true, mesh=Mesh(placed, true.mesh.triangles))


def _row(name: str, errors: str, cases: list[tuple[SpectralCloud, TrueSurface]]) -> list[str]:
    """Overlap: points that are the organ's in both, over those that are in either (intersection over union)."""
    organ, overlaps, false = ORGAN[name], [], 0
    for cloud, true in cases:
        proposed = {one.name: one.chosen for one in propose_regions(cloud)}
        false += len(set(proposed) - {BODY, KERNELS, organ})
        if organ and organ in proposed:
            weights = true.nearest(points_of_page(cloud).points.astype(float))[1]
            of_organ = weights[:, true.materials.index(organ)] > 0.5
            overlaps.append((proposed[organ] & of_organ).sum() / (proposed[organ] | of_organ).sum())
    found = [f"{len(overlaps)}", f"{np.mean(overlaps):.3f}", f"{min(overlaps):.3f}"] if overlaps else ["0", "", ""]
    return [name, errors, organ or "none", f"{len(cases)}", *(found if organ else [""] * 3), f"{false}"]


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
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.25), fontsize=7, frameon=False)
    save_figure(figure, path)


if __name__ == "__main__":
    tyro.cli(OrganProposals).main()
