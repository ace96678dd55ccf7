"""Objects of scenes: the solids' closed forms, a scene's own materials, and what is refused."""

import numpy as np
import pytest

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate import assemble
from hsi_sc_nerf.simulate.materials import MATERIALS, Measured, Plain, PlantTissue, endmembers
from hsi_sc_nerf.simulate.mesh import SEGMENTS, VERTEX_SPACING_M, cylinder, sphere
from hsi_sc_nerf.simulate.scene import OwnMesh, load_scene, override, parse_scene
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth

SCENE = """
object: {shape: sphere, height_m: 0.07, material: matte_white}
camera: {elevation_deg: 20, distance_m: 0.5, aim_height_m: 0.05}
turntable: {disc_diameter_m: 0.205}
markers: {side_m: 0.036}
"""
SMALL = {"frames": 2, "size_px": 32, "bands": 5}


def parse(text, folder):
    return parse_scene(text, source="scene.yaml", name="scene", folder=folder)


@pytest.mark.parametrize("diameter_m", [0.01, 0.07, 0.3])
def test_sphere_has_its_closed_forms(diameter_m):
    mesh = sphere(diameter_m)
    radius_m = diameter_m / 2
    assert mesh.is_watertight()
    assert mesh.area_m2() == pytest.approx(np.pi * diameter_m**2, rel=2e-4)
    assert mesh.volume_m3() == pytest.approx(np.pi / 6 * diameter_m**3, rel=2e-4)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - [0, 0, radius_m], axis=1), radius_m, rtol=1e-12)


@pytest.mark.parametrize(("diameter_m", "height_m"), [(0.01, 0.01), (0.06, 0.08), (0.02, 0.4)])
def test_cylinder_has_its_closed_forms(diameter_m, height_m):
    mesh = cylinder(diameter_m, height_m, SEGMENTS, VERTEX_SPACING_M)
    assert mesh.is_watertight()
    assert mesh.area_m2() == pytest.approx(np.pi * diameter_m * (diameter_m / 2 + height_m), rel=2e-4)
    assert mesh.volume_m3() == pytest.approx(np.pi / 4 * diameter_m**2 * height_m, rel=2e-4)
    radius = np.hypot(*mesh.vertices[:, :2].T)
    on_side = (mesh.vertices[:, 2] > 1e-9) & (mesh.vertices[:, 2] < height_m - 1e-9)
    np.testing.assert_allclose(radius[on_side], diameter_m / 2, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "materials"),
    [
        ("sphere", ("matte_white",)),
        ("cylinder", ("matte_grey",)),
        ("pepper", ("pepper_red", "pepper_green", "pepper_stem")),
    ],
)
def test_sessions_of_the_new_scenes_have_their_truth(tmp_path, name, materials):
    scene = override(load_scene(name), **SMALL)
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


def test_a_scene_defines_its_own_materials_in_three_ways(tmp_path):
    (tmp_path / "leaf.csv").write_text("wavelength_nm, reflectance\n390, 0.1\n700, 0.5\n1010, 0.3\n")
    text = SCENE + "materials:\n  disc: {plain: {level: 0.2}}\n  paper: {csv: leaf.csv}\n"
    scene = parse(text.replace("matte_white", "skin") + "  skin: {plant: {plateau: 0.6, water: 1}}\n", tmp_path)
    assert scene.materials == {
        "disc": Plain(0.2),
        "paper": Measured((390.0, 700.0, 1010.0), (0.1, 0.5, 0.3)),
        "skin": PlantTissue(0.6, water=1.0),
    }
    spectra = endmembers(["disc", "paper", "chamber"], np.array([545.0, 700.0, 855.0]), scene.materials)
    np.testing.assert_allclose(spectra[0], 0.2)
    np.testing.assert_allclose(spectra[1], [0.3, 0.5, 0.4])
    np.testing.assert_array_equal(spectra[2], endmembers(["chamber"], np.array([545.0, 700.0, 855.0]))[0])
    assert "skin" not in MATERIALS


def test_paths_are_relative_to_the_scene_file(tmp_path):
    (tmp_path / "mine.yaml").write_text(
        SCENE.replace("{shape: sphere, height_m: 0.07, material: matte_white}",
                      "{shape: mesh, mesh_file: parts/a.ply, materials: [matte_grey]}")
    )  # fmt: skip
    thing = load_scene(tmp_path / "mine.yaml").object
    assert isinstance(thing, OwnMesh)
    assert thing.mesh_file == tmp_path / "parts" / "a.ply"
    assert thing.height_m is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pear", "apple", "maize"])
def test_another_seed_grows_another_fruit_and_the_same_seed_the_same(name):
    scene = load_scene(name)
    one, same, other = (assemble.object_part(override(scene, seed=seed)) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.mesh.vertices, same.mesh.vertices)
    np.testing.assert_array_equal(one.weights, same.weights)
    assert np.abs(one.mesh.vertices - other.mesh.vertices).max() > 1e-4


MESH = "{shape: mesh, mesh_file: a.ply, materials: [matte_grey]}"


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("matte_white", "skim", "material 'skim' is not defined"),
        ("matte_white", "3", "object.material is 3, but must be a text"),
        ("sphere", "[sphere]", "object.shape is ['sphere'], but must be one of"),
        ("{shape: sphere, height_m: 0.07, material: matte_white}", "5", "object must hold `key: value` lines"),
        ("{shape: sphere, height_m: 0.07, material: matte_white}", "{shape: mesh, mesh_file: a.ply, materials: []}",
         "object.materials is [], but must name one or more"),
        ("{shape: sphere, height_m: 0.07, material: matte_white}",
         "{shape: mesh, mesh_file: a.ply, materials: [disc, disc]}", "but must name one or more, each once"),
        ("{shape: sphere, height_m: 0.07, material: matte_white}", MESH.replace("[matte_grey]", "[1]"),
         "object.materials[0] is 1, but must be a text"),
        ("{shape: sphere, height_m: 0.07, material: matte_white}", MESH.replace("}", ", height_m: 9}"),
         "object.height_m is 9, but must lie between"),
        ("{shape: sphere, height_m: 0.07, material: matte_white}", MESH.replace("a.ply", "4"),
         "object.mesh_file is 4, but must be a path"),
    ],
)  # fmt: skip
def test_bad_objects_get_one_sentence(tmp_path, old, new, sentence):
    with pytest.raises(InputError) as caught:
        parse(SCENE.replace(old, new), tmp_path)
    message = str(caught.value)
    assert message.startswith("scene.yaml: ")
    assert sentence in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("definition", "sentence"),
    [
        ("3", "materials must hold `name: definition` lines"),
        ("{disc: {level: 0.2}}", "materials.disc is {'level': 0.2}, but must be one of `plant"),
        ("{disc: {plain: {level: 20}}}", "materials.disc.plain.level is 20, but must lie between 0 and 1"),
        ("{disc: {plain: {}}}", "materials.disc.plain.level is missing"),
        ("{disc: {plant: {plateau: 0.5, green: 1}}}", "materials.disc.plant.green is not a known key"),
        ("{disc: {csv: 4}}", "materials.disc.csv is 4, but must be the path of a CSV file"),
        ("{dics: {plain: {level: 0.2}}}", "nothing is made of the material 'dics'"),
        ("{disc: {csv: none.csv}}", "none.csv: cannot be read"),
    ],
)
def test_bad_materials_get_one_sentence(tmp_path, definition, sentence):
    with pytest.raises(InputError) as caught:
        parse(f"{SCENE}materials: {definition}\n", tmp_path)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("", "not a table of numbers with the columns wavelength_nm and reflectance|must cover"),
        ("nm,r\n390,0.1\n1010,0.2\n", "not a table of numbers with the columns"),
        ("wavelength_nm,reflectance\n390,0.1\n1010,high\n", "not a table of numbers"),
        ("wavelength_nm,reflectance\n400,0.1\n1010,0.2\n", "must cover 397.32 to 1003.58 nm"),
        ("wavelength_nm,reflectance\n1010,0.1\n390,0.2\n", "wavelengths must increase"),
        ("wavelength_nm,reflectance\n390,10\n1010,20\n", "divide by 100"),
        ("wavelength_nm,reflectance\n390,nan\n1010,0.2\n", "must lie between 0 and 1"),
    ],
)
def test_bad_spectra_get_one_sentence(tmp_path, content, sentence):
    (tmp_path / "leaf.csv").write_text(content)
    with pytest.raises(InputError, match=rf"leaf\.csv: .*({sentence})"):
        parse(SCENE + "materials: {disc: {csv: leaf.csv}}\n", tmp_path)
