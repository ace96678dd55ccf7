"""Sessions: pictures agree with their truth, counts with the materials, folders with the layout."""

import json
import shutil

import numpy as np
import open3d as o3d
import pytest
import tyro
from turntable_scene import detected_corners

from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.capture.instrument import read_metadata
from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.cli.sessions import SimulateCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, turntable_camera_to_world
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate import assemble, own_mesh, session
from hsi_sc_nerf.simulate.assemble import marker_layout
from hsi_sc_nerf.simulate.light import render
from hsi_sc_nerf.simulate.materials import endmembers
from hsi_sc_nerf.simulate.mesh import sphere
from hsi_sc_nerf.simulate.render import Part, Renderer, exact_weights
from hsi_sc_nerf.simulate.scene import OwnMesh, load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth

SMALL = {"frames": 3, "size_px": 48, "bands": 12}


@pytest.fixture(scope="module")
def small_session(tmp_path_factory):
    return simulate_session(override(load_scene("apple"), **SMALL), tmp_path_factory.mktemp("s") / "apple", False)


def counts(session_dir, capture, prefix=""):
    return open_cube(session_dir / capture / "capture" / f"{prefix}{capture}.hdr").read().astype(float)


@pytest.mark.slow
def test_folder_is_as_the_instrument_leaves_it(small_session):
    assert sorted(path.name for path in small_session.iterdir()) == [
        "apple_000", "apple_001", "apple_002", "session.json", "truth", "white_reference",
    ]  # fmt: skip
    cube = open_cube(small_session / "apple_001" / "capture" / "apple_001.hdr")
    assert cube.shape == (48, 48, 12)
    assert cube.interleave == "bil"
    assert cube.dtype == np.uint16
    metadata = read_metadata(small_session / "apple_001" / "metadata" / "apple_001.xml")
    assert metadata.integration_time_ms == cube.integration_time_ms == 10.0
    assert json.loads((small_session / "session.json").read_text()) == {
        "object": "apple",
        "nominal_step_deg": 120.0,
        "direction": "ccw",
        "marker_dictionary": "DICT_5X5_50",
        "marker_side_m": 0.036,
        "container_diameter_m": 0.09,
        "container_height_m": 0.07,
        "white_reference": "white_reference",
        "image_rotation_deg": 0,
    }


@pytest.mark.slow
def test_metadata_state_each_captures_exposure_and_how_images_lie(tmp_path):
    effects = ["{image_rotation: {quarter_turns: 3}}", "{tarp_exposure: {exposure_factor: 0.3}}"]
    scene = override(load_scene("apple"), frames=2, size_px=32, bands=4, effects=effects)
    session = open_session(simulate_session(scene, tmp_path / "s", False))
    assert (session.image_rotation_deg, session.quarter_turns) == (270, 1)
    assert [frame.integration_time_ms for frame in session.frames] == [10.0, 10.0]
    assert session.white.integration_time_ms == pytest.approx(3.0)
    metadata = read_metadata(tmp_path / "s" / "white_reference" / "metadata" / "white_reference.xml")
    assert metadata.integration_time_ms == session.white.integration_time_ms


def test_calibrated_counts_are_the_true_reflectance_within_rounding(small_session):
    truth = load_truth(small_session)
    np.testing.assert_array_equal(
        open_cube(small_session / "apple_000" / "capture" / "apple_000.hdr").wavelengths_nm, truth.wavelengths_nm
    )
    for capture in truth.captures:
        dark = counts(small_session, capture, "DARKREF_").mean(axis=0)
        white = np.median(counts(small_session, "white_reference"), axis=(0, 1)) - dark
        reflectance = (counts(small_session, capture) - dark) / white
        # Half a count in the sample, half a count in the white.
        bound = 0.5 * (1.0 + reflectance) / white + 1e-4
        assert (np.abs(reflectance - truth.reflectance(capture)) <= bound).all()


def test_truth_comes_back_whole(small_session):
    truth = load_truth(small_session)
    scene = override(load_scene("apple"), **SMALL)
    assert truth.object == "apple"
    assert truth.intrinsics == assemble.intrinsics(scene.camera)
    np.testing.assert_allclose(truth.angles_deg, [0.0, 120.0, 240.0])
    for pose, angle in zip(truth.camera_to_world, truth.angles_deg, strict=True):
        np.testing.assert_allclose(pose, turntable_camera_to_world(truth.camera_to_world[0], angle), atol=1e-12)
    # The first camera looks at the axis from above the x axis.
    np.testing.assert_allclose(truth.camera_to_world[0, 1, 3], 0.0, atol=1e-12)
    assert truth.camera_to_world[0, 0, 3] > 0.3
    layout = marker_layout(scene)
    assert truth.marker_layout.keys() == layout.keys()
    np.testing.assert_allclose(truth.marker_layout[9], layout[9])
    np.testing.assert_allclose(truth.endmembers, endmembers(truth.materials, truth.wavelengths_nm))
    assert truth.mesh_path.is_file()
    part = assemble.object_part(scene)
    assert truth.volume_m3 == pytest.approx(part.mesh.volume_m3())
    for capture in truth.captures:
        np.testing.assert_array_equal(truth.material_weights(capture).sum(axis=-1), 1.0)
        assert 0.05 < truth.object_coverage(capture).mean() < 0.3


@pytest.mark.slow
def test_mesh_on_disk_is_the_object_on_the_lid_and_serves_as_a_mesh_of_ones_own(small_session):
    truth = load_truth(small_session)
    ply = o3d.io.read_triangle_mesh(str(truth.mesh_path))
    mesh = Mesh(np.asarray(ply.vertices), np.asarray(ply.triangles))
    assert mesh.is_watertight()
    assert mesh.volume_m3() == pytest.approx(truth.volume_m3, rel=1e-6)
    assert mesh.area_m2() == pytest.approx(truth.area_m2, rel=1e-6)
    assert mesh.vertices[:, 2].min() == pytest.approx(0.07)
    part = assemble.object_part(load_scene("apple"))
    mesh, weights = own_mesh.load(OwnMesh("mesh", truth.mesh_path, part.materials))
    assert mesh.volume_m3() == pytest.approx(part.mesh.volume_m3(), rel=1e-6)
    # Reading orders the vertices anew.
    np.testing.assert_allclose(np.sort(weights, axis=0), np.sort(part.weights, axis=0), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "materials"),
    [
        ("apple", ("apple_skin", "apple_blush", "lenticel", "bruise", "stem")),
        ("sphere", ("matte_white",)),
        ("cylinder", ("matte_grey",)),
        ("pepper", ("pepper_red", "pepper_green", "pepper_stem")),
        ("tomato", ("tomato_red", "tomato_green", "stem")),
    ],
)
def test_sessions_of_fruit_solids_and_meshes_have_their_truth(tmp_path, name, materials):
    scene = override(load_scene(name), frames=2, size_px=32, bands=5)
    truth = load_truth(simulate_session(scene, tmp_path / "s", False))
    part = assemble.object_part(scene)
    assert part.is_object
    assert part.materials == materials
    assert part.mesh.is_watertight()
    assert part.mesh.vertices[:, 2].min() == pytest.approx(0.07, abs=1e-12)
    assert truth.volume_m3 == pytest.approx(part.mesh.volume_m3())
    assert truth.materials[: len(materials)] == materials
    np.testing.assert_allclose(truth.endmembers, endmembers(truth.materials, truth.wavelengths_nm, scene.materials))
    for capture in truth.captures:
        of_object = truth.material_weights(capture)[..., : len(materials)].sum(axis=-1)
        np.testing.assert_allclose(of_object, truth.object_coverage(capture), atol=2e-3)
        assert of_object.mean() > 0.03


@pytest.mark.slow
def test_a_sphere_covers_the_solid_angle_of_its_closed_form():
    intrinsics = PinholeIntrinsics(64, 64, 128.0, 128.0, 32.0, 32.0)
    mesh = sphere(0.06).moved(np.array([0.0, 0.0, -0.03]))
    renderer = Renderer([Part(mesh, ("paper",), np.ones((len(mesh.vertices), 1)), is_object=True)])
    coverage = render(renderer, intrinsics, look_at(np.array([0.18, 0.0, 0.0]), np.zeros(3)), 4).coverage
    # A sphere on the optical axis is a disc of radius f tan(asin(r / d)).
    radius_px = 128.0 * np.tan(np.arcsin(1.0 / 6.0))
    assert coverage.sum() == pytest.approx(np.pi * radius_px**2, rel=2e-3)


def test_rendering_in_pieces_changes_nothing(monkeypatch):
    scene = override(load_scene("maize"), size_px=32)
    renderer = assemble.build_renderer(scene, assemble.object_part(scene))
    arguments = assemble.intrinsics(scene.camera), assemble.frame_plan(scene).camera_to_world[3], 2
    whole = render(renderer, *arguments)
    monkeypatch.setattr("hsi_sc_nerf.simulate.render.RAYS_AT_ONCE", 700)
    pieces = render(renderer, *arguments)
    np.testing.assert_array_equal(whole.material_weights, pieces.material_weights)
    np.testing.assert_array_equal(whole.coverage, pieces.coverage)


def test_exact_weights_sum_to_one_and_survive_float16():
    weights = np.random.default_rng(1).dirichlet(np.full(11, 0.3), 2000).astype(np.float32)
    exact = exact_weights(weights)
    np.testing.assert_array_equal(exact.sum(axis=1), 1.0)
    np.testing.assert_array_equal(exact.astype(np.float16).astype(np.float32), exact)
    assert np.abs(exact - weights).max() < 11 / 2 / 2048


def green_image(scene, renderer, pose):
    view = assemble.intrinsics(scene.camera), pose, scene.camera.supersampling
    weights = render(renderer, *view).material_weights
    return (weights @ endmembers(renderer.materials, np.array([548.0])))[..., 0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pear", "maize"])
def test_enough_markers_are_found_in_small_images(name):
    scene = load_scene(name)
    renderer = assemble.build_renderer(scene, assemble.object_part(scene))
    found = [
        len(detected_corners(green_image(scene, renderer, p), 4))
        for p in assemble.frame_plan(scene).camera_to_world[:12:2]
    ]
    assert min(found) >= 3
    assert np.mean(found) >= 5


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes(tmp_path, small_session):
    scene = override(load_scene("apple"), **SMALL)
    again = simulate_session(scene, tmp_path / "again", False)
    files = sorted(path.relative_to(small_session) for path in small_session.rglob("*.raw"))
    assert len(files) == 8
    for file in files:
        assert (again / file).read_bytes() == (small_session / file).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pear", "apple", "maize", "tomato"])
def test_another_seed_grows_another_fruit_and_the_same_seed_the_same(name):
    scene = load_scene(name)
    one, same, other = (assemble.object_part(override(scene, seed=seed)) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.mesh.vertices, same.mesh.vertices)
    np.testing.assert_array_equal(one.weights, same.weights)
    assert np.abs(one.mesh.vertices - other.mesh.vertices).max() > 1e-4


@pytest.mark.slow
def test_command_line(tmp_path, capsys):
    words = ["pear", str(tmp_path / "s"), "--frames", "2", "--size", "24", "--bands", "5", "--seed", "3"]
    tyro.cli(SimulateCommand, args=words).main()
    truth = load_truth(tmp_path / "s")
    assert len(truth.captures) == 2
    assert truth.reflectance("pear_001").shape == (24, 24, 5)
    assert "2 frames of 24 x 24 pixels x 5 bands" in " ".join(capsys.readouterr().out.split())


def test_a_folder_with_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("keep")
    with pytest.raises(InputError, match="not a simulated session"):
        simulate_session(override(load_scene("pear"), **SMALL), tmp_path, False)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.slow
def test_damaged_pixels_of_the_truth_are_one_sentence(tmp_path):
    scene = override(load_scene("sphere"), frames=1, size_px=24, bands=6)
    truth = load_truth(simulate_session(scene, tmp_path / "s", False))
    path = tmp_path / "s" / "truth" / "pixels" / "sphere_000.npz"
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"not an archive"):
        path.write_bytes(content)
        for read in (truth.object_coverage, truth.light):
            with pytest.raises(InputError, match=r"sphere_000\.npz: cannot be read"):
                read("sphere_000")
    np.savez(path, other=np.zeros(3))
    with pytest.raises(InputError, match="holds no object"):
        truth.object_coverage("sphere_000")


@pytest.mark.slow
def test_an_earlier_simulated_session_is_replaced(tmp_path):
    scene = override(load_scene("pear"), frames=2, size_px=16, bands=3)
    simulate_session(scene, tmp_path / "s", False)
    simulate_session(override(scene, frames=1), tmp_path / "s", False)
    assert load_truth(tmp_path / "s").captures == ("pear_000",)
    assert not (tmp_path / "s" / "pear_001").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["s"]


@pytest.mark.slow
def test_a_run_without_space_leaves_nothing(tmp_path, monkeypatch):
    def stop(*_):
        raise OSError(28, "No space left")

    monkeypatch.setattr(session.truth, "write_pixels", stop)
    with pytest.raises(InputError, match=r"\(No space left\); free some space"):
        simulate_session(override(load_scene("pear"), frames=1, size_px=16, bands=3), tmp_path / "s", False)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_truth_is_named(tmp_path):
    with pytest.raises(InputError, match="has no truth"):
        load_truth(tmp_path)


@pytest.mark.parametrize(
    "content",
    [np.bytes_(b"text"), np.zeros((4, 4)), np.zeros(3), np.zeros((4, 4, 1))],
    ids=["text", "2d", "1d", "one"],
)
def test_truth_of_pixels_that_are_no_weights_is_refused(small_session, tmp_path, content):
    shutil.copytree(small_session / "truth", tmp_path / "truth")
    np.savez(tmp_path / "truth" / "pixels" / "apple_000.npz", material_weights=content)
    with pytest.raises(InputError, match="simulate the session again"):
        load_truth(tmp_path).reflectance("apple_000")


def test_truth_without_a_material_s_spectrum_is_refused(small_session, tmp_path):
    shutil.copytree(small_session / "truth", tmp_path / "truth")
    table = tmp_path / "truth" / "endmembers.csv"
    table.write_text("".join(f"{line.rsplit(',', 1)[0]}\n" for line in table.read_text().splitlines()))
    with pytest.raises(InputError, match="not of its bands and materials"):
        load_truth(tmp_path)
