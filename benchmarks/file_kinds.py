"""Kinds of files that this package reads, and how its commands read each."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from valid_files import write_valid_files

_OF_AN_OBJECT = ("steps/train.json", "eval.json", "traits/traits.json", "inspection.json")


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        name: in the table.
        path: a valid file, which is damaged.
        read: reads it as a command does.
        weight: fraction of all inputs, relative to others: slow readers get fewer.
        same_length: bytes are replaced and no more, where a file that states its length is refused for another one.
    """

    name: str
    path: Path
    read: Callable[[], object]
    weight: float = 1.0
    same_length: bool = False


def kinds(folder: Path) -> list[Kind]:
    """Valid files of every kind under ``folder``, and how each is read."""
    from hsi_sc_nerf.analysis.calibrations import read_calibration
    from hsi_sc_nerf.analysis.drawn_regions import read_drawn_regions
    from hsi_sc_nerf.analysis.library import read_library
    from hsi_sc_nerf.analysis.size import scale_uncertainty
    from hsi_sc_nerf.api.clouds import read_cloud
    from hsi_sc_nerf.batch.objects import read_objects
    from hsi_sc_nerf.batch.plan import outdated, read_plan
    from hsi_sc_nerf.batch.session_steps import SessionSettings, is_up_to_date, session_steps
    from hsi_sc_nerf.batch.tables import read_table
    from hsi_sc_nerf.calibration.white_source import read_panel
    from hsi_sc_nerf.capture.envi import CubeLines, open_cube
    from hsi_sc_nerf.capture.instrument import read_metadata
    from hsi_sc_nerf.capture.session import open_session
    from hsi_sc_nerf.capture.session_info import read_band_centres
    from hsi_sc_nerf.evaluation.comparison import read_surface
    from hsi_sc_nerf.export.cloud import read_spectral_ply
    from hsi_sc_nerf.export.sample_points import read_points
    from hsi_sc_nerf.light.known_light import read_light
    from hsi_sc_nerf.models.checkpoints import read_checkpoint
    from hsi_sc_nerf.models.run_settings import read_config
    from hsi_sc_nerf.packed.dataset import open_packed
    from hsi_sc_nerf.processing.frames import FramePaths, read_cache
    from hsi_sc_nerf.rendering.views import views_of_path
    from hsi_sc_nerf.report.dataset_sections import calibration_section, inspection_section, poses_section
    from hsi_sc_nerf.report.run_sections import comparison_section, read_scalars, traits_section
    from hsi_sc_nerf.settings_file import read_yaml
    from hsi_sc_nerf.simulate.materials import read_spectrum
    from hsi_sc_nerf.simulate.own_mesh import load as load_mesh
    from hsi_sc_nerf.simulate.scene import OwnMesh, load_scene
    from hsi_sc_nerf.simulate.truth import load_truth

    files = write_valid_files(folder)
    session, data, run = folder / "session", folder / "data", folder / "run"

    def every_line(header: Path) -> None:
        with CubeLines(open_cube(header)) as lines:
            for line in range(lines.shape[0]):
                lines[line]

    def frame_of(use: Callable[[Any], object]) -> Callable[[], object]:
        return lambda: use(open_packed(data).frames[0])

    def every_point(path: Path) -> None:
        read_points(path)
        read_surface(path)
        read_spectral_ply(path)

    def judged(section: Callable[[Any], object]) -> Callable[[], object]:
        dataset = open_packed(data)
        return lambda: section(dataset)

    def every_object() -> None:
        outdated(read_plan(files["season"]), retry=True)
        read_objects(pear)
        read_table(files["season"])

    def every_truth() -> None:
        truth = load_truth(session)
        truth.reflectance(truth.captures[0])
        truth.object_coverage(truth.captures[0])
        truth.light(truth.captures[0]).radiance()
        truth.detector_maps()

    def every_truth_of_array() -> None:
        """The array in a new archive, whose checksums fit."""
        whole = pixels.read_bytes()
        with zipfile.ZipFile(pixels, "w") as archive:
            archive.write(files["npy"], "material_weights.npy")
        try:
            truth = load_truth(session)
            truth.reflectance(truth.captures[0])
        finally:
            pixels.write_bytes(whole)

    def every_step() -> None:
        for step in session_steps(session, folder, SessionSettings()):
            is_up_to_date(step, folder)

    def taken(light: Path) -> None:
        known = read_light(light)
        known.at(known.centre_m + 0.01, known.wavelengths_nm)

    def applied(table: Path) -> Callable[[], object]:
        return lambda: read_calibration(table).of(np.full((2, 31), 0.5), np.linspace(400.0, 1000.0, 31), True)

    pear, pixels = files["season"] / "objects" / "pear", session / "truth" / "pixels" / "sphere_000.npz"
    first = session / "sphere_000" / "capture" / "sphere_000.hdr"
    nm = open_cube(first).wavelengths_nm
    note = FramePaths.of(data, "ball_0")
    return [
        Kind("ENVI header", first, lambda: every_line(first), 3.0),
        Kind("ENVI header, in a session", first, lambda: open_session(session), 1.0),
        Kind("ENVI cube", first.with_suffix(".raw"), lambda: every_line(first)),
        Kind("session.json", session / "session.json", lambda: open_session(session), 1.5),
        Kind("metadata (XML)", files["xml"], lambda: read_metadata(files["xml"]), 3.0),
        Kind("band centres (CSV)", files["bands"], lambda: read_band_centres(files["bands"]), 1.5),
        Kind("panel (CSV)", files["panel"], lambda: read_panel(files["panel"], nm), 1.5),
        Kind("truth.json", session / "truth" / "truth.json", lambda: load_truth(session)),
        Kind("transforms.json", data / "transforms.json", frame_of(lambda frame: frame.cube()), 3.0),
        Kind("picture (PNG)", data / "images" / "ball_0.png", frame_of(lambda frame: frame.pseudo_rgb())),
        Kind("mask (PNG)", data / "masks" / "ball_0.png", frame_of(lambda frame: frame.mask())),
        Kind("note of a resume", note.cache, lambda: read_cache(note, "made"), 2.0),
        Kind("bins of a resume", note.bins, lambda: read_cache(note, "made"), 0.5),
        Kind("point cloud (binary PLY)", files["binary"], lambda: every_point(files["binary"]), 3.0),
        Kind("point cloud (ASCII PLY)", files["ascii"], lambda: every_point(files["ascii"]), 2.0),
        Kind("point cloud (NetCDF)", files["netcdf"], lambda: read_cloud(files["netcdf"]), 0.5),
        Kind("point cloud (NetCDF), old", files["old"], lambda: read_cloud(files["old"]), 0.5, same_length=True),
        *(
            Kind(f"point cloud (Zarr: {at})", files["zarr"] / at, lambda: read_cloud(files["zarr"]), 0.3)
            for at in ("zarr.json", "reflectance/zarr.json", "reflectance/c/0/0")
        ),
        *(Kind(f"mesh ({s.upper()})", files[s], lambda s=s: read_surface(files[s]), 0.5) for s in ("obj", "stl")),
        *(
            Kind(
                f"own mesh ({s.upper()})", files[s], lambda s=s: load_mesh(OwnMesh("mesh", files[s], ("skin",))), 0.3
            )
            for s in ("ply", "glb")
        ),
        Kind("spectral library (header)", files["library"], lambda: read_library(files["library"]), 2.0),
        Kind("spectral library (data)", files["sli"], lambda: read_library(files["library"]), 0.5),
        Kind("spectral library (CSV)", files["csv"], lambda: read_library(files["csv"]).at(nm), 1.5),
        Kind("scene (YAML)", files["scene"], lambda: load_scene(files["scene"]), 0.7),
        Kind("effects (YAML)", files["effects"], lambda: read_yaml(files["effects"].read_text("latin-1"), "e"), 0.5),
        Kind("config.yml", run / "config.yml", lambda: read_config(run / "config.yml"), 0.05),
        Kind("checkpoint", files["checkpoint"], lambda: read_checkpoint(files["checkpoint"]), 0.5),
        Kind("camera path (JSON)", files["path"], lambda: views_of_path(files["path"]), 1.5),
        Kind("calibration.json", data / "calibration.json", judged(calibration_section), 0.02),
        Kind("poses.json", data / "poses.json", judged(poses_section), 0.02),
        Kind("poses.json, for sizes", data / "poses.json", lambda: scale_uncertainty(data / "poses.json"), 0.5),
        Kind("steps of a run", files["steps"], every_step, 0.5),
        Kind("training curves (tfevents)", files["events"], lambda: read_scalars(files["events"].parent), 0.3),
        Kind("inspection.json", data / "report" / "inspection.json", judged(inspection_section), 1.0),
        Kind("comparison.json", files["comparison"], lambda: comparison_section(*_json(files["comparison"])), 0.02),
        Kind("list of sessions (CSV)", files["season"] / "sessions.csv", every_object, 0.5),
        Kind("settings of a batch", files["season"] / "settings.json", every_object, 0.5),
        *(Kind(f"batch: {at}", pear / at, every_object, 0.5) for at in _OF_AN_OBJECT),
        Kind("calibration (CSV)", files["calibration"], applied(files["calibration"]), 1.5),
        Kind("calibration (ONNX)", files["onnx"], applied(files["onnx"].with_name("model.csv")), 0.5),
        Kind("light (JSON)", files["light"], lambda: taken(files["light"]), 1.0),
        Kind("drawn regions (JSON)", files["regions"], lambda: read_drawn_regions(files["regions"]), 1.0),
        Kind("truth's pixels (NPZ)", pixels, every_truth),
        Kind("truth's pixels (array in NPZ)", files["npy"], every_truth_of_array),
        Kind("truth's detector (NPZ)", session / "truth" / "detector.npz", every_truth, 0.5),
        Kind("truth's spectra (CSV)", session / "truth" / "endmembers.csv", every_truth),
        Kind("material's spectrum (CSV)", files["spectrum"], lambda: read_spectrum(files["spectrum"])),
        Kind("traits.json", files["traits"], lambda: traits_section(*_json(files["traits"])), 1.5),
    ]


def _json(path: Path) -> tuple[dict[str, Any] | None, Path]:
    from hsi_sc_nerf.report.page import read_known

    return read_known(path), path
