"""Collect and write the report of a run."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hsi_sc_nerf.analysis.calibrations import Calibration, read_calibration
from hsi_sc_nerf.analysis.drawn_regions import PAGE_POINTS, points_of_page
from hsi_sc_nerf.analysis.report import each_object
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import INCIDENCE, MAX_INCIDENCE_DEG, SpectralCloud, read_spectral_ply
from hsi_sc_nerf.files import atomic_write, content_of
from hsi_sc_nerf.findings import Finding, judged
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.report.cloud import cloud_payload, compress_spectra
from hsi_sc_nerf.report.dataset_sections import (
    calibration_section,
    effects_section,
    inspection_section,
    masks_section,
    poses_section,
)
from hsi_sc_nerf.report.held_out_views import render_held_out
from hsi_sc_nerf.report.page import Block, CloudViewer, Section, Table, html_page, read_known
from hsi_sc_nerf.report.run_sections import (
    comparison_key_figure,
    comparison_section,
    flat_settings,
    read_scalars,
    settings_section,
    stage_ends,
    training_section,
    traits_section,
)
from hsi_sc_nerf.report.view_sections import (
    bands_section,
    metric_key_figures,
    spectra_section,
    views_section,
    white_of,
)

if TYPE_CHECKING:
    from hsi_sc_nerf.models.trained_run import TrainedRun

_OBLIQUE_FRACTION = 0.1


def write_report(
    folder: Path,
    output: Path,
    cloud: Path | None = None,
    comparison: Path | None = None,
    traits: Path | None = None,
    views: int | None = None,
    points: int = PAGE_POINTS,
    indices: Sequence[str] = (),
    calibrations: Sequence[Path] = (),
) -> None:
    """Write the report of the run in ``folder``, completely or not at all.

    Args:
        cloud: PLY of the run; None: ``point_cloud.ply`` in the run's folder, or else the surface is sampled.
        comparison: ``comparison.json``; None: the one in the run's folder, if there is one.
        traits: ``traits.json``; likewise.
        views: how many held-out views to render, at least 1; None for all.
        points: how many points of the cloud to show, at least 1.
        indices: to show on it, as `find_indices` reads them; none: those that the traits were measured with.
        calibrations: tables (`read_calibration`) to show on it.

    Raises:
        InputError: the run, its dataset or a file given cannot be used, or the report cannot be written.

    Example:
        >>> write_report(Path("outputs/pear/hsi-sc-nerf/run"), Path("report.html"), views=4)
    """
    if (views is not None and views < 1) or points < 1:
        raise InputError("--views and --points must be at least 1.")
    # Before the slow rendering, so that unusable files are refused at once.
    comparison_path = _given_or_beside(comparison, folder / "comparison.json", "hsi-sc-nerf compare")
    traits_path = _given_or_beside(traits, folder / "traits.json", "hsi-sc-nerf traits")
    compared, measured = read_known(comparison_path), read_known(traits_path)
    results = [comparison_section(compared, comparison_path), traits_section(measured, traits_path)]
    with content_of(traits_path, "traits"):
        indices = [*indices] or [str(word) for word in each_object(measured or {})[0].get("indices", ())]
    read = [read_calibration(path) for path in calibrations]

    from hsi_sc_nerf.models.trained_run import open_trained_run

    run = open_trained_run(folder / "config.yml")
    shown = object_section(_cloud(run, folder, cloud, points), points, indices, read)
    rendered, held_out, dataset = [*render_held_out(run, views)], len(run.manager.eval_dataset), run.dataset
    scores, white = [view.scores for view in rendered], white_of(rendered)
    sections = [
        *inspection_section(dataset),
        shown,
        views_section(rendered, held_out, white),
        bands_section(scores, dataset.wavelengths_nm, dataset.typical_uncertainty),
        spectra_section(rendered[len(rendered) // 2], dataset.wavelengths_nm, white),
        *results,
        training_section(read_scalars(folder), stage_ends(folder)),
        calibration_section(dataset),
        *effects_section(dataset),
        masks_section(dataset),
        poses_section(dataset),
        _settings(folder),
    ]
    key_figures = metric_key_figures(scores) | _reprojection_error(dataset)
    if compared is not None:
        key_figures |= comparison_key_figure(compared)
    title = f"{dataset.object_name}: hyperspectral 3D reconstruction"
    page = html_page(title, _subtitle(dataset, output), key_figures, sections)
    with atomic_write(output) as (temporary,):
        temporary.write_text(page, encoding="utf-8")


def object_section(
    cloud: SpectralCloud, points: int, indices: Sequence[str] = (), calibrations: Sequence[Calibration] = ()
) -> Section:
    """The cloud in 3D, thinned to ``points``, with indices and calibrations."""
    shown = points_of_page(cloud, points)
    spectra = compress_spectra(shown.spectra)
    caption = (
        f"{len(shown.points)} of {len(cloud.points)} points. Spectra are kept as {len(spectra.basis)} components, "
        f"which changes reflectance by {spectra.rmse:.5f} (root mean square; at most {spectra.largest_error:.3f})."
    )
    if not cloud.metric:
        caption += " Lengths and areas are wrong: nothing gave the scale, and 1 m is the camera's distance."
    payload = cloud_payload(shown, spectra, indices, calibrations)
    blocks: list[Block] = [CloudViewer(payload, caption), *_class_tables(payload["classifiers"])]
    return Section("object", "The object", blocks, judge_cloud(cloud))


def _class_tables(classifiers: Sequence[Mapping[str, Any]]) -> list[Table]:
    """Areas of the classes on the points that the page shows."""
    rows = [
        [one["name"], label, f"{area:.2f}", f"{area / max(sum(one['areas_cm2']), 1e-12):.1%}"]
        for one in classifiers
        for label, area in zip((*one["classes"], one["rest"]), one["areas_cm2"], strict=True)
    ]
    caption = (
        "Area of the points whose most probable class is each. hsi-sc-nerf traits --calibration measures them on the "
        "closed surface, region by region, with their uncertainty."
    )
    return [Table(caption, ["classifier", "class", "area, cm²", "part of the points' surface"], rows)] if rows else []


def judge_cloud(cloud: SpectralCloud) -> list[Finding]:
    """How much of the surface was seen only obliquely; nothing without that column."""
    if INCIDENCE not in cloud.extra:
        return []
    fraction = float(np.mean(cloud.extra[INCIDENCE] > MAX_INCIDENCE_DEG))
    sentence = (
        f"{100.0 * fraction:.1f} % of the points are seen at more than {MAX_INCIDENCE_DEG:g}° from the front (good "
        f"up to {100.0 * _OBLIQUE_FRACTION:.0f} %)"
    )
    advice = f"show the column {INCIDENCE} to see where their spectra are mixed"
    return [judged("oblique", fraction, (_OBLIQUE_FRACTION, np.inf), sentence, advice)]


def _given_or_beside(given: Path | None, beside: Path, command: str) -> Path:
    """The given file, or else the one in the run's folder, which need not exist."""
    if given is not None and not given.is_file():
        raise InputError(f"{given}: there is no such file; make it with `{command}`.")
    return given or beside


def _cloud(run: TrainedRun, folder: Path, given: Path | None, points: int) -> SpectralCloud:
    path = given or folder / "point_cloud.ply"
    if given is not None or path.is_file():  # a copy by another program does not say that it has no scale
        return replace(read_spectral_ply(path), metric=run.dataset.metric)
    from hsi_sc_nerf.export.options import CloudOptions
    from hsi_sc_nerf.export.spectral_export import export_cloud

    with tempfile.TemporaryDirectory() as temporary:
        return read_spectral_ply(export_cloud(run, Path(temporary), CloudOptions(num_points=points)))


def _subtitle(dataset: PackedDataset, output: Path) -> str:
    """Size of the dataset and its name: where it lies seen from the report, or that of its folder alone."""
    root, beside = dataset.root.resolve(), output.resolve().parent
    name = root.relative_to(beside).as_posix() if root.is_relative_to(beside) else root.name
    low, high = dataset.wavelengths_nm.min(), dataset.wavelengths_nm.max()
    return f"{len(dataset.frames)} frames of {dataset.intrinsics.w} x {dataset.intrinsics.h} pixels, " + (
        f"{len(dataset.wavelengths_nm)} bands from {low:.0f} to {high:.0f} nm, dataset {name}"
    )


def _reprojection_error(dataset: PackedDataset) -> dict[str, str]:
    errors = [e for frame in dataset.frames if (e := frame.reprojection_error_px) is not None]
    return {"reprojection error": f"{np.sqrt(np.mean(np.square(errors))):.3f} px"} if errors else {}


def _settings(folder: Path) -> Section:
    from nerfstudio.configs.method_configs import all_methods

    from hsi_sc_nerf.benchmark.steps import describe_machine
    from hsi_sc_nerf.models.run_settings import read_config

    config = read_config(folder / "config.yml")
    # A run may have a name of its own (--method-name); then every setting is shown.
    method = all_methods.get(config.method_name or "")
    defaults = {} if method is None else flat_settings(method)
    return settings_section(flat_settings(config), defaults, describe_machine())
