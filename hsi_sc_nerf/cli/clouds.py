"""Commands on clouds: ``compare`` with a reference, ``traits``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
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

PROPOSED = "regions_proposed.json"


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
        check_options(self.config)
        require_writable(self.output_dir)
        console = Console(stderr=True)

        def shown(items: Sequence[Any], doing: str) -> Iterable[Any]:
            return track(items, doing, console=console, transient=True)

        # Slow to import.
        from hsi_sc_nerf.evaluation.comparison_report import comparison_tables, write_comparison
        from hsi_sc_nerf.simulate.scores import true_reference

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

    Writes traits.md (start here), traits.json, spectra.csv, mesh.ply and pictures. Where several objects stand on the
    table (process --masks.pieces), each has its own in the folders piece-1 (the largest), piece-2 and so on.
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
    max_incidence_deg: float = between(1.0, 90.0, default=MAX_INCIDENCE_DEG)
    """Spectra come only from points that a camera sees at an incidence angle of at most this many degrees, because
    oblique pixels are mixed. Sizes come from all points."""
    library: Path | None = None
    """Reference spectra to classify the surface by: ENVI spectral library (.sli) or CSV (first column wavelength in
    nm, then a column a spectrum). Spectra of one name are references of one class. The connected regions of
    a class are listed from 0.05 cm2; the area of smaller ones counts as well."""
    classes: tuple[str, ...] = ()
    """Names of the library's spectra to use. Default: all."""
    angle_rad: float = between(1e-6, math.pi, default=paper.CLASSIFICATION_ANGLE_RAD)
    """Largest spectral angle, in radians, between a spectrum and its class."""
    roi: Annotated[tuple[tuple[str, float, float, float, float], ...], tyro.conf.UseAppendAction] = ()
    """A region of interest: its name, x, y and z of its centre and its radius in metres. Repeat the option for each
    region."""
    roi_file: Path | None = None
    """Regions that were drawn on the object in the report's 3D view and saved there (regions.json)."""
    propose_regions: bool = False
    """Write regions_proposed.json as well: stem, calyx, leaf, husk, body and other parts, by shape and spectrum. Load
    it in the report's 3D view to correct it, and give it to --roi-file."""
    index: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """An index to map and to average, by its name (docs/how-to/indices.md), or as a formula of reflectances:
    --index "CRI = 1/R510 - 1/R550". May be repeated. Default: NDVI, NDVI705 and WI, where the bands allow."""
    calibration: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """A regression or a classifier that was fitted elsewhere, for a map with means or areas
    (docs/how-to/calibrations.md): a table (CSV) of coefficients, or one that names an ONNX model. May be repeated."""
    components: int = between(0, math.inf, default=0)
    """Look for so many principal components and endmembers, or as many as the noise supports if that is fewer."""
    piece: int | None = between(1, math.inf, default=None)
    """Of several objects, measure this one alone: 1 is the largest."""

    def check(self) -> None:
        """Refuse what fits no cloud, so that nobody learns it after hours of training.

        Raises:
            InputError: an option, or a file that one names, cannot be used.
        """
        from hsi_sc_nerf.analysis.calibrations import read_calibration
        from hsi_sc_nerf.analysis.drawn_regions import read_drawn_regions
        from hsi_sc_nerf.analysis.library import read_library
        from hsi_sc_nerf.analysis.traits import RegionOfInterest
        from hsi_sc_nerf.indices.catalogue import find_index

        check_options(self)
        if self.classes and self.library is None:
            raise InputError("--classes names spectra of a library; give it with --library.")
        names = [name for name, *_ in self.roi]
        if twice := [name for name in names if names.count(name) > 1]:
            raise InputError(f"--roi gives two regions the name {twice[0]}; give each a name of its own.")
        for name, x_m, y_m, z_m, radius_m in self.roi:
            RegionOfInterest(name, (x_m, y_m, z_m), radius_m)  # which refuses what is no region
        if self.propose_regions and self.piece is not None:
            raise InputError("--propose-regions looks at clouds of one object; leave out --piece or this option.")
        if self.library:
            library = read_library(self.library)
            library.only(self.classes or library.names)
        if self.roi_file:
            read_drawn_regions(self.roi_file)
        for word in self.index:
            find_index(word)
        for path in self.calibration:
            read_calibration(path)

    def require_inputs_kept(self) -> None:
        """Refuse to write over what the command is given.

        Raises:
            InputError: a result would replace or delete a given file.
        """
        from hsi_sc_nerf.analysis.measurement_files import is_replaced

        also = [PROPOSED] if self.propose_regions else []
        also += ["endmembers.csv"] if self.components else []
        for path in (self.cloud, self.library, self.roi_file, *self.calibration):
            if path is not None and is_replaced(path, self.output_dir, also):
                raise InputError(
                    f"{path}: would be replaced by the results; copy it to another folder and name the copy, or "
                    "choose another --output-dir."
                )

    def main(self) -> None:
        """Measure and write.

        Raises:
            InputError: a file or a number cannot be used, or the results cannot be written.
        """
        from hsi_sc_nerf.analysis.drawn_regions import propose_regions, read_drawn_regions, write_drawn_regions
        from hsi_sc_nerf.analysis.library import read_library
        from hsi_sc_nerf.analysis.measured_pieces import measure_pieces, write_pieces
        from hsi_sc_nerf.analysis.measurement import on_container
        from hsi_sc_nerf.analysis.standing_pieces import standing_pieces
        from hsi_sc_nerf.export.cloud import oblique_note, read_spectral_ply
        from hsi_sc_nerf.packed.dataset import open_packed

        self.check()
        self.require_inputs_kept()
        require_writable(self.output_dir)
        library = read_library(self.library) if self.library else None
        if library is not None and self.classes:
            library = library.only(self.classes)
        cloud = read_spectral_ply(self.cloud)
        dataset = None if self.data is None else open_packed(self.data)
        if self.propose_regions and len(standing_pieces(cloud.points, on_container(self.mesh, dataset))) > 1:
            raise InputError("--propose-regions looks at clouds of one object, and this has several; leave it out.")
        measured = measure_pieces(
            cloud,
            dataset,
            mesh=self.mesh,
            splits=self.splits,
            max_incidence_deg=self.max_incidence_deg,
            library=library,
            angle_rad=self.angle_rad,
            regions={name: (x_m, y_m, z_m, radius_m) for name, x_m, y_m, z_m, radius_m in self.roi},
            drawn_regions=read_drawn_regions(self.roi_file) if self.roi_file else (),
            indices=self.index,
            calibrations=self.calibration,
            components=self.components,
            piece=self.piece,
        )
        console = Console(stderr=True)
        if note := oblique_note(cloud, self.cloud.name):
            console.print(f"[yellow]{escape(note)}", soft_wrap=True)
        with console.status("tables and pictures"):
            write_pieces(self.output_dir, measured, self.cloud.name, self.piece)
        if self.propose_regions:
            with console.status("organs"):
                proposed = propose_regions(cloud)
                write_drawn_regions(path := self.output_dir / PROPOSED, proposed)
            found = ", ".join(one.name for one in proposed)
            if len(proposed) == 1:
                found += " alone, for no end or side of the object differs from the rest in shape or spectrum"
            console.print(f"Proposed regions, to correct in the report: {found}: {escape(str(path))}", soft_wrap=True)
        console.print(f"Traits, with pictures: {escape(str(self.output_dir / 'traits.md'))}", soft_wrap=True)
