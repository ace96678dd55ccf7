"""Scene files: the shipped ones load, and bad ones are refused in one sentence."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate import assemble
from hsi_sc_nerf.simulate.assemble import marker_layout
from hsi_sc_nerf.simulate.light import render
from hsi_sc_nerf.simulate.materials import MATERIALS, Measured, Plain, PlantTissue, endmembers
from hsi_sc_nerf.simulate.scene import EFFECTS, SHIPPED_SCENES, OwnMesh, load_scene, override, parse_scene

GOOD = """
object: {shape: apple, height_m: 0.07}
camera: {elevation_deg: 20, distance_m: 0.5, aim_height_m: 0.05}
turntable: {disc_diameter_m: 0.205}
markers: {side_m: 0.036}
"""
BALL = "{shape: sphere, height_m: 0.07, material: matte_white}"
MESH = "{shape: mesh, mesh_file: a.ply, materials: [matte_grey]}"


def of(thing):
    """The scene with another object."""
    return GOOD.replace("{shape: apple, height_m: 0.07}", thing)


def parse(text, folder=Path()):
    return parse_scene(text, source="scene.yaml", name="scene", folder=folder)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED_SCENES)
def test_nothing_that_turns_leaves_the_image(name):
    scene = override(load_scene(name), size_px=64)
    renderer = assemble.build_renderer(scene, assemble.object_part(scene))
    for pose in assemble.frame_plan(scene).camera_to_world[::6]:
        weights = render(renderer, assemble.intrinsics(scene.camera), pose, 1).material_weights
        chamber = weights[..., -1]
        for edge in (chamber[0], chamber[-1], chamber[:, 0], chamber[:, -1]):
            assert (edge == 1.0).all()


def test_a_scene_file_fills_in_defaults_and_takes_its_name_from_the_file(tmp_path):
    path = tmp_path / "my_apple.yaml"
    path.write_text(GOOD)
    scene = load_scene(path)
    assert scene.name == "my_apple"
    assert scene.camera.field_of_view_deg == 31.0
    assert isinstance(scene.camera.elevation_deg, float)
    assert scene.effects == ()


def test_a_scene_defines_its_own_materials_in_three_ways(tmp_path):
    (tmp_path / "leaf.csv").write_text("wavelength_nm, reflectance\n390, 0.1\n700, 0.5\n1010, 0.3\n")
    text = of(BALL) + "materials:\n  disc: {plain: {level: 0.2}}\n  paper: {csv: leaf.csv}\n"
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
    (tmp_path / "mine.yaml").write_text(of(MESH.replace("a.ply", "parts/a.ply")))
    thing = load_scene(tmp_path / "mine.yaml").object
    assert isinstance(thing, OwnMesh)
    assert thing.mesh_file == tmp_path / "parts" / "a.ply"
    assert thing.height_m is None


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (GOOD + "colour: red\n", "colour is not a known key"),
        (GOOD.replace("height_m: 0.07", "height_m: 0.07, glow: 1"), "object.glow is not a known key"),
        (GOOD.replace("apple", "banana"), "object.shape is 'banana', but must be one of pear, apple, maize"),
        (GOOD.replace("0.07", "tall"), "object.height_m is 'tall', but must be a number"),
        (GOOD.replace("0.07", "true"), "object.height_m is True, but must be a number"),
        (GOOD.replace("0.07", "7"), "object.height_m is 7, but must lie between"),
        (GOOD.replace("0.07", ".nan"), "object.height_m is nan, but must be a number"),
        (GOOD + "sensor: {bands: 20.5}\n", "sensor.bands is 20.5, but must be a whole number"),
        (GOOD.replace("shape: apple, ", ""), "object.shape is missing"),
        (GOOD.replace("markers: {side_m: 0.036}", "markers: 3"), "markers must hold"),
        (GOOD + "effects: [noise]\n", "effect 'noise' is unknown"),
        (GOOD + "effects: noise\n", "effects is 'noise', but must be a list"),
        (GOOD + "effects: [{read_noise: 0}]\n", "effects.read_noise must hold `key: value` lines"),
        (GOOD + "name: ../elsewhere\n", "name is '../elsewhere', but"),
        ("object: [", "not valid YAML"),
        ("object: " + "[" * 5000, "nested too deeply"),
        ("object: &a [1]\ncamera: *a", "refers to its own parts"),
        (GOOD + "seed: 0x" + "f" * 6000 + "\n", "seed is a number of more than 40 digits"),
        (GOOD.replace("0.07", "1" + "0" * 400), "must be a number"),
        (GOOD.replace("0.07", ".inf"), "object.height_m is inf, but must be a number"),
        (GOOD + "seed: 2026-99-99\n", "not valid YAML"),
        (GOOD + "0x" + "f" * 900 + ": 1\n", "is not a known key"),
        (GOOD + "seed: " + "9" * 400 + "\n", "seed is a number of more than 40 digits"),
        ("", "the file must hold"),
        (of(BALL.replace("matte_white", "skim")), "material 'skim' is not defined"),
        (of(BALL.replace("matte_white", "3")), "object.material is 3, but must be a text"),
        (of(BALL.replace("sphere", "[sphere]")), "object.shape is ['sphere'], but must be one of"),
        (of("5"), "object must hold `key: value` lines"),
        (of(MESH.replace("matte_grey", "")), "object.materials is [], but must name one or more"),
        (of(MESH.replace("matte_grey", "disc, disc")), "but must name one or more, each once"),
        (of(MESH.replace("matte_grey", "1")), "object.materials[0] is 1, but must be a text"),
        (of(MESH.replace("}", ", height_m: 9}")), "object.height_m is 9, but must lie between"),
        (of(MESH.replace("a.ply", "4")), "object.mesh_file is 4, but must be a path"),
        (GOOD + "materials: 3\n", "materials must hold `name: definition` lines"),
        (GOOD + "materials: {disc: {level: 0.2}}\n", "disc is {'level': 0.2}, but must be one of `plant"),
        (GOOD + "materials: {disc: {plain: {level: 20}}}\n", "level is 20, but must lie between 0 and 1"),
        (GOOD + "materials: {disc: {plain: {}}}\n", "materials.disc.plain.level is missing"),
        (GOOD + "materials: {disc: {plant: {plateau: 0.5, green: 1}}}\n", "plant.green is not a known key"),
        (GOOD + "materials: {disc: {csv: 4}}\n", "materials.disc.csv is 4, but must be the path of a CSV file"),
        (GOOD + "materials: {dics: {plain: {level: 0.2}}}\n", "nothing is made of the material 'dics'"),
        (GOOD + "materials: {disc: {csv: none.csv}}\n", "none.csv: cannot be read"),
    ],
)
def test_bad_scene_files_get_one_sentence(text, sentence):
    with pytest.raises(InputError) as caught:
        parse(text)
    message = str(caught.value)
    assert message.startswith(("scene.yaml: ", "none.csv: "))
    assert sentence in message
    assert "\n" not in message


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
        parse(GOOD + "materials: {disc: {csv: leaf.csv}}\n", tmp_path)


@pytest.mark.parametrize("wrong", [{"frames": 0}, {"size_px": 1}, {"bands": 0}, {"seed": -1}])
def test_overrides_are_checked_as_well(wrong):
    with pytest.raises(InputError, match="must lie between"):
        override(load_scene("pear"), **wrong)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("side_m: 0.036", "side_m: 0.06", "do not fit around the container"),
        ("disc_diameter_m: 0.205", "disc_diameter_m: 0.15", "do not fit on the disc"),
        ("side_m: 0.036", "side_m: 0.036, dictionary: DICT_9X9", "is not one of OpenCV"),
        ("side_m: 0.036", "side_m: 0.004, on_disc: 50, on_container: 6", "has only 50 markers"),
    ],
)
def test_markers_that_cannot_be_made_are_refused(old, new, sentence):
    scene = parse(GOOD.replace(old, new))
    with pytest.raises(InputError, match=sentence):
        marker_layout(scene)


def test_a_container_without_markers_may_be_low():
    low = GOOD.replace("side_m: 0.036", "side_m: 0.036, on_container: 0") + "container: {height_m: 0.005}\n"
    assert sorted(marker_layout(parse(low))) == list(range(8))


def test_layout_is_square_planar_distinct_and_faces_outwards():
    scene = load_scene("pear")
    layout = marker_layout(scene)
    assert sorted(layout) == list(range(14))
    for number, corners in layout.items():
        sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
        np.testing.assert_allclose(sides, 0.036, rtol=1e-12)
        # OpenCV's corners run clockwise for who looks at the marker, so this normal points away from the reader.
        inwards = np.cross(corners[1] - corners[0], corners[2] - corners[1])
        centre = corners.mean(axis=0)
        if number < 6:
            np.testing.assert_allclose(np.hypot(*centre[:2]), 0.0455, rtol=1e-12)
            assert inwards[:2] @ centre[:2] < 0
            assert inwards[2] == pytest.approx(0.0, abs=1e-15)
        else:
            np.testing.assert_allclose(corners[:, 2], 0.0, atol=1e-15)
            assert inwards[2] < 0


def test_every_effect_and_strength_is_documented():
    page = (Path(__file__).parents[2] / "docs" / "development" / "effects.md").read_text(encoding="utf-8")
    for name, effect in EFFECTS.items():
        (row,) = [line for line in page.splitlines() if line.startswith(f"| `{name}` |")]
        for strength in dataclasses.fields(effect):
            assert f"`{strength.name}` ({strength.default:g})" in row
