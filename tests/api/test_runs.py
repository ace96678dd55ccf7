"""The ball whose renders are known, as a notebook opens it; each function gives what its command writes."""

import ball_run
import capture_factory as factory
import numpy as np
import pytest
import spectral
import torch
from known_ball import CENTRE_M, RADIUS, SCALE, known_run, true_spectra
from random_cloud import random_cloud

import hsi_sc_nerf as hsn
from hsi_sc_nerf.api.runs import Run
from hsi_sc_nerf.cli.trained_runs import RenderCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import read_spectral_ply
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.export.spectral_export import export_cloud
from hsi_sc_nerf.light import of_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    config = ball_run.write_untrained_run(ball_run.write_ball_dataset(folder / "data"), folder / "runs")
    opened = hsn.open_run(str(config.parent))
    ball_run.fill_with_ball(opened.trained)
    return opened


@pytest.mark.slow
def test_the_cloud_in_memory_is_the_exported_one(tmp_path):
    known = known_run(tmp_path / "ball")
    cloud = Run(known, "ball").point_cloud(500, remove_outliers=False)
    exported = read_spectral_ply(export_cloud(known, tmp_path, CloudOptions(num_points=500, remove_outliers=False)))
    np.testing.assert_array_equal(cloud.wavelengths_nm, exported.wavelengths_nm)
    for name in ("points", "normals", "colours", "spectra"):
        np.testing.assert_allclose(getattr(cloud, name), getattr(exported, name), rtol=1e-6)
    assert list(cloud.extra) == list(exported.extra)
    np.testing.assert_allclose(cloud.spectra, true_spectra((cloud.points - CENTRE_M) * SCALE), atol=0.01)
    with pytest.raises(InputError, match="num-points"):
        Run(known, "ball").point_cloud(0)
    assert pytest.approx(np.linalg.norm((cloud.points - CENTRE_M) * SCALE, axis=1), abs=0.02) == RADIUS


@pytest.mark.slow
def test_points_have_the_spectrum_of_the_ball_and_points_beside_it_none(run, monkeypatch):
    points = factory.SPHERE_CENTRE_M + factory.SPHERE_RADIUS_M * np.array([[1.0, 0, 0], [0, 1, 0], [0, 3, 0]])
    found = run.spectra_at(points, points - factory.SPHERE_CENTRE_M)
    np.testing.assert_allclose(found.spectra[:2], np.tile(factory.PLANT, (2, 1)), atol=1e-3)
    assert np.isnan(found.spectra[2]).all()
    # The gradient of a trained density is off by 10 to 30 degrees; here it is noise.
    monkeypatch.setattr(run.trained.model.field, "density_gradient", torch.randn_like)
    without_normals = run.spectra_at(points.tolist())
    np.testing.assert_allclose(without_normals.normals[:2], [[1, 0, 0], [0, 1, 0]], atol=0.04)
    assert (without_normals.normals[2] == 0).all()
    np.testing.assert_allclose(without_normals.spectra, found.spectra, atol=1e-6)
    np.testing.assert_array_equal(without_normals.views, found.views)
    for bad in ([1.0, 2.0, 3.0], [[1.0, np.nan, 0.0]], [[1.0, 2.0]]):
        with pytest.raises(InputError, match="x, y, z"):
            run.spectra_at(bad)


@pytest.mark.slow
def test_a_frame_is_rendered_as_the_command_renders_it(run, tmp_path):
    RenderCommand(tmp_path / "config.yml", tmp_path / "command").main(run.trained)
    (name,) = (path.stem for path in (tmp_path / "command").glob("ball_?.hdr"))
    view = run.render(name)
    header = view.save(tmp_path / "own")
    by_spy, by_command = (spectral.open_image(str(path)) for path in (header, tmp_path / "command" / header.name))
    np.testing.assert_array_equal(np.array(by_spy.load()), np.array(by_command.load()))
    np.testing.assert_array_equal(np.array(by_spy.load()), view.reflectance)
    ratio = view.index("x = R640 / R480")
    assert np.isnan(ratio[~view.valid]).all()
    assert np.isfinite(ratio[view.valid]).all()
    turned = run.render(angle_deg=angle_of(run, name))
    assert turned.name.startswith("angle_")
    np.testing.assert_allclose(turned.reflectance, view.reflectance, atol=1e-4)
    with pytest.raises(InputError, match="no frame pear; it has ball_0, "):
        run.render("pear")


def angle_of(run, name):
    (frame,) = (frame for frame in run.dataset.frames if frame.capture == name)
    return frame.angle_deg


@pytest.mark.slow
def test_a_cloud_gets_the_material_as_measured_where_the_light_is_even(run, monkeypatch):
    monkeypatch.setattr(of_run, "ELEMENTS", 300)
    monkeypatch.setattr(of_run, "SUPPORT_ELEMENTS", 150)
    cloud = random_cloud(wavelengths_nm=factory.WAVELENGTHS_NM)
    found = run.with_material(cloud)
    np.testing.assert_array_equal(found.material, cloud.spectra)
    np.testing.assert_array_equal(found.extra["irradiance"], 1.0)
    with pytest.raises(InputError, match="bands are not those of the run"):
        run.with_material(random_cloud())
    with pytest.raises(InputError, match=r"none\.json: cannot be read"):
        run.with_material(cloud, light="none.json")


@pytest.mark.slow
def test_what_a_notebook_shows_of_run_dataset_and_view_is_one_line(run):
    view = run.render(angle_deg=10.0)
    shown = {one: repr(one) for one in (run, run.dataset, view)}
    assert all("\n" not in text and len(text) < 400 for text in shown.values()), shown
    assert f"{len(run.dataset.frames)} frames of {run.dataset.intrinsics.w} x" in shown[run]
    assert f"{run.dataset.intrinsics.h} lines" in shown[view]


@pytest.mark.slow
def test_a_folder_without_a_run_is_one_sentence_that_names_a_run_below_it(run, tmp_path):
    for path in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match=path.name):
            hsn.open_run(path)
    folder = run.dataset.root.parent / "runs"
    (config,) = folder.rglob("config.yml")
    with pytest.raises(InputError, match=f"give {config.parent}"):
        hsn.open_run(folder)
