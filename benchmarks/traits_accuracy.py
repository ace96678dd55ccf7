"""How good traits are, on a simulated object whose sizes, spectra and materials are known, as a table.

    uv run python benchmarks/traits_accuracy.py SESSION "pear, shaded" --cloud EXPORT/point_cloud.ply

Without a cloud, one that an ideal reconstruction would give is sampled from the true mesh: even, of what the cameras
see, with true spectra and 0.3 mm of noise. The object stands where the container ends.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tyro
from results_table import Benchmark, write_results
from rich.console import Console
from true_object import TrueObject, relative_rms

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed_mesh, open_edges
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.analysis.size import size_of
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh, with_spectra
from hsi_sc_nerf.analysis.traits import RegionOfInterest, classified, region_spectrum
from hsi_sc_nerf.export.cloud import MAX_INCIDENCE_DEG, SpectralCloud, read_spectral_ply
from hsi_sc_nerf.simulate.truth import load_truth
from hsi_sc_nerf.terminal import screen_table

EVERY_KTH_CAMERA = 5
SIZES = {
    "area_m2": "area",
    "volume_l": "volume",
    "height_m": "height",
    "largest_diameter_m": "largest diameter",
    "smallest_diameter_m": "smallest diameter",
}
ALONE = "volume, base height unknown"
CLASSIFIED = ("by angle, truth classified alike", "by angle", "by mixture")
COLUMNS = (
    "cloud",
    *SIZES.values(),
    ALONE,
    "spectra of spots, median RMS",
    "spectra of spots, worst RMS",
    *(f"bruise {how}" for how in CLASSIFIED),
)
SPOTS, SPOT_RADIUS_M = 12, 0.005
BLUSH_FRACTIONS = (0.25, 0.5, 0.75)
LEFT_OUT = ("stem",)
"""Its spectrum lies between those of bruise and skin: the rim of a bruise would be stem."""


@dataclass(frozen=True)
class TraitsAccuracy(Benchmark):
    """Compare the traits of a cloud with the truth of the simulated session that it shows."""

    session: tyro.conf.Positional[Path]
    """Simulated session."""
    name: tyro.conf.Positional[str]
    """Name of the cloud in the table."""
    cloud: Path | None = None
    """Spectral cloud reconstructed from it; without it, an ideal cloud."""
    points: int = 100_000
    """Points of the ideal cloud."""
    noise_m: float = 0.0003
    """Noise of the ideal cloud in each direction."""
    mesh: MeshConfig = field(default_factory=MeshConfig)
    """How the mesh is made."""

    def main(self) -> None:
        """Measure, print all figures, write the table's row."""
        truth = load_truth(self.session)
        true = TrueObject.of(truth)
        eyes_m = truth.camera_to_world[::EVERY_KTH_CAMERA, :3, 3]
        cloud = read_spectral_ply(self.cloud) if self.cloud else true.cloud(self.points, eyes_m, self.noise_m)
        stands_at_m = float(true.mesh.vertices[:, 2].min())
        started = time.perf_counter()
        config = replace(self.mesh, base_height_m=stands_at_m)
        mesh = closed_mesh(cloud.points, cloud.normals, config)
        surface = with_spectra(mesh, cloud, config.smoothing_radius_m, MAX_INCIDENCE_DEG)
        seconds = time.perf_counter() - started

        ideal = true.spectral_mesh(eyes_m)
        sizes = [*_size_rows(surface, ideal), *_size_of_cloud_alone(cloud, ideal)]
        median, worst, where = _spot_errors(surface, ideal)
        classes = _class_rows(surface, true, ideal)
        details = [*sizes, ["spots", "", "", f"median {median}, worst {worst} {where}"], *classes]
        title = f"open edges: {open_edges(mesh)}; {len(cloud.points)} points; {seconds:.0f} s"
        Console(width=160).print(screen_table(["trait", "measured", "true", "error"], details, title))
        errors = {name: error for name, _, _, error in (*sizes, *classes)}
        cells = [*(errors[name] for name in SIZES.values()), errors[ALONE], median, worst]
        is_bruised = f"bruise {CLASSIFIED[-1]}" in errors
        cells += [errors.get(f"bruise {how}", "") if is_bruised else "" for how in CLASSIFIED]
        write_results("traits_accuracy", COLUMNS, [[self.name, *cells]], keys=1, folder=self.results)


def spots_on(ideal: SpectralMesh) -> list[RegionOfInterest]:
    """Spots all over the seen surface, above the base."""
    height_m = ideal.mesh.vertices[:, 2] - ideal.mesh.vertices[:, 2].min()
    weights = np.where(ideal.seen & (height_m > 2.0 * SPOT_RADIUS_M), ideal.areas_m2, 0.0)
    chosen = np.random.default_rng(0).choice(len(weights), SPOTS, p=weights / weights.sum())
    return [
        RegionOfInterest(f"{number}", tuple(centre.tolist()), SPOT_RADIUS_M)
        for number, centre in enumerate(ideal.mesh.vertices[chosen])
    ]


def _size_row(name: str, measured: float, true: float) -> list[str]:
    return [name, f"{measured:.5g}", f"{true:.5g}", f"{100.0 * (measured / true - 1.0):+.1f} %"]


def _size_rows(surface: SpectralMesh, ideal: SpectralMesh) -> list[list[str]]:
    measured, true = size_of(surface.mesh), size_of(ideal.mesh)
    seen = [float(one.areas_m2[one.seen].sum()) for one in (surface, ideal)]
    rows = [_size_row(title, getattr(measured, name), getattr(true, name)) for name, title in SIZES.items()]
    return [*rows, _size_row("seen area", *seen)]


def _size_of_cloud_alone(cloud: SpectralCloud, ideal: SpectralMesh) -> list[list[str]]:
    """Sizes if it is not known where the object stands: closed where the cloud ends."""
    measured, true = size_of(closed_mesh(cloud.points, cloud.normals, MeshConfig())), size_of(ideal.mesh)
    area = _size_row("area, base height unknown", measured.area_m2, true.area_m2)
    return [area, _size_row(ALONE, measured.volume_l, true.volume_l)]


def _spot_errors(surface: SpectralMesh, ideal: SpectralMesh) -> tuple[str, str, str]:
    """Relative RMS of mean spectra of spots all over the seen surface: median, worst, and where."""
    errors, spots = [], spots_on(ideal)
    for spot in spots:
        measured, true = (region_spectrum(one, spot.of(one)).mean for one in (surface, ideal))
        errors.append(relative_rms(measured, true))
    x, y, z = 1000.0 * np.array(spots[int(np.argmax(errors))].centre_m)
    median, worst = 100.0 * np.median(errors), 100.0 * max(errors)
    return f"{median:.2g} %", f"{worst:.2g} %", f"at ({x:.0f}, {y:.0f}, {z:.0f}) mm"


def _class_rows(surface: SpectralMesh, true: TrueObject, ideal: SpectralMesh) -> list[list[str]]:
    """Areas of classes, against the true surface: classified in the same way, and where the class has most of it.

    The first difference is the cloud's, the second that of telling tissues by spectral angle as well, the third that
    of telling them by mixture.

    Skin that blushes has references between its two ends: half-blushed skin is nearer to a bruise than to either.
    """
    names = [name.replace("_blush", "_skin") for name in true.materials]
    kept = [index for index, name in enumerate(names) if name not in LEFT_OUT]
    references = [(names[index], true.endmembers[index]) for index in kept]
    ends = [true.endmembers[index] for index in kept if names[index].endswith("_skin")]
    if len(ends) == 2:
        references += [(names[0], (1.0 - part) * ends[0] + part * ends[1]) for part in BLUSH_FRACTIONS]
    library = SpectralLibrary(
        tuple(name for name, _ in references), true.wavelengths_nm, np.stack([spectrum for _, spectrum in references])
    )
    found, alike = (classified(one, library, paper.CLASSIFICATION_ANGLE_RAD) for one in (surface, ideal))
    rows = []
    # Unmixing needs all tissues, each pure, and finds their mixtures itself.
    pure = SpectralLibrary(tuple(names), true.wavelengths_nm, true.endmembers)
    unmixed = classified(surface, pure, paper.CLASSIFICATION_ANGLE_RAD)
    mixture_m2 = dict(zip(unmixed.names, unmixed.mixture_areas_m2, strict=True))
    for name, area_m2, alike_m2 in zip(found.names, found.areas_m2, alike.areas_m2, strict=True):
        fraction = true.weights[:, [other == name for other in names]].sum(axis=1)
        most_m2 = float(ideal.areas_m2[ideal.seen & (fraction > 0.5)].sum())
        areas = ((area_m2, alike_m2), (area_m2, most_m2), (mixture_m2[name], most_m2))
        for how, (measured_m2, true_m2) in zip(CLASSIFIED, areas, strict=True):
            if true_m2 > 0.0:
                error = f"{100 * (measured_m2 / true_m2 - 1):+.1f} %"
                rows.append([f"{name} {how}", f"{1e4 * measured_m2:.2f}", f"{1e4 * true_m2:.2f}", error])
    return rows


if __name__ == "__main__":
    tyro.cli(TraitsAccuracy, description=__doc__).main()
