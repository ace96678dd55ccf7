"""Commands on trained runs: ``export``, ``sample``, ``render``, ``report``."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.files import require_writable, require_writable_file
from hsi_sc_nerf.packed.of_run import require_dataset_of_run
from hsi_sc_nerf.settings_file import between, check_options

if TYPE_CHECKING:
    from hsi_sc_nerf.models.trained_run import TrainedRun

_METRES = {"m": 1.0, "mm": 1e-3}


@dataclass(frozen=True)
class ExportCommand:
    """Write the spectral point cloud of a trained run, in metres, evenly spread over the object.

    Each point has a spectrum, the opacity of its ray (opacity), the ray's angle of incidence (incidence_deg), the
    number of training frames that see it (views), the standard deviation of their measurements (spectral_std), and
    the fraction of them that are saturated or without data (saturated). `ns-export pointcloud` writes the same cloud,
    with its own options.
    """

    load_config: Path
    """The config.yml of the run."""
    output_dir: Path
    """Folder to write point_cloud.ply (.las, .nc, .zarr) to."""
    options: Annotated[CloudOptions, tyro.conf.arg(name="")] = field(default_factory=CloudOptions)
    """Options of the cloud."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: the run cannot be used, an option cannot be met, or the cloud cannot be written.
        """
        require_writable(self.output_dir)
        require_dataset_of_run(self.load_config)
        from hsi_sc_nerf.export.cloud import run_name
        from hsi_sc_nerf.export.spectral_export import export_cloud
        from hsi_sc_nerf.models.trained_run import open_trained_run

        export_cloud(open_trained_run(self.load_config), self.output_dir, self.options, run_name(self.load_config))


@dataclass(frozen=True)
class SampleCommand:
    """Add spectra of a trained run to the points of any PLY file, such as a scanner's cloud or a mesh.

    The points must be in the object frame: origin where the turntable's axis meets the disc, z up along the axis.
    Content of the file is kept, but for columns that a run measured. Each point gets its reflectance in every band,
    averaged over training views, the number of these views (sampled_views) and the standard deviation over them
    (sampled_std).
    """

    points: tyro.conf.Positional[Path]
    """Point cloud or mesh (PLY)."""
    load_config: Path
    """The config.yml of a trained run."""
    output: Path | None = None
    """File to write. By default NAME-spectral.ply in the folder of the points."""
    unit: Literal["m", "mm"] = "m"
    """Unit of the coordinates in the file; they are written in the same unit."""
    max_distance_mm: float = between(0.001, 1000.0, default=3.0)
    """Largest distance of a point from the run's surface, in millimetres; points further away get no spectrum."""
    views: int = between(1, math.inf, default=4)
    """Training views to average at each point, the most frontal first. More take longer."""
    material: Path | None = None
    """The run's cloud by `hsi-sc-nerf material`: points also get the material's reflectance (material_397.32nm, ...),
    irradiance and irradiance_std. Points further than 3 mm from the cloud have NaN there."""

    def main(self, run: TrainedRun | None = None) -> None:
        """Run the command.

        Args:
            run: that of ``load_config``, where it is open already.

        Raises:
            InputError: the points or the run cannot be used, no point lies on the object, or the result cannot be
                written.
        """
        check_options(self)
        require_dataset_of_run(self.load_config)
        from hsi_sc_nerf.export.cloud import run_name
        from hsi_sc_nerf.export.cloud_material import MAX_DISTANCE_M, read_material
        from hsi_sc_nerf.export.sample_points import read_points, sample_points, write_sampled_ply
        from hsi_sc_nerf.models.trained_run import open_trained_run

        output = self.output or self.points.parent / f"{self.points.stem}-spectral.ply"
        require_writable_file(output)
        given = read_points(self.points)
        normals = given.normals()
        if run is None:
            run = open_trained_run(self.load_config)
        wavelengths_nm = run.dataset.wavelengths_nm
        material = None if self.material is None else read_material(self.material, wavelengths_nm)
        points_m = given.positions * _METRES[self.unit]
        found = sample_points(run, points_m, normals, self.max_distance_mm / 1e3, self.views)
        count, no_spectrum = len(found.views), int((found.views == 0).sum())
        if no_spectrum == count:
            raise InputError(
                f"{self.points}: none of its points lies on the object; give them in the object's frame (origin on "
                "the turntable's disc, z up), in metres or with --unit mm."
            )
        name = run_name(self.load_config)
        added = None if material is None else material.at(points_m)
        rgb_bands, metric = run.model.rgb_bands, run.dataset.metric
        write_sampled_ply(output, given, found, wavelengths_nm, rgb_bands, name, added, metric)
        console = Console(soft_wrap=True)
        if no_spectrum:
            console.print(
                f"[yellow]{no_spectrum:,} of {count:,} points have no spectrum (NaN): no training camera that "
                f"faces them sees a surface within {self.max_distance_mm:g} mm of them."
            )
        if added is not None and (unknown := int(((found.views > 0) & np.isnan(added[0]).any(axis=1)).sum())):
            console.print(
                f"[yellow]{unknown:,} of {count - no_spectrum:,} points with spectra have no known material (NaN): "
                f"they lie further than {MAX_DISTANCE_M * 1e3:g} mm from the points of {escape(str(self.material))}."
            )
        bands = len(wavelengths_nm)
        console.print(f"{escape(str(output))}: {count - no_spectrum:,} points with spectra of {bands} bands.")


@dataclass(frozen=True)
class RenderCommand:
    """Render views of a trained run as ENVI cubes of reflectance, and videos of composites and indices.

    Beside each cube NAME, NAME_valid is a map that is 1 on the object and all that turns with it, and 0 on the
    background. Held-out and training frames also get a picture of measured and rendered frame and their difference.
    """

    load_config: Path
    """The config.yml of a trained run."""
    output_dir: Path
    """Folder to write to."""
    views: Literal["held-out", "training", "orbit"] = "held-out"
    """Views to render. held-out: frames not used in training. training: frames used in training. orbit: one turn of
    the object before the session's camera."""
    camera_path: Path | None = None
    """Render these cameras instead: a path that nerfstudio's viewer exported (JSON)."""
    orbit_views: int = between(1, math.inf, default=60)
    """Number of views of an orbit."""
    orbit_size: float = between(0.01, 100.0, default=1.0)
    """Factor on the size of an orbit's images; 2 doubles the pixels in each direction."""
    cubes: Literal["float32", "uint16", "none"] = "float32"
    """Type of the numbers in the cubes. float32: reflectance. uint16: reflectance times the header's scale factor, in
    half the space. none: no cubes."""
    video: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Composite or index to make a video (MP4) of, such as CIR or NDVI, or a formula with the ends of its colours:
    --video "CRI = 1/R510 - 1/R550 [0, 15]"; may be given several times."""
    frames_per_second: int = between(1, 1000, default=15)
    """Frame rate of the videos."""
    material: Path | None = None
    """The run's cloud by `hsi-sc-nerf material`: NAME_material is a cube of the material's reflectance beside each
    cube. It has no data where a pixel shows nothing within 3 mm of the cloud."""

    def main(self, run: TrainedRun | None = None) -> None:
        """Run the command.

        Args:
            run: that of ``load_config``, where it is open already.

        Raises:
            InputError: the run, a camera path or a name cannot be used, or a result cannot be written.
        """
        check_options(self)
        if self.cubes == "none" and not self.video:
            raise InputError("--cubes none without a --video leaves nothing to do; give one of the two.")
        require_writable(self.output_dir)
        require_dataset_of_run(self.load_config)
        from hsi_sc_nerf.export.cloud_material import read_material
        from hsi_sc_nerf.files import atomic_write
        from hsi_sc_nerf.models.trained_run import open_trained_run
        from hsi_sc_nerf.rendering.pictures import compare_view, find_false_colour, open_video, write_render_report
        from hsi_sc_nerf.rendering.views import (
            render_view,
            views_of_frames,
            views_of_orbit,
            views_of_path,
            visible_points,
            write_cube_of_view,
            write_view,
        )
        from hsi_sc_nerf.spectra import to_8_bit
        from hsi_sc_nerf.terminal import progress_bar

        if run is None:
            run = open_trained_run(self.load_config)
        material = None if self.material is None else read_material(self.material, run.dataset.wavelengths_nm)
        found = [find_false_colour(name, run.dataset.wavelengths_nm) for name in self.video]
        shown = list({(item.name, item.legend): item for item in found}.values())  # a name may be given twice
        if len({item.name for item in shown}) < len(shown):
            raise InputError("two of --video have one name; give each formula a name of its own.")
        if self.camera_path is not None:
            views = views_of_path(self.camera_path)
        elif self.views == "orbit":
            views = views_of_orbit(run, self.orbit_views, self.orbit_size)
        else:
            views = views_of_frames(run, self.views)

        rows: list[dict[str, Any]] = []
        files = [self.output_dir / f"{views.kind}-{item.name.replace(' ', '-')}.mp4" for item in shown]
        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_write(*files)) if files else []
            videos = [stack.enter_context(open_video(path, self.frames_per_second)) for path in temporary]
            with progress_bar("rendering", "views", len(views.names)) as update:
                for i, (name, camera) in enumerate(views):
                    rendered = render_view(run.model, camera)
                    if self.cubes != "none":
                        write_view(self.output_dir, name, rendered, run.dataset, self.cubes)
                    if self.cubes != "none" and material is not None:
                        points_m = run.to_metres(visible_points(camera, rendered))
                        spectra = material.at(points_m.reshape(-1, 3))[0].reshape(*points_m.shape[:2], -1)
                        write_cube_of_view(self.output_dir, f"{name}_material", spectra, run.dataset, self.cubes)
                    rows.append({"view": name, "valid": float(rendered.valid.float().mean())})
                    if views.measured is not None:
                        rows[-1] |= compare_view(
                            self.output_dir, name, rendered, views.measured[i], run.model.rgb_bands
                        )
                    for item, add_frame in zip(shown, videos, strict=True):
                        add_frame(to_8_bit(item.colours(rendered).numpy()))
                    update(i + 1)
        legends = {path.name: item.legend for path, item in zip(files, shown, strict=True)}
        write_render_report(self.output_dir / "render", rows, legends)
        Console(soft_wrap=True).print(f"{len(views.names)} views: {escape(str(self.output_dir / 'render.md'))}")


@dataclass(frozen=True)
class ReportCommand:
    """Write one HTML file on a trained run: the object in 3D with its spectra, how well held-out views are rendered,
    the training, the calibration, the masks, the poses. It opens in any browser, without a network."""

    run: tyro.conf.Positional[Path]
    """Folder of the run that holds config.yml, or that file."""
    output: Path | None = None
    """The HTML file. Default: report.html in the run's folder."""
    cloud: Path | None = None
    """Point cloud (PLY) of the run. Default: point_cloud.ply in the run's folder, or, if there is none, points
    sampled from the model."""
    comparison: Path | None = None
    """comparison.json of `hsi-sc-nerf compare`. Default: the one in the run's folder."""
    traits: Path | None = None
    """traits.json of `hsi-sc-nerf traits`. Default: the one in the run's folder."""
    views: int | None = between(1, math.inf, default=None)
    """Number of held-out views to render, evenly spread. Default: all."""
    points: int = between(1, math.inf, default=50_000)
    """Number of points to show; 50 000 need about 5 MB."""
    index: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """An index to show on the object, by its name (docs/how-to/indices.md), or as a formula of reflectances. May be
    repeated. Default: those that the traits were measured with, else NDVI, NDVI705 and WI."""
    calibration: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """The table of a regression or a classifier to show on the object (docs/how-to/calibrations.md). May be
    repeated."""

    def main(self) -> None:
        """Write the report and print its path.

        Raises:
            InputError: the run, its dataset or a file given cannot be used, or the report cannot be written.
        """
        check_options(self)
        run = self.run.parent if self.run.name == "config.yml" else self.run
        output = self.output or run / "report.html"
        require_writable_file(output)
        require_dataset_of_run(run / "config.yml")
        from hsi_sc_nerf.report.build import write_report

        given = (self.cloud, self.comparison, self.traits, self.views, self.points, self.index, self.calibration)
        write_report(run, output, *given)
        size_mb = output.stat().st_size / 1e6
        Console().print(f"{escape(str(output))} ({size_mb:.1f} MB)", soft_wrap=True)
