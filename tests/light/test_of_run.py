"""The light on a run's object, the command, and what tells of shading: balls of known irradiance."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import ball_run
import capture_factory as factory
import numpy as np
import pytest
import torch
from light_on_a_ball import FACING, measured, turning_ball
from plyfile import PlyData
from random_cloud import random_cloud

from hsi_sc_nerf.cli.light import MaterialCommand, light_summary, sentences
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.export.cloud import SpectralCloud, read_spectral_ply, stream, write_spectral_ply
from hsi_sc_nerf.export.cloud_material import require_bands_of_run, with_material
from hsi_sc_nerf.export.formats import write_cloud
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.geometry.camera import pixel_rays
from hsi_sc_nerf.light.fit import fit_light
from hsi_sc_nerf.light.gloss import CELL, HALF, Gloss
from hsi_sc_nerf.light.known_light import read_light
from hsi_sc_nerf.light.material import CONTACT_ERROR, CONTACT_M
from hsi_sc_nerf.light.matte_views import HIGHLIT, LEAST_COSINE, matte_score, matte_views
from hsi_sc_nerf.light.of_run import RunLight, light_of_run, shading_evidence
from hsi_sc_nerf.models.trained_run import open_trained_run
from hsi_sc_nerf.packed.cube import FLAGGED, pack, write_packed_cube
from hsi_sc_nerf.packed.dataset import Container, open_packed

TO_LAMP = np.array([-0.45, 0.3, 0.84]) / np.linalg.norm([-0.45, 0.3, 0.84])
LAMP = 0.5


def irradiance(normals, camera_to_world):
    """On the ball without its surroundings, relative to a white reference that faces the camera."""
    cosines = np.maximum(normals @ camera_to_world[:3, :3] @ TO_LAMP, 0.0)
    return (1.0 - LAMP + LAMP * cosines) / (1.0 - LAMP + LAMP * TO_LAMP[2])


def open_lit_ball(root, lit):
    dataset = open_packed(ball_run.write_ball_dataset(root / "data"))
    for frame in dataset.frames if lit else ():
        mask = frame.mask()
        line, sample = np.nonzero(mask)
        pixels = np.stack([sample, line], axis=1) + 0.5
        origin, directions = pixel_rays(dataset.intrinsics, frame.camera_to_world, pixels)
        to_centre = factory.SPHERE_CENTRE_M - origin
        along = directions @ to_centre
        hidden = to_centre @ to_centre - along**2
        depth = along - np.sqrt(np.maximum(factory.SPHERE_RADIUS_M**2 - hidden, 0.0))
        normals = (origin + depth[:, None] * directions - factory.SPHERE_CENTRE_M) / factory.SPHERE_RADIUS_M
        reflectance = np.broadcast_to(factory.BACKGROUND, (*mask.shape, factory.BANDS)).copy()
        reflectance[mask] = factory.PLANT * irradiance(normals, frame.camera_to_world)[:, None]
        write_packed_cube(frame.cube_path, pack(reflectance), factory.WAVELENGTHS_NM)
    run = open_trained_run(ball_run.write_untrained_run(root / "data", root / "runs"))
    ball_run.fill_with_ball(run)
    return run


@pytest.fixture(scope="module", autouse=True)
def fewer_elements():
    """A ball is smooth: fewer elements and rays than a fruit needs show its light."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hsi_sc_nerf.light.of_run.ELEMENTS", 600)
        patch.setattr("hsi_sc_nerf.light.of_run.SUPPORT_ELEMENTS", 240)
        patch.setattr("hsi_sc_nerf.light.material.RAY_DIRECTIONS", 1024)
        yield


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    return light_of_run(open_lit_ball(tmp_path_factory.mktemp("lit"), lit=True), FACING)


@pytest.fixture(scope="module")
def even(tmp_path_factory):
    return light_of_run(open_lit_ball(tmp_path_factory.mktemp("even"), lit=False), FACING)


def frontal_irradiance(found, points):
    frames, _, normals = found.frontal(points)
    return found.light.irradiance(points, normals, np.maximum(frames, 0))


def upper_cloud(found, lit):
    """Points of the upper half, which the disc hardly shades, with what their most frontal frames measure of them."""
    run = found.run
    points = run.to_metres(sample_surface(found.mesh.vertices, found.mesh.triangles, 600))
    normals = points - factory.SPHERE_CENTRE_M
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frames = run.manager.train_dataparser_outputs.metadata["turntable"]["frame_indices"]
    cameras = run.refined_poses_m()[frames]
    sight = cameras[:, :3, 3] - points[:, None]
    cosines = (normals[:, None] * sight).sum(axis=-1) / np.linalg.norm(sight, axis=-1)
    light = np.ones(len(points))
    if lit:
        light = np.array([irradiance(n, cameras[c]) for n, c in zip(normals, cosines.argmax(axis=1), strict=True)])
    cloud = SpectralCloud(
        points.astype(np.float32),
        normals.astype(np.float32),
        np.zeros((len(points), 3), np.uint8),
        (factory.PLANT * light[:, None]).astype(np.float32),
        factory.WAVELENGTHS_NM,
    )
    return cloud.select((cosines.max(axis=1) > 0.5) & (normals[:, 2] > 0.2))


@pytest.fixture(scope="module")
def cloud(lit):
    return upper_cloud(lit, lit=True)


@pytest.fixture(scope="module")
def corrected(lit, cloud):
    return with_material(cloud, lit, factory.WAVELENGTHS_NM, corrected=True)


@pytest.mark.slow
def test_a_lamp_on_a_run_is_found_and_divided_out(lit, cloud, corrected):
    assert lit.evidence.shaded
    assert list(corrected.extra)[-2:] == ["irradiance", "irradiance_std"]
    by_band, std = frontal_irradiance(lit, cloud.points.astype(float))
    for band, name in enumerate(list(corrected.extra)[: factory.BANDS]):
        np.testing.assert_allclose(corrected.extra[name] * by_band[:, band], cloud.spectra[:, band], rtol=1e-4)
    np.testing.assert_allclose(corrected.extra["irradiance_std"], std, rtol=1e-4)
    assert (std > 0.0).all()
    np.testing.assert_array_equal(corrected.spectra, cloud.spectra)
    told = light_summary(lit, corrected, corrected=True)
    assert told["shaded"] is True
    assert told["relative_std"] == pytest.approx(np.median(std / by_band.mean(axis=1)), rel=1e-4)
    assert told["support_unknown"] is True
    on_disc = ~lit.light.views.on_object
    assert on_disc.any()
    assert not lit.light.views.shows_light[on_disc].any()  # what shades the disc is unknown


@pytest.mark.slow
def test_points_just_above_the_surface_that_an_object_stands_on_are_uncertain(lit):
    elements, above_m = lit.light.elements, np.array([-0.001, 0.0, CONTACT_M, 10.0 * CONTACT_M])
    on_disc = replace(lit.light, elements=replace(elements, shows_light=np.ones_like(elements.shows_light)))
    points = np.stack([np.full(4, 0.01), np.zeros(4), above_m], axis=1)
    normals, frames = np.broadcast_to([1.0, 0.0, 0.0], (4, 3)), np.zeros(4, int)
    (irradiance, std), (same, unknown_support) = (
        light.irradiance(points, normals, frames) for light in (on_disc, lit.light)
    )
    np.testing.assert_array_equal(irradiance, same)
    added = np.sqrt(std**2 - unknown_support**2) / irradiance.mean(axis=1)
    expected = CONTACT_ERROR * np.array([1.0, 1.0, np.exp(-1.0), np.exp(-10.0)])
    np.testing.assert_allclose(added, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_gloss_is_taken_off_before_the_light_and_has_a_column(lit, cloud, corrected):
    gloss = Gloss(0.04, 0.002, np.zeros((2 * HALF, 2 * HALF)))
    glossy = replace(lit, light=replace(lit.light, fit=replace(lit.light.fit, gloss=gloss)))
    matte, corrected = corrected, with_material(cloud, glossy, factory.WAVELENGTHS_NM, corrected=True)
    assert list(corrected.extra)[-1] == "gloss"
    # An even chamber that gives a part of the light is mirrored alike everywhere.
    chamber = lit.stationary.light.chamber[0]
    np.testing.assert_allclose(corrected.extra["gloss"], 0.04 * chamber, rtol=0.3)
    names = list(matte.extra)[: factory.BANDS]
    less, more = (np.stack([each.extra[name] for name in names], axis=-1) for each in (corrected, matte))
    expected = more.mean(axis=1) - corrected.extra["gloss"] / corrected.extra["irradiance"]
    np.testing.assert_allclose(less.mean(axis=1), expected, rtol=0.02)
    assert (corrected.extra["irradiance_std"] > matte.extra["irradiance_std"]).all()
    told = light_summary(glossy, corrected, corrected=True)
    assert told["gloss"] == {"reflectance": 0.04, "std": 0.002}
    assert "mirrors 4.0 ± 0.2 %" in sentences(told)[1]
    assert light_summary(lit, matte, corrected=True)["gloss"] is None


def highlit(found):
    """The same light, with highlights wherever the surface faces the camera within 30 degrees, and their gloss."""
    middles = (np.arange(2 * HALF) - HALF + 0.5) * CELL
    frontal = middles**2 + middles[:, None] ** 2 < np.sin(np.deg2rad(30.0)) ** 2
    gloss = Gloss(0.0, 0.001, np.where(frontal, 0.06, 0.0))
    return replace(found, light=replace(found.light, fit=replace(found.light.fit, gloss=gloss))), gloss


@pytest.mark.slow
def test_a_point_in_a_highlight_is_rendered_in_a_view_without_it(even):
    glossy, gloss = highlit(even)
    cloud, bands = upper_cloud(even, lit=False), np.arange(factory.BANDS)
    points_m = cloud.points.astype(float)
    frames, _, normals = glossy.frontal(points_m)
    rotations = even.light.turning.rotations
    frontal = gloss.highlight(np.einsum("nk,nkj->nj", normals, rotations[frames]))
    avoided = frontal > 2.0 * HIGHLIT
    assert 0.3 < avoided.mean() < 1.0
    # What the most frontal view showed of such a point counts no more.
    measured = np.where(avoided[:, None], 0.9, cloud.spectra)
    material = glossy.material(measured, points_m, bands)
    matte = material.gloss < 0.5 * frontal
    assert matte[avoided].mean() > 0.8
    np.testing.assert_array_equal(measured[avoided & matte], np.float32(0.9))  # not written to
    shown = material.spectra * material.irradiance[:, None] + material.gloss[:, None]
    np.testing.assert_allclose(shown[matte & avoided].mean(axis=0), factory.PLANT, rtol=0.02)
    # Others keep their spectrum and their view.
    same = frontal == 0.0
    assert same.any()
    kept = even.material(measured, points_m, bands)
    np.testing.assert_allclose(material.irradiance[same], kept.irradiance[same], rtol=1e-5)
    np.testing.assert_allclose(material.spectra[same], kept.spectra[same], rtol=1e-5)


@pytest.mark.slow
def test_the_view_is_the_best_of_those_that_see_the_point(even):
    _, gloss = highlit(even)
    points_m = upper_cloud(even, lit=False).points.astype(float)
    normals = even.frontal(points_m)[2]
    where, outward = (torch.from_numpy(array).float() for array in (even.run.to_scene(points_m), normals))
    frames, xy_px = matte_views(even.renders, gloss, where, outward)
    scores = []
    for view, rotation in zip(even.renders.views(where, outward), even.light.turning.rotations, strict=True):
        highlights = gloss.highlight(normals @ rotation)
        score = matte_score(view.cosines.numpy(), highlights)
        scores.append(np.where(view.visible & (view.cosines > LEAST_COSINE), score, -np.inf))
    none = np.isneginf(scores).all(axis=0)
    np.testing.assert_array_equal(frames.numpy() == -1, none)
    best = np.max(scores, axis=0)[~none]
    np.testing.assert_allclose(np.array(scores)[frames[~none], np.flatnonzero(~none)], best, atol=1e-4)
    seen = list(even.renders.views(where, outward))
    expected = np.stack([seen[frame].xy_px[row].numpy() for row, frame in enumerate(frames) if frame >= 0])
    np.testing.assert_array_equal(xy_px[~none], expected)


@pytest.mark.slow
@pytest.mark.parametrize("file_format", ["ply", "netcdf"])
def test_files_hold_reflectance_as_measured_and_of_the_material(lit, cloud, corrected, tmp_path, file_format):
    path = write_cloud(tmp_path / "cloud", stream(corrected), file_format)
    if file_format == "ply":
        read = read_spectral_ply(path)
        measured, columns = read.spectra, read.extra
        material = np.stack([columns[f"material_{nm:.2f}nm"] for nm in factory.WAVELENGTHS_NM], axis=-1)
    else:
        table = pytest.importorskip("h5netcdf").File(path)
        measured, material = table["reflectance"][:], table["material"][:]
        assert table["material"].dimensions == ("point", "wavelength")
        assert not any(name.startswith("material_") for name in table.variables)
        columns = {name: table[name][:] for name in ("irradiance", "irradiance_std")}
    np.testing.assert_array_equal(measured, cloud.spectra)
    by_band, std = frontal_irradiance(lit, cloud.points.astype(float))
    np.testing.assert_allclose(material * by_band, measured, rtol=1e-4)
    np.testing.assert_allclose(columns["irradiance"], by_band.mean(axis=1), rtol=1e-4)
    np.testing.assert_allclose(columns["irradiance_std"], std, rtol=1e-4)


@pytest.mark.slow
def test_the_light_of_a_file_is_taken_for_what_it_was(lit, cloud, corrected, tmp_path):
    told = light_summary(lit, corrected, corrected=True)
    write_json(tmp_path / "cloud-material.json", told)
    # The white reference's direction is that of the file's session.
    taken = light_of_run(lit.run, -FACING, read_light(tmp_path / "cloud-material.json"))
    points = cloud.points.astype(float)
    for of_taken, of_lit, rtol in zip(
        *(frontal_irradiance(f, points) for f in (taken, lit)), (0.01, 0.1), strict=True
    ):
        np.testing.assert_allclose(of_taken, of_lit, rtol=rtol)
    assert taken.evidence.shaded


@pytest.mark.slow
def test_shade_that_is_not_corrected_has_no_stated_uncertainty(lit, cloud):
    same = with_material(cloud, lit, factory.WAVELENGTHS_NM, corrected=False)
    assert np.isnan(same.extra["irradiance_std"]).all()
    assert light_summary(lit, same, corrected=False)["relative_std"] is None


EVIDENCE = {"profile": 0.7, "profile_std": 0.1}
OF_ANOTHER = {"relative_std": 0.02, "light_from": "b.json"}


@pytest.mark.parametrize(
    ("told", "words", "warned"),
    [
        ({"relative_std": 0.12}, "Warning", 1),
        ({"relative_std": 0.02}, "Warning", 0),
        ({"relative_std": None}, "Warning", 1),
        ({"relative_std": None, "corrected": False}, "Warning", 0),
        ({**OF_ANOTHER, "evidence": {**EVIDENCE, "turning": 1.02}}, "b.json", 0),
        ({**OF_ANOTHER, "evidence": {**EVIDENCE, "turning": 0.8}}, "b.json", 1),
        ({"relative_std": 0.02, "light_from": None, "evidence": {**EVIDENCE, "turning": 0.8}}, "b.json", 0),
    ],
)
def test_light_that_is_too_uncertain_or_of_another_chamber_is_warned_of(told, words, warned):
    lines = sentences({"evidence": EVIDENCE, "shaded": True, "corrected": True, **told})
    assert sum(words in line for line in lines) == warned


@pytest.mark.parametrize(
    ("container", "lowest_m", "warned"), [(None, 0.07, 1), (None, 0.001, 0), (Container(0.09, 0.07), 0.07, 0)]
)
def test_an_unknown_container_is_warned_of(container, lowest_m, warned):
    dataset = SimpleNamespace(
        container=container, object_box_m=np.array([[-0.04, -0.04, lowest_m], [0.04, 0.04, 0.2]])
    )
    unknown = RunLight(SimpleNamespace(dataset=dataset), *[None] * 5).support_unknown
    told = {"evidence": EVIDENCE, "shaded": True, "corrected": True, "relative_std": 0.02, "support_unknown": unknown}
    assert sum("container_height_m" in line for line in sentences(told) if line.startswith("Warning")) == warned


@pytest.mark.slow
def test_even_light_is_left_alone(even):
    assert not even.evidence.shaded
    cloud = upper_cloud(even, lit=False)
    same = with_material(cloud, even, factory.WAVELENGTHS_NM, corrected=False)
    np.testing.assert_array_equal(same.extra["material_400.00nm"], cloud.spectra[:, 0])
    np.testing.assert_array_equal(same.extra["irradiance"], 1.0)
    # That of the white reference.
    np.testing.assert_allclose(same.extra["irradiance_std"], 0.01)


@pytest.mark.slow
def test_a_band_that_no_pixel_has_is_not_taken_for_wrong_masks(even, monkeypatch):
    reader = even.run.manager.train_pixel_sampler.reader
    read = reader.read
    monkeypatch.setattr(
        reader,
        "read",
        lambda pixels: np.where(np.arange(factory.BANDS) == 3, FLAGGED, read(pixels)).astype(np.uint16),
    )
    with pytest.raises(InputError, match=r"all bands; .*calibration\.json at the flags"):
        light_of_run(even.run, FACING)


@pytest.mark.slow
def test_the_command_states_the_run_in_its_cloud(even, tmp_path):
    write_spectral_ply(tmp_path / "cloud.ply", upper_cloud(even, lit=False))
    MaterialCommand(tmp_path / "cloud.ply", Path("runs/ball/now/config.yml")).main(even.run)
    assert "run: runs/ball/now" in PlyData.read(str(tmp_path / "cloud-material.ply")).comments


def test_a_cloud_of_other_bands_is_refused():
    cloud = random_cloud(wavelengths_nm=np.array([500.0, 512.0]))
    with pytest.raises(InputError, match="its bands are not those of the run"):
        require_bands_of_run(cloud, np.array([500.0, 510.0]), "cloud.ply")


def shaded_ball():
    """A ball whose lower elements see less of the sky, by up to 40 %."""
    ball = turning_ball()
    visible = (0.8 + 0.2 * ball.normals[:, 2]).astype(np.float32)
    weights = ball.transfer.open_weights * visible[:, None]
    return replace(ball, transfer=replace(ball.transfer, open_weights=weights)), visible


@pytest.mark.parametrize("shade", [True, False])
def test_the_profile_tells_of_light_that_does_not_change_with_the_turn(shade):
    ball, visible = shaded_ball()
    views, _, _ = measured(ball, lamp=0.0)
    # Three materials of like brightness all over the ball.
    kinds = np.array([[0.2, 0.5], [0.3, 0.3], [0.5, 0.2]])[np.arange(len(visible)) % 3]
    noise = 1.0 + 0.01 * np.random.default_rng(0).standard_normal((len(views.element), 1))
    shown = kinds[views.element] * noise * (visible[views.element, None] if shade else 1.0)
    views = replace(views, reflectance=shown)
    found = shading_evidence(ball, views, fit_light(ball, views, FACING))
    assert found.profile == pytest.approx(1.0 if shade else 0.0, abs=0.1)
    assert found.shaded == shade


def test_a_lamp_shows_in_the_turn():
    ball = turning_ball()
    views, _, _ = measured(ball, lamp=0.3)
    found = shading_evidence(ball, views, fit_light(ball, views, FACING))
    assert found.turning == pytest.approx(1.0, abs=0.1)
    assert found.shaded
