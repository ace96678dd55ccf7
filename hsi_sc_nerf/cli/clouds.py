"""Commands on clouds: ``compare`` with a reference, ``traits``, ``change`` over days."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import track

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.closed_mesh import MeshConfig
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.comparison import CompareConfig, compare, read_reference
from hsi_sc_nerf.export.cloud import MAX_INCIDENCE_DEG
from hsi_sc_nerf.files import require_writable
from hsi_sc_nerf.settings_file import between, check_options
from hsi_sc_nerf.terminal import screen_table


@dataclass(frozen=True)
class CompareCommand:
    """Compare a reconstructed cloud or mesh with a reference: precision, recall and F-score over thresholds.

    Writes comparison.md with its pictures, comparison.json, and distances.ply, the cloud coloured by distance.
    """

    cloud: tyro.conf.Positional[Path]
    """The reconstruction, in metres: a point cloud (PLY) or a mesh (PLY, OBJ, STL)."""
    reference: tyro.conf.Positional[Path]
    """The reference: a cloud or mesh, or the folder of a simulated session, whose true surface is known."""
    output_dir: Path
    """Folder for the results."""
    config: Annotated[CompareConfig, tyro.conf.arg(name="")] = field(default_factory=CompareConfig)
    """Settings; the defaults are the paper's where it prints them."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: a file or a setting cannot be used, or the two cannot be aligned.
        """
        require_writable(self.output_dir)
        console = Console(stderr=True)

        def shown(items: Sequence[Any], doing: str) -> Iterable[Any]:
            return track(items, doing, console=console, transient=True)

        # Slow to import.
        from hsi_sc_nerf.evaluation.comparison_report import comparison_tables, write_comparison
        from hsi_sc_nerf.simulate.true_surface import true_reference

        if self.reference.is_dir():
            reference = true_reference(self.reference, self.config, shown)
        else:
            reference = read_reference(self.reference, self.config)
        comparison = compare(self.cloud, reference, self.config, shown)
        figures = write_comparison(self.output_dir, comparison, self.cloud.name, self.reference.name)
        Console().print(*(screen_table(*table) for table in comparison_tables(figures)))
        page = escape(str(self.output_dir / "comparison.md"))
        Console().print(f"Everything, and the pictures: {page}", soft_wrap=True)


@dataclass(frozen=True)
class TraitsCommand:
    """Measure an object's size, and the spectra, indices and classes on its surface, from its spectral cloud.

    Writes traits.md (start here), traits.json, spectra.csv, mesh.ply and pictures.
    """

    cloud: tyro.conf.Positional[Path]
    """Spectral point cloud (PLY, metres), as `ns-export pointcloud` writes it. One by `hsi-sc-nerf material` gives
    the traits of the material, and the spectra as measured beside them."""
    output_dir: Path
    """Folder to write the results to."""
    data: Path | None = None
    """The dataset that the cloud was reconstructed from. The height of its container is the default of
    --mesh.base-height-m, and the uncertainty of the sizes counts scale and pixels."""
    mesh: MeshConfig = field(default_factory=MeshConfig)
    """Settings of the mesh."""
    splits: int = between(0, math.inf, default=6)
    """Number of random splits of the cloud into halves, which are meshed separately for the uncertainty of the sizes;
    0 for sizes without uncertainty."""
    max_incidence_deg: float = MAX_INCIDENCE_DEG
    """Spectra come only from points that a camera sees at an incidence angle of at most this many degrees, because
    oblique pixels are mixed. Sizes come from all points."""
    library: Path | None = None
    """Reference spectra to classify the surface by: ENVI spectral library (.sli) or CSV (first column wavelength in
    nm, then a column a spectrum). Spectra of one name are references of one class."""
    classes: tuple[str, ...] = ()
    """Names of the library's spectra to use. Default: all."""
    angle_rad: float = between(1e-6, math.pi, default=paper.CLASSIFICATION_ANGLE_RAD)
    """Largest spectral angle, in radians, between a spectrum and its class."""
    smallest_region_cm2: float = 0.05
    """Connected regions of a class below this area are not listed (their area still counts)."""
    roi: Annotated[tuple[tuple[str, float, float, float, float], ...], tyro.conf.UseAppendAction] = ()
    """A region of interest: its name, x, y and z of its centre and its radius in metres. Repeat the option for each
    region."""
    index: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """An index to map and to average, by its name (docs/how-to/indices.md), or as a formula of reflectances:
    --index "CRI = 1/R510 - 1/R550". May be repeated. Default: NDVI, NDVI705 and WI, where the bands allow."""
    calibration: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """A regression that was fitted elsewhere, to map and to average (docs/how-to/calibrations.md): a table (CSV) of
    coefficients, or one that names an ONNX model. May be repeated."""
    components: int = between(0, math.inf, default=0)
    """Look for so many principal components and endmembers, or as many as the noise supports if that is fewer."""

    def main(self) -> None:
        """Measure and write.

        Raises:
            InputError: a file or a number cannot be used, or the results cannot be written.
        """
        from hsi_sc_nerf.analysis.library import read_library
        from hsi_sc_nerf.analysis.measurement import measure_traits
        from hsi_sc_nerf.analysis.measurement_files import write_measurement
        from hsi_sc_nerf.export.cloud import read_spectral_ply
        from hsi_sc_nerf.packed.dataset import open_packed

        check_options(self)
        if self.classes and self.library is None:
            raise InputError("--classes names spectra of a library; give it with --library.")
        require_writable(self.output_dir)
        library = read_library(self.library) if self.library else None
        if library is not None and self.classes:
            library = library.only(self.classes)
        measured = measure_traits(
            read_spectral_ply(self.cloud),
            None if self.data is None else open_packed(self.data),
            mesh=self.mesh,
            splits=self.splits,
            max_incidence_deg=self.max_incidence_deg,
            library=library,
            angle_rad=self.angle_rad,
            smallest_region_cm2=self.smallest_region_cm2,
            regions={name: (x_m, y_m, z_m, radius_m) for name, x_m, y_m, z_m, radius_m in self.roi},
            indices=self.index,
            calibrations=self.calibration,
            components=self.components,
        )
        console = Console(stderr=True)
        with console.status("tables and pictures"):
            write_measurement(self.output_dir, measured, self.cloud.name)
        console.print(f"Traits, with pictures: {escape(str(self.output_dir / 'traits.md'))}", soft_wrap=True)


@dataclass(frozen=True)
class ChangeCommand:
    """Find what changed on an object between days, beyond noise: spectra, indices, classes, and the surface.

    The object may have been set down turned and tipped, may have grown a little and lost its stem. Writes change.md
    (start here), change.json, change.csv, change.ply, pictures, and the days as a film.
    """

    clouds: tyro.conf.Positional[tuple[Path, ...]]
    """The days in their order, the first one before the others: spectral point clouds (PLY, metres), or folders of
    `hsi-sc-nerf run`."""
    output_dir: Path
    """Folder to write the results to."""
    mesh: MeshConfig = field(default_factory=MeshConfig)
    """Settings of the mesh, which is made from the first day."""
    band_nm: tuple[float, ...] = ()
    """Wavelengths (nm) whose reflectance is compared, beside spectra and indices."""
    index: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """An index to compare, by its name or as a formula, as for `hsi-sc-nerf traits`. May be repeated. Default: NDVI,
    NDVI705 and WI, where the bands allow."""
    session_std: float = between(0.0, 1.0, default=0.01)
    """Relative standard deviation of what the white references of two sessions make of one reflectance. It counts in
    what is said of the whole surface, not in what changed here and not there."""
    max_incidence_deg: float = MAX_INCIDENCE_DEG
    """Spectra come only from points that a camera sees at an incidence angle of at most this many degrees."""
    library: Path | None = None
    """Reference spectra to classify the surface by, as for `hsi-sc-nerf traits`: ENVI library (.sli) or CSV."""
    angle_rad: float = between(1e-6, math.pi, default=paper.CLASSIFICATION_ANGLE_RAD)
    """Largest spectral angle, in radians, between a spectrum and the mixture of its classes."""
    smallest_region_cm2: float = 0.05
    """Regions below this area are left out."""

    def main(self) -> None:
        """Compare and write.

        Raises:
            InputError: a file or a number cannot be used, a day cannot be registered, or the results cannot be
                written.
        """
        from hsi_sc_nerf.analysis import change_pictures, change_report
        from hsi_sc_nerf.analysis.change import compare_days
        from hsi_sc_nerf.analysis.change_days import days_on_one_mesh
        from hsi_sc_nerf.analysis.change_maps import BRIGHTNESS, SPECTRUM
        from hsi_sc_nerf.analysis.library import read_library
        from hsi_sc_nerf.analysis.pictures import SideViews
        from hsi_sc_nerf.export.cloud import read_spectral_ply
        from hsi_sc_nerf.indices.catalogue import find_indices

        check_options(self)
        if len(self.clouds) < 2:
            raise InputError("a change needs two clouds or more; give the one before and those after.")
        require_writable(self.output_dir)
        library = read_library(self.library) if self.library else None
        paths = [_cloud_of_run(path) for path in self.clouds]
        names = [f"{day} {_day_name(path)}" for day, path in enumerate(self.clouds, start=1)]
        console = Console(stderr=True)
        clouds = [read_spectral_ply(path) for path in track(paths, "Reading", console=console, transient=True)]
        indices = find_indices(self.index, clouds[0].wavelengths_nm)
        if library is not None:
            library = library.at(clouds[0].wavelengths_nm)
        days = days_on_one_mesh(
            clouds,
            names,
            self.mesh,
            self.max_incidence_deg,
            lambda starts: track(starts, "Registering", console=console, transient=True),
        )
        compared = compare_days(
            days, self.band_nm, indices, self.session_std, self.smallest_region_cm2 * 1e-4, library, self.angle_rad
        )
        steps = track(compared, "Comparing", total=len(days) - 1, console=console, transient=True)
        comparisons = list(steps)

        views, pictures = SideViews(days[0].surface.mesh), {}
        each = [
            (day, one, quantity) for day, one in enumerate(comparisons, 1) for quantity in one.quantities.values()
        ]
        for day, one, quantity in track(each, "Drawing", console=console, transient=True):
            file = f"{quantity.name.lower().replace(' ', '_')}_{day}.png"
            change_pictures.draw_change(self.output_dir / file, days[0], one, quantity, views)
            pictures[f"{quantity.name[0].upper()}{quantity.name[1:]}, {one.after.name}"] = file
        with console.status("film and tables"):
            shown = SPECTRUM if SPECTRUM in comparisons[0].quantities else BRIGHTNESS
            film = self.output_dir / "change.mp4"
            change_pictures.write_film(film, days[0], comparisons, views, shown)
            change_report.write_change_ply(self.output_dir / "change.ply", days[0], comparisons)
            settings = {"band_nm": list(self.band_nm), "session_std": self.session_std, **asdict(self.mesh)}
            settings |= {"max_incidence_deg": self.max_incidence_deg, "smallest_region_cm2": self.smallest_region_cm2}
            change_report.write_tables(self.output_dir, comparisons, settings, pictures)
        page = escape(str(self.output_dir / "change.md"))
        console.print(f"Changes, with pictures: {page}", soft_wrap=True)


def _cloud_of_run(path: Path) -> Path:
    """A cloud's file; that of the material, if a run has one."""
    if not path.is_dir():
        return path
    for name in ("point_cloud-material.ply", "point_cloud.ply"):
        if (path / name).is_file():
            return path / name
    raise InputError(f"{path}: holds no point_cloud.ply; give a cloud, or a folder of `hsi-sc-nerf run`.")


def _day_name(path: Path) -> str:
    """The run's folder, or the file without its suffix."""
    return path.resolve().name if path.is_dir() else path.stem
