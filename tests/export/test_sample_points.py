import shutil
from dataclasses import replace
from pathlib import Path

import ball_run
import capture_factory as factory
import numpy as np
import pytest
import torch
import yaml
from plyfile import PlyData, PlyElement
from random_cloud import random_cloud

from hsi_sc_nerf.cli.trained_runs import SampleCommand
from hsi_sc_nerf.data.dataparser import split_frames
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.comparison import read_surface
from hsi_sc_nerf.export.cloud import (
    INCIDENCE,
    LIGHT_COLUMNS,
    band_property_names,
    material_spectra,
    read_spectral_ply,
    stream,
    write_spectral_ply,
)
from hsi_sc_nerf.export.sample_points import (
    PointSpectra,
    first_hits,
    frontal_views,
    outward_normals,
    read_points,
    write_sampled_ply,
)
from hsi_sc_nerf.models.trained_run import open_trained_run


def test_frontal_views_are_the_largest_cosines_in_the_frame():
    cosines = np.array([[0.9, 0.5, 0.99, 0.7], [0.3, 0.2, 0.1, -1.0], [0.6, 0.6, 0.6, 0.6]])
    in_frame = np.array([[True, True, False, True], [True, True, True, True], [False, False, False, False]])
    cameras, faced = frontal_views(cosines, in_frame)
    assert [row[mask].tolist() for row, mask in zip(cameras, faced, strict=True)] == [[0, 3, 1], [], []]


@pytest.mark.parametrize("count", [1, 3, 7])
def test_a_camera_that_an_occluder_hides_is_replaced_by_the_next(count):
    rng, asked = np.random.default_rng(0), []
    faced = np.arange(12) < rng.integers(0, 13, (40, 1))
    sees = rng.random((40, 12)) < 0.5

    def render(point, rank):
        asked.extend(zip(point.tolist(), rank.tolist(), strict=True))
        return np.where(sees[point, rank], rank, np.nan)[:, None]

    spectra = first_hits(faced, count, render, bands=1)[..., 0]
    for point, row in enumerate(spectra):
        expected = np.flatnonzero(faced[point] & sees[point])[:count]
        np.testing.assert_array_equal(row[np.isfinite(row)], expected)
        ranks = [rank for other, rank in asked if other == point]
        last = expected[-1] + 1 if len(expected) == count else faced[point].sum()
        assert ranks == list(range(last))  # no camera twice, and none after enough see it


def test_normals_turn_to_the_side_of_lower_density():
    points = np.random.default_rng(0).normal(size=(20, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    signs = np.where(np.arange(20) % 2, 1.0, -1.0)[:, None]

    def ball(positions):
        return (np.linalg.norm(positions, axis=-1, keepdims=True) < 1.0).astype(float)

    np.testing.assert_array_equal(outward_normals(signs * points, points, ball, 0.1), points)
    np.testing.assert_array_equal(outward_normals(signs * points, 9.0 * points, ball, 0.1), signs * points)


@pytest.fixture(scope="module")
def run_config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    return ball_run.write_untrained_run(ball_run.write_ball_dataset(folder / "data"), folder / "runs")


@pytest.fixture(scope="module")
def run(run_config):
    opened = open_trained_run(run_config)
    ball_run.fill_with_ball(opened)
    return opened


@pytest.fixture
def sample(run):
    def sample(path, **options):
        SampleCommand(path, load_config=Path("runs/ball/now/config.yml"), **options).main(run)
        return path.with_name(f"{path.stem}-spectral.ply")

    return sample


def sphere_mesh(path, *, scale=1.0, binary=False, radius_m=factory.SPHERE_RADIUS_M, normals_sign=None):
    """A sphere of triangles with a property of its own, and its radial directions."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=2)
    columns = dict(zip("xyz", (scale * (factory.SPHERE_CENTRE_M + radius_m * mesh.vertices)).T, strict=True))
    if normals_sign is not None:
        columns |= dict(zip(("nx", "ny", "nz"), normals_sign * mesh.vertices.T, strict=True))
    columns |= {"quality": np.arange(len(mesh.vertices), dtype=np.int32)}
    vertices = np.rec.fromarrays(list(columns.values()), names=list(columns))
    faces = np.array([(face,) for face in mesh.faces.tolist()], [("vertex_indices", "O")])
    described = PlyElement.describe(faces, "face", len_types={"vertex_indices": "u1"})
    PlyData([PlyElement.describe(vertices, "vertex"), described], text=not binary).write(str(path))
    return np.asarray(mesh.vertices)


def test_a_ball_gives_its_spectrum_where_cameras_see_it(tmp_path, sample, capsys):
    path = tmp_path / "ball.ply"
    radial = sphere_mesh(path)
    written = sample(path)
    cloud = read_spectral_ply(written)
    given, after = PlyData.read(str(path)), PlyData.read(str(written))
    for name in ("x", "y", "z", "quality"):
        np.testing.assert_array_equal(after["vertex"][name], given["vertex"][name])
    assert [list(f) for f in after["face"]["vertex_indices"]] == [list(f) for f in given["face"]["vertex_indices"]]
    np.testing.assert_allclose(cloud.wavelengths_nm, factory.WAVELENGTHS_NM, atol=0.01)
    assert "run: runs/ball/now" in after.comments
    assert any(line.startswith("sampled_std [1]: ") for line in after.comments)
    assert not any("position" in line for line in after.comments)  # in the file's own unit
    np.testing.assert_allclose((cloud.normals * radial).sum(axis=1), 1.0, atol=1e-3)

    poses = np.stack([factory.true_pose(ball_run.ANGLES_DEG[frame]) for frame in split_frames(10, 0.9)[0]])
    points = factory.SPHERE_CENTRE_M + factory.SPHERE_RADIUS_M * radial
    towards = poses[:, :3, 3] - points[:, None]
    incidence_deg = np.rad2deg(
        np.arccos(np.einsum("nk,nck->nc", radial, towards) / np.linalg.norm(towards, axis=-1)).min(axis=1)
    )
    seen = np.isfinite(cloud.spectra).all(axis=1)
    assert seen[incidence_deg < 65.0].all()
    assert not seen[incidence_deg > 75.0].any()
    np.testing.assert_array_equal(seen, np.isfinite(cloud.spectra).any(axis=1))
    np.testing.assert_array_equal(seen, cloud.extra["sampled_views"] > 0)
    assert cloud.extra["sampled_views"].max() == 4
    np.testing.assert_allclose(cloud.spectra[seen], np.broadcast_to(factory.PLANT, (seen.sum(), 12)), atol=1e-3)
    assert np.nanmax(cloud.extra["sampled_std"]) < 1e-3
    assert (cloud.colours[~seen] == 64).all()
    assert np.abs(cloud.colours[seen] - 255.0 * factory.PLANT[[5, 3, 1]]).max() <= 1.0
    assert f"{(~seen).sum()} of {len(seen)} points have no spectrum" in " ".join(capsys.readouterr().out.split())


def test_points_get_the_material_of_the_cloud_that_tells_it(tmp_path, sample, capsys):
    path, far = tmp_path / "ball.ply", tmp_path / "far.ply"
    sphere_mesh(path)
    material = factory.PLANT / 0.8
    known = ball_run.write_material_cloud(tmp_path / "material.ply", material)
    cloud = read_spectral_ply(sample(path, material=known))
    found = material_spectra(cloud)
    np.testing.assert_allclose(found, np.broadcast_to(material, found.shape), rtol=1e-5)
    seen = np.isfinite(cloud.spectra).all(axis=1)
    # Irradiance is that of the spectra beside it: as measured over the material's.
    np.testing.assert_allclose(cloud.extra["irradiance"][seen], 0.8, atol=0.01)
    np.testing.assert_allclose(cloud.extra["irradiance_std"][seen], 0.05 * 0.8, rtol=0.02)
    sphere_mesh(far, radius_m=factory.SPHERE_RADIUS_M + 0.0045)
    beyond = read_spectral_ply(sample(far, material=known, max_distance_mm=6.0))
    assert np.isnan(material_spectra(beyond)).all()
    seen = np.isfinite(beyond.spectra).all(axis=1)
    assert seen.any()
    told = " ".join(capsys.readouterr().out.split())
    assert told.count("no known material") == 1  # of the cloud on the surface nothing is said
    assert f"{seen.sum():,} of {seen.sum():,} points with spectra have no known material" in told


def test_clouds_without_the_material_or_with_other_bands_are_refused(tmp_path, sample):
    path = tmp_path / "ball.ply"
    sphere_mesh(path)
    for unusable in (sample(path), tmp_path / "other.ply"):
        if not unusable.exists():
            write_spectral_ply(unusable, random_cloud())
        with pytest.raises(InputError, match=f"{unusable.name}: "):
            sample(path, material=unusable)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_units_binary_files_and_normals_to_either_side(tmp_path, sample, sign):
    metres, millimetres = tmp_path / "m.ply", tmp_path / "mm.ply"
    sphere_mesh(metres, normals_sign=1.0)
    sphere_mesh(millimetres, scale=1000.0, binary=True, normals_sign=sign)
    inwards = read_spectral_ply(sample(millimetres, unit="mm"))
    expected = read_spectral_ply(sample(metres))
    np.testing.assert_array_equal(np.isnan(inwards.spectra), np.isnan(expected.spectra))
    np.testing.assert_allclose(inwards.points, 1000.0 * expected.points, rtol=1e-5)
    np.testing.assert_allclose(PlyData.read(str(millimetres))["vertex"]["nx"], inwards.normals[:, 0], atol=1e-6)


def test_normals_that_a_cloud_lacks_point_outwards(tmp_path, sample):
    path = tmp_path / "ball.ply"
    radial = sphere_mesh(path)
    PlyData([PlyData.read(str(path))["vertex"]]).write(str(path))
    assert (read_points(path).normals() * radial).sum(axis=1).min() < -0.9
    assert (read_spectral_ply(sample(path)).normals * radial).sum(axis=1).min() > 0.9


def test_points_off_the_surface_have_no_spectrum(tmp_path, sample):
    path = tmp_path / "off.ply"
    sphere_mesh(path, radius_m=factory.SPHERE_RADIUS_M + 0.002)
    near = read_spectral_ply(sample(path))
    assert np.isfinite(near.spectra).any()
    sphere_mesh(path, radius_m=factory.SPHERE_RADIUS_M + 0.006)
    (tmp_path / "off-spectral.ply").unlink()
    with pytest.raises(InputError, match="none of its points lies on the object"):
        sample(path)
    assert not (tmp_path / "off-spectral.ply").exists()


def test_a_cloud_keeps_its_colours_and_its_spectra_are_replaced(tmp_path, sample):
    path = tmp_path / "ball.ply"
    sphere_mesh(path)
    first = sample(path)
    content = PlyData.read(str(first))
    content["vertex"]["red"] = 200
    content["vertex"]["scalar_400.00nm"] = 9.0
    again = tmp_path / "again.ply"
    PlyData([content["vertex"]], byte_order=">").write(str(again))
    cloud, before = read_spectral_ply(sample(again)), read_spectral_ply(first)
    assert (cloud.colours[:, 0] == 200).all()
    np.testing.assert_array_equal(cloud.spectra, before.spectra)
    assert list(cloud.extra) == ["quality", "sampled_views", "sampled_std"]


def test_columns_that_another_run_measured_do_not_stay_beside_new_spectra(tmp_path):
    old_nm, new_nm = np.array([670.0, 800.0]), np.array([672.0, 802.0, 900.0])
    material = band_property_names(old_nm, "material")
    names = ("views", INCIDENCE, *LIGHT_COLUMNS, *material, "scalar_spectral_std", "quality")
    cloud = random_cloud(20, old_nm, extra={name: np.full(20, 7.0, np.float32) for name in names})
    write_spectral_ply(tmp_path / "old.ply", replace(stream(cloud), run="an/older/run"))
    found = PointSpectra(cloud.normals, np.full((20, 3), 0.5, np.float32), *np.ones((2, 20), np.float32))
    written = tmp_path / "new.ply"
    write_sampled_ply(written, read_points(tmp_path / "old.ply"), found, new_nm, [1, 0, 0], "this/newer/run")
    read = read_spectral_ply(written)
    np.testing.assert_array_equal(read.wavelengths_nm, new_nm)
    assert set(read.extra) == {"quality", "sampled_views", "sampled_std"}
    np.testing.assert_array_equal(read.colours, cloud.colours)
    comments = PlyData.read(str(written)).comments
    assert [line for line in comments if line.startswith("run: ")] == ["run: this/newer/run"]
    assert not any(line.startswith(("views [", "material_ [", "irradiance [")) for line in comments)
    assert any(line.startswith("x y z [m]") for line in comments)
    assert read.metric
    write_sampled_ply(written, read_points(written), found, new_nm, [1, 0, 0], "this/newer/run", metric=False)
    assert not read_spectral_ply(written).metric


TRIANGLE = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACES = TRIANGLE + "element face 1\nproperty {}\nend_header\n0 0 0\n1 0 0\n0 1 0\n{}\n"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (None, "there is no such file"),
        ("x y z\n0 0 0\n", "cannot be read"),
        ("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "has no points"),
        (TRIANGLE + "property list uchar int near\nend_header\n" + 3 * "0 0 0 1 1\n", r"hold lists \(near\)"),
        (TRIANGLE + "end_header\n0 0 0\n1 nan 0\n0 1 0\n", "finite"),
    ],
)
def test_bad_points_are_refused_in_a_sentence(tmp_path, text, told):
    path = tmp_path / "bad.ply"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=rf"bad\.ply.*{told}"):
        read_points(path)
    with pytest.raises(InputError, match="--views"):
        SampleCommand(path, load_config=path, views=0).main()


@pytest.mark.parametrize(
    ("faces", "told"),
    [
        (("list uchar int corners", "3 0 1 2"), "its faces have no vertex_indices"),
        (("int vertex_index", "2"), "its faces have no vertex_indices"),
        (("list uchar int vertex_indices", "3 0 1 3"), "its faces refer to vertices that do not exist"),
        (("list uchar int vertex_indices", "3 0 1 -1"), "its faces refer to vertices that do not exist"),
    ],
)
def test_odd_faces_are_refused_in_a_sentence(tmp_path, faces, told):
    path = tmp_path / "odd.ply"
    path.write_text(FACES.format(*faces))
    for read in (lambda path: read_points(path).normals(), read_surface):
        with pytest.raises(InputError, match=rf"odd\.ply.*{told}"):
            read(path)


def test_what_is_no_run_is_refused_in_a_sentence(tmp_path, run_config):
    with pytest.raises(InputError, match="there is no such file"):
        open_trained_run(tmp_path / "config.yml")
    other = tmp_path / "config.yml"
    other.write_text("a: 1\n")
    with pytest.raises(InputError, match=r"config\.yml: .*give the config\.yml of a run"):
        open_trained_run(other)
    alone = tmp_path / "alone.yml"
    alone.write_text(run_config.read_text())
    with pytest.raises(InputError, match="checkpoint"):
        open_trained_run(alone)


def test_a_run_that_was_moved_is_opened_from_anywhere(tmp_path, run_config, run, monkeypatch):
    moved = shutil.copytree(run_config.parent, tmp_path / "archive" / "apple 7")
    monkeypatch.chdir(moved)
    opened = open_trained_run(Path("config.yml"))
    for name, value in run.model.state_dict().items():
        if not name.endswith("grid.opacity"):  # which follows the ball in the one
            torch.testing.assert_close(opened.model.state_dict()[name], value)


def test_a_dataset_given_relative_to_another_folder_is_found_above_the_run(tmp_path, run_config, monkeypatch):
    home = run_config.parents[4]
    config = yaml.load(run_config.read_text(), Loader=yaml.Loader)
    config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = Path("data")
    relative = run_config.with_name("relative.yml")
    relative.write_text(yaml.dump(config))
    monkeypatch.chdir(tmp_path)
    assert open_trained_run(relative).dataset.root.resolve() == (home / "data").resolve()


def test_metres_and_scene_units_are_inverse(run):
    points = np.random.default_rng(0).random((5, 3))
    np.testing.assert_allclose(run.to_metres(run.to_scene(points)), points)
    expected = np.stack([factory.true_pose(angle) for angle in ball_run.ANGLES_DEG])
    np.testing.assert_allclose(run.refined_poses_m(), expected, atol=1e-6)
