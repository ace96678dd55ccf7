"""The command ``change``: an object over days."""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import track

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.closed_mesh import MeshConfig
from hsi_sc_nerf.analysis.standing_pieces import one_piece
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import MAX_INCIDENCE_DEG, SpectralCloud, oblique_note, read_spectral_ply, run_name
from hsi_sc_nerf.files import require_writable
from hsi_sc_nerf.settings_file import between, check_options

CONFIG = "config.yml"
CLOUDS = ("point_cloud-material.ply", "point_cloud.ply")
"""Names of a day's cloud in its folder; the first that is there is taken."""
POINTS = 200_000
"""Of the cloud of a run that has none: as many as `run` exports."""


@dataclass(frozen=True)
class ChangeCommand:
    """Find what changed on an object between days, beyond noise: spectra, indices, classes, and the surface.

    The object may have been set down turned and tipped, may have grown a little and lost its stem. Writes change.md
    (start here), change.json, change.csv, change.ply, pictures, and the days as a film.
    """

    clouds: tyro.conf.Positional[tuple[Path, ...]]
    """The days in their order, the first one before the others: spectral point clouds (PLY, metres), folders of
    `hsi-sc-nerf run`, or trained runs (their folder or its config.yml). Of a folder its point_cloud-material.ply is
    taken, else its point_cloud.ply; a run with neither is sampled at 200 000 points."""
    output_dir: Path
    """Folder to write the results to."""
    mesh: MeshConfig = field(default_factory=MeshConfig)
    """Settings of the mesh, which is made from the first day."""
    repeat: Path | None = None
    """Another capture of the first day, for which the object was set down anew: a cloud, folder or run as for the
    days. It tells what setting down, poses and lamps alone make of the object; what is no larger is no change."""
    band_nm: tuple[float, ...] = between(1.0, 1e5, default=())
    """Wavelengths (nm) whose reflectance is compared, beside spectra and indices."""
    index: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """An index to compare, by its name or as a formula, as for `hsi-sc-nerf traits`. May be repeated. Default: NDVI,
    NDVI705 and WI, where the bands allow."""
    session_std: float = between(0.0, 1.0, default=0.01)
    """How much the white references of two sessions may differ, as a fraction (0.01 is 1 %). Without --repeat it
    concerns only the row 'whole surface'; with --repeat an area must also have changed by more than this."""
    piece: tuple[int, ...] = between(1, math.inf, default=())
    """Where several objects stand on the table, which of them: one number for all clouds, or one for each, a repeat
    last. 1 is the largest, as for `hsi-sc-nerf traits`, which tells where each stands."""
    max_incidence_deg: float = between(1.0, 90.0, default=MAX_INCIDENCE_DEG)
    """Spectra come only from points that a camera sees at an incidence angle of at most this many degrees."""
    library: Path | None = None
    """Reference spectra to classify the surface by, as for `hsi-sc-nerf traits`: ENVI library (.sli) or CSV. Regions
    below 0.05 cm2 are left out."""
    angle_rad: float = between(1e-6, math.pi, default=paper.CLASSIFICATION_ANGLE_RAD)
    """Largest spectral angle, in radians, between a spectrum and the mixture of its classes."""

    def main(self) -> None:
        """Compare and write.

        Raises:
            InputError: a file or a number cannot be used, a day cannot be registered, or the results cannot be
                written.
        """
        from hsi_sc_nerf.analysis import change_pictures, change_report
        from hsi_sc_nerf.analysis.change import compare_days
        from hsi_sc_nerf.analysis.change_days import days_on_one_mesh
        from hsi_sc_nerf.analysis.change_maps import BRIGHTNESS, CLASSES, SPECTRUM, require_own_names
        from hsi_sc_nerf.analysis.library import read_library
        from hsi_sc_nerf.analysis.measurement import class_references
        from hsi_sc_nerf.analysis.pictures import SideViews
        from hsi_sc_nerf.indices.catalogue import find_indices

        check_options(self)
        if len(self.clouds) < 2:
            raise InputError("a change needs two clouds or more; give the one before and those after.")
        require_writable(self.output_dir)
        library = read_library(self.library) if self.library else None
        paths = [*self.clouds, self.repeat] if self.repeat else [*self.clouds]
        files = [_file_of(path) for path in paths]
        names = [f"{day} {name}" for day, name in enumerate(_day_names(self.clouds), start=1)]
        if self.repeat:
            names.append(f"repeat {_day_name(self.repeat)}")
        _require_others(names, files, lambda one, other: bool(one.resolve() == other.resolve()))
        if len(self.piece) not in (0, 1, len(files)):
            raise InputError(f"--piece has {len(self.piece)} numbers; give one for all clouds, or {len(files)}.")
        console = Console(stderr=True)
        clouds = [_read(path) for path in track(files, "Reading", console=console, transient=True)]
        _require_others(names, clouds, lambda one, other: np.array_equal(one.points, other.points))
        for name, cloud in zip(names, clouds, strict=True):
            if note := oblique_note(cloud, name):
                console.print(f"[yellow]{escape(note)}", soft_wrap=True)
        clouds = _pieces(clouds, names, self.piece or (None,), self.mesh)
        indices = find_indices(self.index, clouds[0].wavelengths_nm)
        require_own_names(self.band_nm, indices)
        if library is not None:
            library = class_references(library, clouds[0].wavelengths_nm)
        days = days_on_one_mesh(
            clouds,
            names,
            self.mesh,
            self.max_incidence_deg,
            lambda starts: track(starts, "Registering", console=console, transient=True),
        )
        repeat = days.pop() if self.repeat else None
        compared = compare_days(days, self.band_nm, indices, self.session_std, library, self.angle_rad, repeat)
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
        for day, one in enumerate(comparisons if library is not None else (), 1):
            file = f"{CLASSES}_{day}.png"
            change_pictures.draw_class_change(self.output_dir / file, days[0], one, views)
            pictures[f"Classes, {one.after.name}"] = file
        with console.status("film and tables"):
            shown = SPECTRUM if SPECTRUM in comparisons[0].quantities else BRIGHTNESS
            film = self.output_dir / "change.mp4"
            change_pictures.write_film(film, days[0], comparisons, views, shown)
            change_report.write_change_ply(self.output_dir / "change.ply", days[0], comparisons)
            settings = {"band_nm": list(self.band_nm), "session_std": self.session_std, **asdict(self.mesh)}
            settings |= {"max_incidence_deg": self.max_incidence_deg, "angle_rad": self.angle_rad}
            settings |= {"library": None if self.library is None else str(self.library)}
            settings |= {"index": [index.definition for index in indices], "piece": list(self.piece)}
            change_report.write_change_tables(self.output_dir, comparisons, settings, pictures, repeat)
        page = escape(str(self.output_dir / "change.md"))
        console.print(f"Changes, with pictures: {page}", soft_wrap=True)


def _file_of(path: Path) -> Path:
    """A day's cloud; that of the material, if there is one; the config.yml of a run that has none."""
    folder = path.parent if path.name == CONFIG else path
    if not folder.is_dir():
        return path
    for name in (*CLOUDS, CONFIG):
        if (folder / name).is_file():
            return folder / name
    raise InputError(f"{path}: holds no point_cloud.ply and no config.yml; give a cloud, or a folder of a run.")


def _require_others(names: Sequence[str], given: Sequence[Any], are_same: Callable[[Any, Any], bool]) -> None:
    """Refuse what is given twice, for nothing can have changed."""
    for (name, one), (other_name, other) in itertools.combinations(zip(names, given, strict=True), 2):
        if are_same(one, other):
            raise InputError(
                f"{other_name} is the same cloud as {name}, so nothing can have changed; give each day and --repeat "
                "a capture of its own."
            )


def _pieces(
    clouds: Sequence[SpectralCloud], names: Sequence[str], pieces: Sequence[int | None], mesh: MeshConfig
) -> list[SpectralCloud]:
    """Of each cloud the object of a number, or its only one."""
    chosen = []
    for cloud, name, piece in zip(clouds, names, itertools.cycle(pieces), strict=False):
        try:
            chosen.append(one_piece(cloud, piece, mesh))
        except InputError as error:
            raise InputError(f"{name}: {error}") from error
    return chosen


def _read(path: Path) -> SpectralCloud:
    """A cloud, exported from the run if it is a config.yml; the run's folder stays as it is."""
    if path.name != CONFIG:
        return read_spectral_ply(path)
    # Slow to import.
    from hsi_sc_nerf.export.options import CloudOptions
    from hsi_sc_nerf.export.spectral_export import export_cloud
    from hsi_sc_nerf.models.trained_run import open_trained_run

    with tempfile.TemporaryDirectory() as folder:
        return read_spectral_ply(export_cloud(open_trained_run(path), Path(folder), CloudOptions(num_points=POINTS)))


def _day_names(paths: Sequence[Path]) -> list[str]:
    """Names of the days; where all have the same file, those of the nearest folders that differ."""
    names = [_day_name(path) for path in paths]
    if len(set(names)) > 1:
        return names
    folders = [(path.parent if path.name == CONFIG else path).resolve().with_suffix("").parts for path in paths]
    levels = zip(*map(reversed, folders), strict=False)
    return next(([*level] for level in levels if len(set(level)) > 1), names)


def _day_name(path: Path) -> str:
    """The run, its folder, or the file without its suffix."""
    config = path if path.name == CONFIG else path / CONFIG
    return run_name(config) if config.is_file() else path.resolve().name if path.is_dir() else path.stem
