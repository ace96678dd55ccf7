"""The cloud inside the report: what is lost on the way into the page."""

import base64
from dataclasses import replace

import numpy as np
import pytest

from hsi_sc_nerf.analysis.calibrations import Calibration, Domain
from hsi_sc_nerf.analysis.class_maps import OUTSIDE, WITHOUT_LIMITS
from hsi_sc_nerf.export.cloud import SpectralCloud, band_property_names
from hsi_sc_nerf.report.build import object_section
from hsi_sc_nerf.report.cloud import TOLERANCE, cloud_payload, compress_spectra, point_areas_m2, quantise


def restored(spectra):
    return spectra.mean + (spectra.coefficients * spectra.scale) @ spectra.basis


def ball(count=500, bands=20, seed=0):
    """A cloud of a ball whose spectra are mixtures of three smooth ones."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    wavelengths_nm = np.linspace(400.0, 1000.0, bands)
    smooth = np.stack([0.5 + 0.3 * np.sin(wavelengths_nm / scale) for scale in (50.0, 90.0, 200.0)])
    spectra = rng.dirichlet(np.ones(3), count) @ smooth
    colours = np.zeros((count, 3), np.uint8)
    return SpectralCloud(0.03 * normals + [0.0, 0.0, 0.1], normals, colours, spectra, wavelengths_nm)


def test_smooth_spectra_need_few_components_and_come_back():
    spectra = ball(bands=204).spectra
    compressed = compress_spectra(spectra)
    assert len(compressed.basis) <= 2  # mixtures that sum to one: two degrees of freedom
    error = restored(compressed) - spectra
    assert np.abs(error).max() == pytest.approx(compressed.largest_error)
    assert np.sqrt(np.mean(error**2, axis=0)).max() <= TOLERANCE + 1e-5


def test_noise_is_cut_at_the_largest_rank_and_what_is_lost_is_told():
    rng = np.random.default_rng(1)
    spectra = 0.5 + 0.1 * rng.normal(size=(400, 50))
    compressed = compress_spectra(spectra, max_rank=8)
    assert len(compressed.basis) == 8
    assert np.sqrt(np.mean((restored(compressed) - spectra) ** 2)) == pytest.approx(compressed.rmse)
    assert compressed.rmse > 0.05
    assert compress_spectra(spectra, max_rank=50).rmse < TOLERANCE


def test_equal_spectra_come_back():
    spectra = np.tile(np.linspace(0.1, 0.9, 7), (5, 1))
    np.testing.assert_allclose(restored(compress_spectra(spectra)), spectra, atol=1e-6)


@pytest.mark.parametrize("count", [2000, 8000])
@pytest.mark.parametrize("radius", [0.01, 0.2])
def test_the_areas_of_points_add_up_to_the_surface(count, radius):
    """However large the surface, or the part of its box that it fills."""
    points = radius * ball(count).normals
    assert point_areas_m2(points).sum() == pytest.approx(4.0 * np.pi * radius**2, rel=0.12)
    at_random = points[np.random.default_rng(0).permutation(count)[: count // 2]]
    assert point_areas_m2(at_random).sum() == pytest.approx(4.0 * np.pi * radius**2, rel=0.05)
    assert point_areas_m2(points[:1]).tolist() == [0.0]


def test_quantised_numbers_come_back_and_missing_ones_are_marked():
    values = np.array([-1.0, 0.25, 3.0, np.nan, np.inf])
    counts, low, high = quantise(values)
    assert (low, high) == (-1.0, 3.0)
    np.testing.assert_allclose(low + counts[:3] / 65534 * (high - low), values[:3], atol=1e-4)
    assert counts[3:].tolist() == [65535, 65535]


def test_the_payload_holds_the_cloud_with_its_bands_in_order():
    cloud = ball()
    shuffled = np.random.default_rng(2).permutation(20)
    cloud = SpectralCloud(
        cloud.points, cloud.normals, cloud.colours, cloud.spectra[:, shuffled], cloud.wavelengths_nm[shuffled]
    )
    payload = cloud_payload(cloud, compress_spectra(cloud.spectra))

    def array(text, kind, *shape):
        return np.frombuffer(base64.b64decode(text), kind).reshape(*shape)

    positions = array(payload["positions"], "<i2", 500, 3) / 32767 * payload["reach_m"] + payload["centre_m"]
    np.testing.assert_allclose(positions, cloud.points, atol=1e-6)
    np.testing.assert_allclose(array(payload["normals"], "i1", 500, 3) / 127, cloud.normals, atol=4e-3)
    assert payload["wavelengths_nm"] == sorted(cloud.wavelengths_nm)
    basis = array(payload["basis"], "<f4", payload["rank"], 20)
    coefficients = array(payload["coefficients"], "<i2", 500, payload["rank"])
    spectra = payload["mean"] + coefficients @ basis
    np.testing.assert_allclose(spectra, cloud.spectra[:, np.argsort(cloud.wavelengths_nm)], atol=2e-3)
    assert [scalar["name"] for scalar in payload["scalars"]] == ["NDVI", "NDVI705", "WI"]
    own = cloud_payload(cloud, compress_spectra(cloud.spectra), ["own = R800 / R670"])["scalars"][0]
    ratio = cloud.spectra[:, np.abs(cloud.wavelengths_nm - 800).argmin()]
    ratio = ratio / cloud.spectra[:, np.abs(cloud.wavelengths_nm - 670).argmin()]
    assert own["drawn"] == pytest.approx(np.percentile(ratio, (1, 99)), rel=1e-5)


def test_calibrations_and_indices_are_of_the_material_where_it_is_known(tmp_path):
    """What a calibration does not know is no number; of a classifier there is a probability a class."""
    cloud = ball()
    names = band_property_names(cloud.wavelengths_nm, "material")
    lit = replace(cloud, extra=dict(zip(names, 2.0 * cloud.spectra.T, strict=True)) | {"views": np.ones(500)})

    def predict(spectra):
        return np.stack([spectra.mean(axis=1), 1.0 - spectra.mean(axis=1)], axis=1)

    every, none = np.ones(20, bool), np.full(20, np.nan)
    known = Domain(np.zeros(20), np.ones(20), np.eye(20)[:, :1], np.eye(20)[:, :1], np.ones(1), np.inf, 5.0)
    sugar = Calibration(
        "sugar", "°Brix", 0.0, cloud.wavelengths_nm, (), every, none, lambda s: predict(s)[:, :1], known
    )
    spots = replace(sugar, name="spots", predict=predict, domain=None, classes=("sound", "spot"))
    for one, factor in ((cloud, 1.0), (lit, 2.0)):
        payload = cloud_payload(one, compress_spectra(one.spectra), ["own = R800"], [sugar, spots])["scalars"]
        assert [scalar["name"] for scalar in payload if scalar.get("index")] == [
            "own",
            "sugar",
            "spots sound",
            "spots spot",
        ]
        assert [scalar["unit"] for scalar in payload[:4]] == ["", "°Brix", "", ""]
        assert [scalar["name"] for scalar in payload][4:] == list(one.extra)[20:]  # not the material's bands

        def values(scalar):
            counts = np.frombuffer(base64.b64decode(scalar["data"]), "<u2").astype(float)
            low, high = scalar["range"]
            return np.where(counts == 65535, np.nan, low + counts / 65534 * (high - low))

        spectra = factor * cloud.spectra
        inside = (spectra[:, 1:] ** 2).sum(axis=1) <= 5.0
        expected = np.where(inside, spectra.mean(axis=1), np.nan)
        np.testing.assert_allclose(values(payload[1]), expected, atol=1e-3)
        np.testing.assert_allclose(values(payload[3]), 1.0 - spectra.mean(axis=1), atol=1e-3)
        assert payload[3]["drawn"] == (0.0, 1.0)


def test_a_classifier_gives_each_point_its_class_and_each_class_its_area():
    """Halves of a ball, less caps that the classifier does not know; also in a table. A class is named outside."""
    cloud = ball()
    height = cloud.points[:, 2] / np.abs(cloud.points[:, 2]).max()
    marked = replace(cloud, spectra=np.repeat(height[:, None], 20, axis=1))
    none, every = np.full(20, np.nan), np.ones(20, bool)
    # The projection on the first band is the score, its square T².
    known = Domain(np.zeros(20), np.ones(20), np.eye(20)[:, :1], np.eye(20)[:, :1], np.ones(1), 0.64, np.inf)

    def predict(spectra):
        return np.stack([spectra[:, 0] < 0.0, spectra[:, 0] >= 0.0], axis=1).astype(float)

    one = Calibration("part", "", 0.0, cloud.wavelengths_nm, (), every, none, predict, known, ("lower", "outside"))
    (found,) = cloud_payload(marked, compress_spectra(marked.spectra), (), [one])["classifiers"]
    labels = np.frombuffer(base64.b64decode(found["labels"]), "<u2")
    expected = np.where(np.abs(height) > 0.8, 65535, height >= 0.0)
    np.testing.assert_array_equal(labels, expected)
    areas_cm2 = 1e4 * point_areas_m2(cloud.points)
    sums = [areas_cm2[labels == label].sum() for label in (0, 1, 65535)]
    np.testing.assert_allclose(found["areas_cm2"], sums)
    (table,) = object_section(marked, 500, (), [one]).blocks[1:]
    assert [row[:3] for row in table.rows] == [
        ["part", name, f"{area:.2f}"] for name, area in zip(("lower", "outside", OUTSIDE), sums, strict=True)
    ]
    (table,) = object_section(marked, 500, (), [replace(one, domain=None)]).blocks[1:]
    assert [row[1] for row in table.rows] == ["lower", "outside", WITHOUT_LIMITS]
    assert object_section(marked, 500).blocks[1:] == []


@pytest.mark.parametrize("metric", [True, False])
def test_a_page_without_a_scale_says_that_its_lengths_are_wrong(metric):
    (viewer,) = object_section(replace(ball(), metric=metric), 500).blocks
    assert ("nothing gave the scale" in viewer.caption) != metric
