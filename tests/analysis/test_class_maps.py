"""Areas of the classes of a classifier whose probabilities are known in closed form."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hsi_sc_nerf.analysis.calibrations import Calibration, Domain, read_calibration
from hsi_sc_nerf.analysis.class_maps import OUTSIDE, WITHOUT_LIMITS, class_areas, class_map
from hsi_sc_nerf.analysis.maps import SurfaceMap
from hsi_sc_nerf.analysis.measurement import Measurement
from hsi_sc_nerf.analysis.measurement_files import write_measurement
from hsi_sc_nerf.analysis.pictures import SideViews
from hsi_sc_nerf.analysis.report import trait_content, trait_tables
from hsi_sc_nerf.analysis.size import Size, size_of
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.analysis.traits import RegionOfInterest, analyse
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import read_spectral_ply
from hsi_sc_nerf.simulate.mesh import cylinder

NM = np.linspace(500.0, 900.0, 6)
SOUND, BRUISED, OTHER = np.linspace(0.3, 0.6, 6), np.linspace(0.5, 0.3, 6), np.array([0.9, 0.1] * 3)
MODELS = Path(__file__).parent / "calibrations_onnx"
BASIS = np.linalg.svd(np.stack([SOUND, BRUISED]))[2][:2].T
ONLY_BOTH = Domain(np.zeros(6), np.ones(6), BASIS, BASIS, np.full(2, np.inf), np.inf, 1e-6)
"""Knows the mixtures of sound and bruised, and no other spectra."""


def classifier(noise, fraction=0.5, domain=None):
    """Linear discriminant analysis of two spectra with the same noise in each band: the exact probabilities."""

    def predict(spectra):
        towards = (spectra - (SOUND + BRUISED) / 2.0) @ (BRUISED - SOUND) / noise**2 + np.log(
            fraction / (1.0 - fraction)
        )
        p = 1.0 / (1.0 + np.exp(-np.clip(towards, -500.0, 500.0)))
        return np.stack([1.0 - p, p], axis=1)

    every, names = np.ones(6, bool), ("sound", "bruised")
    return Calibration("bruises", "", 0.0, NM, (), every, np.full(6, np.nan), predict, domain, names)


MESH = cylinder(0.04, 0.04, segments=64, spacing_m=0.002)


def surface_of(spectra, nm=NM, scatter=None):
    count = len(MESH.vertices)
    return SpectralMesh(MESH, np.array(spectra), nm, np.ones(count, bool), None, scatter and np.full(count, scatter))


def in_two_parts(rng, noise, fraction):
    """Bruised at random places: as far as areas are concerned, nothing says that they touch."""
    bruised = rng.uniform(size=len(MESH.vertices)) < fraction
    spectra = np.where(bruised[:, None], BRUISED, SOUND)
    return spectra + noise * rng.standard_normal(spectra.shape), bruised


def test_areas_are_those_of_the_more_probable_class_in_each_region():
    upper = MESH.vertices[:, 2] > 0.02
    surface = surface_of(np.where(upper[:, None], BRUISED, SOUND))
    found = class_map(surface, classifier(0.01))
    np.testing.assert_array_equal(found.labels, upper)
    for region in (np.ones(len(upper), bool), MESH.vertices[:, 0] > 0.0):
        areas = class_areas(found, region, surface, pixel_m=0.001)
        expected = [surface.areas_m2[region & ~upper].sum(), surface.areas_m2[region & upper].sum()]
        np.testing.assert_allclose(areas.areas_m2, expected)
        np.testing.assert_allclose(areas.stds_m2, 0.0, atol=1e-9)
        assert areas.outside_m2 == 0.0


def test_half_of_the_area_is_in_doubt_where_both_classes_are_as_probable():
    """Everywhere 0.6 to 0.4: the probabilities expect 0.4 of the area in the other class."""
    middle = (SOUND + BRUISED) / 2.0
    towards = (SOUND - BRUISED) / ((SOUND - BRUISED) @ (SOUND - BRUISED))
    surface = surface_of(np.tile(middle + 1e-4 * np.log(1.5) * towards, (len(MESH.vertices), 1)))
    found = class_map(surface, classifier(0.01))
    np.testing.assert_allclose(found.probabilities, np.tile([0.6, 0.4], (len(found.labels), 1)))
    total, pixel_m = surface.areas_m2.sum(), 0.002
    areas = class_areas(found, surface.seen, surface, pixel_m)
    np.testing.assert_allclose(areas.stds_m2, np.sqrt((0.4 * total) ** 2 + pixel_m**2 * total * 0.24))
    assert np.isnan(class_areas(found, surface.seen, surface, None).stds_m2).all()


@pytest.mark.parametrize(("noise", "fraction"), [(0.1, 0.5), (0.2, 0.1)])
@pytest.mark.parametrize("scatter", [False, True])
def test_the_standard_deviation_tells_how_far_areas_are_from_the_truth(noise, fraction, scatter):
    """Root mean square of errors over stated deviations: about 1, and below it where the noise is counted twice."""
    ratios = []
    for seed in range(60):
        spectra, bruised = in_two_parts(np.random.default_rng(seed), noise, fraction)
        surface = surface_of(spectra, scatter=noise if scatter else None)
        pixel_m = np.sqrt(np.mean(surface.areas_m2**2) / np.mean(surface.areas_m2))
        areas = class_areas(class_map(surface, classifier(noise, fraction)), surface.seen, surface, pixel_m)
        ratios.append((areas.areas_m2[1] - surface.areas_m2[bruised].sum()) / areas.stds_m2[1])
    assert (0.4 if scatter else 0.6) < np.sqrt(np.mean(np.square(ratios))) < 1.3


def test_spectra_that_the_classifier_does_not_know_are_outside():
    """In no class, in no class's area, and striped in the picture."""
    strange = MESH.vertices[:, 2] > 0.03
    surface = surface_of(np.where(strange[:, None], OTHER, SOUND))
    found = class_map(surface, classifier(0.01, domain=ONLY_BOTH))
    np.testing.assert_array_equal(found.labels, np.where(strange, -1, 0))
    areas = class_areas(found, surface.seen, surface, 0.001)
    assert areas.outside_m2 == pytest.approx(surface.areas_m2[strange].sum())
    assert areas.areas_m2[0] == pytest.approx(surface.areas_m2[~strange].sum())


def test_resampling_states_which_area_changes_its_class():
    """A peak that every second band does not see: the class of half the surface hangs on it."""
    between = np.array([540.0, 860.0])
    dense = np.linspace(500.0, 900.0, 9)
    narrow = 0.4 + 0.1 * (dense == 550.0) * (MESH.vertices[:, 2] > 0.02)[:, None]
    one = Calibration(
        "peak", "", 0.0, between, (), np.ones(2, bool), np.full(2, np.nan),
        lambda spectra: np.eye(2)[(spectra.mean(axis=1) > 0.42).astype(int)], classes=("flat", "peak"),
    )  # fmt: skip
    found = class_map(surface_of(narrow, dense), one)
    other = one.of(narrow[:, ::2], dense[::2])
    changed = other != found.labels
    areas_m2 = surface_of(narrow, dense).areas_m2
    assert changed.any()
    assert found.resampling_error == pytest.approx(areas_m2[changed].sum() / areas_m2.sum() / 3.0)
    assert class_map(surface_of(narrow[:, :6]), classifier(0.01)).resampling_error == 0.0


def test_a_class_named_outside_is_not_what_the_classifier_does_not_know():
    strange, right = MESH.vertices[:, 2] > 0.03, MESH.vertices[:, 0] > 0.01
    surface = surface_of(np.where(strange[:, None], OTHER, np.where(right[:, None], BRUISED, SOUND)))
    one = replace(classifier(0.01, domain=ONLY_BOTH), classes=("inside", "outside"))
    content = trait_content(size_of(MESH), {}, True, analyse(surface, class_maps=[class_map(surface, one)]), {})
    (rows,) = (table.rows for table in trait_tables(content) if table.heading == "Classifiers")
    masks = {"inside": ~strange & ~right, "outside": ~strange & right, OUTSIDE: strange}
    expected = {label: 1e4 * surface.areas_m2[where].sum() for label, where in masks.items()}
    assert {row[2]: float(row[3]) for row in rows} == pytest.approx(expected, abs=0.006)


def onnx_classifier(folder, head):
    pytest.importorskip("onnxruntime")
    (folder / "classes.onnx").write_bytes((MODELS / "classes.onnx").read_bytes())
    table = folder / "ripe.csv"
    table.write_text(f"# model: classes.onnx\n{head}\nwavelength_nm\n" + "".join(f"{nm}\n" for nm in NM))
    return read_calibration(table)


def test_an_onnx_classifier_on_the_page_in_the_tables_and_in_the_mesh(tmp_path):
    """Region by region, with the uncertainty of the mesh's size in it; its table states no limits."""
    one = onnx_classifier(tmp_path, "# classes: unripe, ripe")
    expected = np.loadtxt(MODELS / "expected.csv", delimiter=",")
    np.testing.assert_allclose(one.predictions(expected[:, :6], NM)[:, 1], expected[:, 7], rtol=1e-5)
    np.testing.assert_array_equal(one.of(expected[:, :6], NM), expected[:, 7] > 0.5)

    surface = surface_of(np.resize(expected[:, :6], (len(MESH.vertices), 6)))
    found = class_map(surface, one)
    side = RegionOfInterest("side", (0.04, 0.0, 0.02), 0.02)
    traits = analyse(surface, [side], None, 0.001, [], [found])
    size = size_of(MESH)
    spread = {"points": Size(*(0.1 * np.array([size.area_m2, size.volume_l, *[0.0] * 4])))}
    content = trait_content(size, spread, True, traits, {})
    for name, region in content["regions"].items():
        areas = region["classifiers"]["ripe"]
        assert sum(areas["areas_m2"].values()) == pytest.approx(region["area_m2"])
        bare = class_areas(found, side.of(surface) if name == "side" else surface.seen, surface, 0.001)
        shared = 0.1 * bare.areas_m2
        np.testing.assert_allclose(list(areas["area_sds_m2"].values()), np.hypot(bare.stds_m2, shared))
    (rows,) = (one.rows for one in trait_tables(content) if one.heading == "Classifiers")
    assert [row[:3] for row in rows] == [
        [region, "ripe", label]
        for region in ("whole surface", "side")
        for label in ("unripe", "ripe", WITHOUT_LIMITS)
    ]
    assert all("±" in row[3] for row in rows if row[2] != WITHOUT_LIMITS)


def test_what_has_no_value_is_striped_in_pictures_and_the_rest_as_it_was():
    """In the colours of no map; both where it is unknown and nowhere else."""
    views, colours = SideViews(MESH), np.full((len(MESH.vertices), 3), [0.1, 0.5, 0.2])
    lower = MESH.vertices[:, 2] < 0.02
    for plain, striped in zip(views.on_white(colours), views.on_white(colours, lower), strict=True):
        height = plain.shape[0]
        upper_half, lower_half = slice(0, int(0.48 * height)), slice(int(0.55 * height), height)
        np.testing.assert_array_equal(plain[upper_half], striped[upper_half])
        on = np.abs(plain[lower_half] - [0.1, 0.5, 0.2]).max(axis=-1) < 1e-6
        greys = striped[lower_half][on]
        assert (greys == greys[:, :1]).all()
        assert 0.3 < (greys[:, 0] < 0.5).mean() < 0.7


def test_two_maps_of_one_name_are_refused():
    surface = surface_of(np.tile(SOUND, (len(MESH.vertices), 1)))
    found = class_map(surface, classifier(0.01))
    with pytest.raises(InputError, match="named bruises"):
        analyse(surface, class_maps=[found, found])
    signs = [replace(found, name=name) for name in ("Brix (%)", "Brix [%]")]
    with pytest.raises(InputError, match="alike but for signs"):
        analyse(surface, class_maps=signs)


@pytest.mark.slow
def test_calibrations_with_names_in_other_scripts_have_columns_of_their_own(tmp_path):
    surface = surface_of(np.tile(SOUND, (len(MESH.vertices), 1)))
    sugar, acid = (
        SurfaceMap(name, "", np.full(len(MESH.vertices), value), lambda spectra: spectra[:, 0])
        for name, value in (("糖度", 12.0), ("酸度", 0.4))
    )
    ripe = replace(class_map(surface, classifier(0.01)), name="成熟")
    traits = analyse(surface, maps=[sugar, acid], class_maps=[ripe])
    write_measurement(tmp_path, Measurement(surface, size_of(MESH), {}, traits, None, {}), "fruit")
    columns = read_spectral_ply(tmp_path / "mesh.ply").extra
    for column, value in (("calibration__", 12.0), ("calibration__2", 0.4), ("calibration__3", 0.0)):
        assert columns[column] == pytest.approx(value)
    assert (tmp_path / "calibration__3.png").is_file()
    assert list(json.loads((tmp_path / "traits.json").read_text())["calibrations"]) == ["糖度", "酸度"]


@pytest.mark.parametrize(
    ("head", "why"),
    [
        ("# classes: ripe", "two names or more"),
        ("# classes: ripe, ripe", "each once"),
        ("# classes: unripe, ripe, rotten", "gives 2 of 3"),
        ("# classes: unripe, ripe\n# column: 1", "gives 1 of 2"),
    ],
)
def test_classes_that_the_model_does_not_have_are_refused(tmp_path, head, why):
    with pytest.raises(InputError, match=why):
        onnx_classifier(tmp_path, head)
