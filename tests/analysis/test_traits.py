"""Spectra on a mesh: classes and their areas, regions, pictures, the PLY file, tables."""

import json
from dataclasses import replace

import numpy as np
import pytest
from halved_cylinder import BROWN, GREEN, NM, two_halves
from known_fruit import NM as FRUIT_NM
from known_fruit import SKIN, fruit_cloud
from true_object import TrueObject, relative_rms

from hsi_sc_nerf.analysis import report
from hsi_sc_nerf.analysis.classes import (
    UNCLASSIFIED,
    classify,
    connected_regions,
    spectral_angles,
)
from hsi_sc_nerf.analysis.closed_mesh import MeshConfig
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.analysis.maps import SurfaceMap, index_maps
from hsi_sc_nerf.analysis.measurement import class_references, measure_traits
from hsi_sc_nerf.analysis.measurement_files import write_spectra
from hsi_sc_nerf.analysis.pictures import SideViews
from hsi_sc_nerf.analysis.report import trait_tables
from hsi_sc_nerf.analysis.size import Size
from hsi_sc_nerf.analysis.spectral_mesh import LitSpectra, SpectralMesh, with_spectra, write_spectral_mesh
from hsi_sc_nerf.analysis.traits import (
    WHOLE,
    RegionOfInterest,
    analyse,
    classified,
    weighted_mean_and_sd,
)
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import (
    INCIDENCE,
    SpectralCloud,
    band_property_names,
    material_spectra,
    read_spectral_ply,
)
from hsi_sc_nerf.indices.catalogue import find_indices
from hsi_sc_nerf.simulate.mesh import cylinder, quads

LIBRARY = SpectralLibrary(("green", "brown"), NM, np.stack([GREEN, BROWN]))


def test_angles_and_classes_do_not_depend_on_brightness():
    spectra = np.stack([0.2 * GREEN, BROWN, GREEN[::-1], 3.0 * BROWN + 0.001])
    angles = spectral_angles(spectra, LIBRARY.spectra)
    cosine = (GREEN @ BROWN) / np.linalg.norm(GREEN) / np.linalg.norm(BROWN)
    assert angles[1, 0] == pytest.approx(np.arccos(cosine), abs=1e-5)
    assert classify(spectra, LIBRARY.spectra, 0.1).tolist() == [0, 1, UNCLASSIFIED, 1]


def test_class_areas_and_regions_of_two_halves():
    surface = two_halves()
    classes = classified(surface, LIBRARY, 0.1)
    half_m2 = surface.mesh.area_m2() / 2.0
    np.testing.assert_allclose(classes.areas_m2, half_m2, rtol=0.04)
    assert classes.areas_m2.sum() + classes.unclassified_m2 == pytest.approx(surface.mesh.area_m2())
    assert surface.areas_m2.sum() == pytest.approx(surface.mesh.area_m2())
    found = sorted((region.label, np.sign(region.centre_m[1])) for region in classes.regions)
    assert found == [(0, 1), (1, -1)]


def test_references_of_one_name_are_one_class():
    surface = two_halves()
    names = ("green", "brown", "green")
    library = SpectralLibrary(names, NM, np.stack([GREEN[::-1], BROWN, GREEN]))
    classes = classified(surface, library, 0.1)
    assert classes.names == ("green", "brown")
    np.testing.assert_allclose(classes.areas_m2, surface.mesh.area_m2() / 2.0, rtol=0.04)
    assert library.only(("green",)).names == ("green", "green")


def test_regions_that_do_not_touch_are_two_and_small_ones_are_not_listed():
    far = np.array(
        [[[x, 0.0, 0.0], [x + s, 0.0, 0.0], [x + s, s, 0.0], [x, s, 0.0]] for x, s in ((0, 1), (3, 2), (9, 0.1))]
    )
    mesh = quads(far)
    labels = np.zeros(len(mesh.vertices), int)
    areas_m2 = SpectralMesh(mesh, np.ones((len(labels), 1)), NM[:1], labels == 0).areas_m2
    regions = connected_regions(mesh, labels, areas_m2, smallest_m2=0.5)
    assert [region.area_m2 for region in regions] == pytest.approx([4.0, 1.0])
    assert regions[0].centre_m == pytest.approx((4.0, 1.0, 0.0), abs=0.2)
    assert connected_regions(mesh, np.full(len(labels), UNCLASSIFIED), areas_m2, 0.0) == []


def test_what_was_not_seen_is_in_no_class_and_no_mean():
    surface = two_halves()
    hidden = SpectralMesh(surface.mesh, surface.spectra, NM, surface.mesh.vertices[:, 1] > 0.0)
    classes = classified(hidden, LIBRARY, 0.1)
    assert classes.areas_m2[1] == 0.0
    traits = analyse(hidden, classes=classes)
    assert [region.name for region in traits.regions] == [WHOLE, "green"]
    np.testing.assert_allclose(traits.regions[0].spectrum.mean, GREEN, rtol=1e-5)
    np.testing.assert_allclose(traits.regions[0].spectrum.sd, 0.0, atol=1e-6)
    assert traits.seen_m2 == pytest.approx(classes.areas_m2[0])


def test_indices_of_regions():
    surface = two_halves()
    maps = index_maps(surface, find_indices(["NDVI", "own = R700 - R600"], NM))
    surface = replace(surface, scatter=np.full(len(surface.seen), 0.02))
    traits = analyse(surface, [RegionOfInterest("spot", (0.0, 0.02, 0.02), 0.005)], pixel_m=0.001, maps=maps)
    at = {nm: GREEN[np.abs(NM - nm).argmin()] for nm in (670.0, 800.0)}
    whole, spot = traits.regions
    ndvi = spot.maps["NDVI"].surface
    assert ndvi.mean == pytest.approx((at[800.0] - at[670.0]) / (at[800.0] + at[670.0]), rel=1e-5)
    assert ndvi.sd == pytest.approx(0.0, abs=1e-6)
    assert whole.maps["NDVI"].surface.sd > 0.05
    assert spot.area_m2 == pytest.approx(np.pi * 0.005**2, rel=0.1)
    noise = 0.02 / np.sqrt(spot.area_m2 / 0.001**2)
    assert spot.maps["own"].std == pytest.approx(np.sqrt(2) * noise, rel=1e-3)
    slope = 2 * np.hypot(at[670.0], at[800.0]) / (at[670.0] + at[800.0]) ** 2
    assert spot.maps["NDVI"].std == pytest.approx(slope * noise, rel=1e-3)
    assert np.isnan(analyse(surface, maps=maps).regions[0].maps["NDVI"].std)


def test_tables_and_json_hold_maps():
    surface = two_halves()
    maps = index_maps(surface, find_indices(["NDVI"], NM))
    half = np.where(surface.mesh.vertices[:, 1] > 0.0, 12.0, np.nan)
    maps.append(SurfaceMap("sugar", "°Brix", half, lambda spectra: spectra[:, 0], 0.4, "", 0.03, limited=True))
    traits = analyse(surface, maps=maps)
    content = report.trait_content(Size(*[1.0] * 6), {}, True, traits, {})
    assert content["indices"] == ["NDVI = (R800 - R670) / (R800 + R670) [0, 1]"]
    tables = {table.heading: table for table in trait_tables(json.loads(json.dumps(content)))}
    assert tables["Indices"].header == ["region", "NDVI"]
    (row,) = tables["Calibrations"].rows
    assert row[:4] == [WHOLE, "sugar", "°Brix", "12 ± 0"]
    assert float(row[4].rstrip("%")) == pytest.approx(50.0, abs=2.0)
    assert "resampling changes sugar by 0.03" in tables["Calibrations"].note


def test_means_are_weighted_by_area():
    sides = ((0.0, 1.0), (3.0, 2.0))
    corners = [[[x, 0.0, 0.0], [x + s, 0.0, 0.0], [x + s, s, 0.0], [x, s, 0.0]] for x, s in sides]
    spectra = np.repeat(np.stack([GREEN, BROWN]), 4, axis=0).astype(np.float32)
    whole = analyse(SpectralMesh(quads(np.array(corners)), spectra, NM, np.ones(8, bool))).regions[0]
    np.testing.assert_allclose(whole.spectrum.mean, (GREEN + 4.0 * BROWN) / 5.0, rtol=1e-5)
    np.testing.assert_allclose(whole.spectrum.sd, 0.4 * np.abs(GREEN - BROWN), atol=1e-6)
    assert whole.area_m2 == pytest.approx(5.0)


def test_mean_and_sd_against_repeated_values():
    found = weighted_mean_and_sd(np.array([[1.0, 2.0], [3.0, np.nan], [5.0, 4.0]]), np.array([1.0, 2.0, 1.0]))
    np.testing.assert_allclose(found.mean, [np.mean([1, 3, 3, 5]), 3.0])
    np.testing.assert_allclose(found.sd, [np.std([1, 3, 3, 5]), 1.0])
    assert np.isnan(weighted_mean_and_sd(np.array([np.nan]), np.array([1.0])).mean)


def test_vertices_take_the_spectra_of_points_near_them():
    surface = two_halves()
    chosen = surface.mesh.vertices[:, 2] > 0.005
    points = surface.mesh.vertices[chosen]
    cloud = SpectralCloud(points, points, np.zeros((len(points), 3), np.uint8), surface.spectra[chosen], NM)
    found = with_spectra(surface.mesh, cloud, seen_within_m=0.001)
    assert (found.seen[chosen]).all()
    assert not found.seen[surface.mesh.vertices[:, 2] < 0.003].any()
    inside = chosen & (np.abs(surface.mesh.vertices[:, 1]) > 0.005) & (surface.mesh.vertices[:, 2] < 0.039)
    np.testing.assert_allclose(found.spectra[inside], surface.spectra[inside], rtol=1e-5)


@pytest.mark.parametrize("irradiance", [None, 0.5])
def test_a_region_at_the_edge_of_two_materials_is_uncertain_by_what_pixels_mix(irradiance):
    surface = replace(two_halves(), scatter=np.zeros(len(two_halves().seen)))
    surface.spectra[surface.mesh.vertices[:, 1] <= 0.0] *= 0.5
    if irradiance is not None:
        light = np.full(len(surface.seen), irradiance)
        surface = replace(surface, lit=LitSpectra(surface.spectra * irradiance, light, 0.0 * light))
    spots = [
        RegionOfInterest(name, (x_m, y_m, 0.02), 0.003)
        for name, x_m, y_m in (("in", 0.0, 0.02), ("edge", 0.0198, 0.003))
    ]
    maps = index_maps(surface, find_indices(["own = R700 - R600"], NM))
    _, inside, edge = analyse(surface, spots, pixel_m=0.002, maps=maps).regions
    assert inside.reflectance_std == pytest.approx(0.0, abs=1e-6)
    assert inside.maps["own"].std == pytest.approx(0.0, abs=1e-6)
    assert edge.reflectance_std == pytest.approx(0.08 * (GREEN.mean() - 0.5 * BROWN.mean()), rel=0.02)
    green, brown = (maps[0].of(one[None])[0] for one in (GREEN, 0.5 * BROWN))
    assert edge.maps["own"].std == pytest.approx(0.08 * abs(green - brown), rel=0.02)


def test_the_mean_of_a_region_scatters_as_its_pixels_and_shares_its_light():
    surface = replace(two_halves(), scatter=np.full(len(two_halves().seen), 0.02))
    spot = RegionOfInterest("spot", (0.0, 0.02, 0.02), 0.005)
    (_, alone), (_, finer) = (analyse(surface, [spot], pixel_m=pixel_m).regions for pixel_m in (0.002, 0.001))
    pixels = alone.area_m2 / 0.002**2
    assert alone.reflectance_std == pytest.approx(0.02 / np.sqrt(pixels), rel=1e-3)
    assert finer.reflectance_std == pytest.approx(alone.reflectance_std / 2, rel=1e-3)
    assert np.isnan(analyse(surface, [spot]).regions[1].reflectance_std)
    light = (np.full(len(surface.seen), value) for value in (0.5, 0.05))
    lit = replace(surface, lit=LitSpectra(surface.spectra / 2, *light))
    shared = 0.1 * alone.spectrum.mean.mean()
    expected = np.hypot(alone.reflectance_std / 0.5, shared)
    assert analyse(lit, [spot], pixel_m=0.002).regions[1].reflectance_std == pytest.approx(expected, rel=1e-3)


def shaded_cloud(surface):
    """A cloud whose lower half is lit by half, with the columns of `hsi-sc-nerf material`."""
    points = surface.mesh.vertices
    irradiance = np.where(points[:, 2] < 0.02, 0.5, 1.0).astype(np.float32)
    extra = dict(zip(band_property_names(NM, "material"), surface.spectra.T, strict=True))
    extra |= {"irradiance": irradiance, "irradiance_std": np.full(len(points), 0.03, np.float32)}
    colours = np.zeros((len(points), 3), np.uint8)
    return SpectralCloud(points, points, colours, surface.spectra * irradiance[:, None], NM, extra)


def test_a_cloud_by_material_gives_both_reflectances(tmp_path):
    surface = two_halves()
    found = with_spectra(surface.mesh, shaded_cloud(surface), seen_within_m=0.001)
    inside = (np.abs(surface.mesh.vertices[:, 1]) > 0.005) & (np.abs(surface.mesh.vertices[:, 2] - 0.02) > 0.003)
    np.testing.assert_allclose(found.spectra[inside], surface.spectra[inside], rtol=1e-4)
    spots = [RegionOfInterest(name, (0.0, 0.02, z_m), 0.004) for name, z_m in (("low", 0.01), ("high", 0.03))]
    _, low, high = analyse(found, spots).regions
    np.testing.assert_allclose(low.spectrum.mean, GREEN, rtol=1e-3)
    np.testing.assert_allclose(low.light.measured.mean, GREEN / 2, rtol=1e-3)
    np.testing.assert_allclose(high.light.measured.mean, GREEN, rtol=1e-3)
    assert low.light.irradiance.mean == pytest.approx(0.5, abs=1e-3)
    # What the region's points share does not shrink with their number.
    assert low.light.irradiance_std == pytest.approx(0.03)
    write_spectral_mesh(tmp_path / "mesh.ply", found, {})
    read = read_spectral_ply(tmp_path / "mesh.ply")
    np.testing.assert_allclose(read.spectra, found.lit.measured)
    np.testing.assert_allclose(material_spectra(read), found.spectra)
    write_spectra(tmp_path / "spectra.csv", NM, analyse(found, spots))
    titles = (tmp_path / "spectra.csv").read_text().splitlines()[0].split(",")
    assert titles[5:9] == ["low material mean", "low material SD", "low measured mean", "low measured SD"]


def test_a_cloud_that_has_lost_its_irradiance_is_one_of_the_material_all_the_same():
    """As CloudCompare saves it if that field was not chosen; what follows from the light is not known then."""
    surface = two_halves()
    cloud = shaded_cloud(surface)
    del cloud.extra["irradiance"]
    whole, lost = (with_spectra(surface.mesh, one, seen_within_m=0.001) for one in (shaded_cloud(surface), cloud))
    np.testing.assert_array_equal(lost.spectra, whole.spectra)
    np.testing.assert_array_equal(lost.lit.measured, whole.lit.measured)
    traits = analyse(replace(lost, scatter=np.full(len(lost.seen), 0.01)), pixel_m=0.001)
    assert np.isnan([traits.regions[0].light.irradiance.mean, traits.regions[0].reflectance_std]).all()
    _, reflectance, *_ = trait_tables(report.trait_content(Size(*[1.0] * 6), {}, True, traits, {}))
    assert reflectance.rows[0][-1].startswith("nan")


def test_points_whose_material_is_not_known_give_no_spectrum():
    """As `sample --material` leaves them further than 3 mm from the material's cloud."""
    surface = two_halves()
    cloud = shaded_cloud(surface)
    far = cloud.points[:, 1] < 0.0
    for name in (*band_property_names(NM, "material"), "irradiance", "irradiance_std"):
        cloud.extra[name][far] = np.nan
    found = with_spectra(surface.mesh, cloud, seen_within_m=0.001)
    assert np.isfinite(found.spectra).all()
    assert not found.seen[cloud.points[:, 1] < -0.002].any()
    assert found.seen[~far].all()
    assert classified(found, LIBRARY, 0.1).names == LIBRARY.names
    with pytest.raises(InputError, match="known material"):
        with_spectra(surface.mesh, replace(cloud, spectra=np.where(far[:, None], cloud.spectra, np.nan)), 0.001)


@pytest.mark.parametrize(("spectrum", "incidence_deg"), [(9.0, 71.0), (np.nan, 0.0)])
def test_points_seen_too_obliquely_or_without_a_spectrum_give_none(spectrum, incidence_deg):
    surface = two_halves()
    points = surface.mesh.vertices
    left = points[:, 1] < 0.0
    spectra = np.where(left[:, None], spectrum, surface.spectra).astype(np.float32)
    colours = np.zeros((len(points), 3), np.uint8)
    cloud = SpectralCloud(points, points, colours, spectra, NM, {INCIDENCE: np.where(left, incidence_deg, 69.0)})
    found = with_spectra(surface.mesh, cloud, 0.001, max_incidence_deg=70.0)
    assert found.spectra.max() <= 1.0
    assert not found.seen[points[:, 1] < -0.002].any()
    assert found.seen[~left].all()
    assert with_spectra(surface.mesh, cloud, 0.001).seen.all() == np.isfinite(spectrum)
    with pytest.raises(InputError, match=r"no point .* at 60 degrees or less"):
        with_spectra(surface.mesh, cloud, 0.001, max_incidence_deg=60.0)
    with pytest.raises(InputError, match="no point of the cloud has a spectrum"):
        with_spectra(surface.mesh, replace(cloud, spectra=np.full_like(spectra, np.nan)), 0.001)


@pytest.mark.parametrize("bands", [slice(None), slice(25, 26)])
def test_mesh_is_a_cloud_with_triangles(tmp_path, bands):
    import open3d as o3d

    surface = two_halves()
    surface = replace(surface, spectra=surface.spectra[:, bands], wavelengths_nm=NM[bands])
    write_spectral_mesh(tmp_path / "mesh.ply", surface, {"class": np.ones(len(surface.seen))})
    read = read_spectral_ply(tmp_path / "mesh.ply")
    np.testing.assert_allclose(read.spectra, surface.spectra)
    assert sorted(read.extra) == ["class", "seen"]
    triangles = o3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    np.testing.assert_array_equal(np.asarray(triangles.triangles), surface.mesh.triangles)
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.ply"]


@pytest.mark.parametrize(("width_m", "height_m", "columns"), [(0.02, 0.05, 168), (0.1, 0.005, 840)])
def test_pictures_hold_tall_and_flat_objects(width_m, height_m, columns):
    for hit, *_ in SideViews(cylinder(width_m, height_m, segments=64)).sides:
        assert hit.shape == pytest.approx((420, columns), abs=1)
        assert np.ptp(np.flatnonzero(hit.any(axis=0))) == pytest.approx(columns / 1.04, rel=0.01)
        assert hit.any(axis=1).mean() == pytest.approx(height_m / width_m * columns / 420 / 1.04, rel=0.05)


def test_a_region_with_the_name_of_a_class_is_refused_before_the_cloud_is_looked_at():
    library = SpectralLibrary(("skin", "bruise", "bruise"), NM, np.ones((3, len(NM))))
    with pytest.raises(InputError, match="two regions or classes are named bruise"):
        measure_traits(None, library=library, regions={"bruise": (0.0, 0.0, 0.0, 0.01)})


@pytest.mark.slow
def test_the_whole_surface_in_a_library_is_no_class():
    """As in the regions.sli of another object, which has its mean beside those of its classes and regions."""
    from_traits = SpectralLibrary(
        (*LIBRARY.names, WHOLE), NM, np.vstack([LIBRARY.spectra, LIBRARY.spectra.mean(axis=0)])
    )
    assert class_references(from_traits, NM).names == LIBRARY.names
    cloud = fruit_cloud(count=4000)
    config = MeshConfig(octree_depth=5, smoothing_radius_m=0.004)
    library = SpectralLibrary(("skin", WHOLE), FRUIT_NM, np.stack([SKIN, SKIN]))
    alone, beside = (measure_traits(cloud, splits=0, mesh=config, library=given) for given in (None, library))
    assert beside.traits.classes.names == ("skin",)
    assert beside.traits.seen_m2 == alone.traits.seen_m2
    np.testing.assert_array_equal(
        beside.region_spectra().spectra[0], alone.region_spectra().spectra[0], err_msg="the whole surface"
    )
    with pytest.raises(InputError, match="only the mean of the whole surface"):
        measure_traits(cloud, library=SpectralLibrary((WHOLE,), FRUIT_NM, SKIN[None]))
    with pytest.raises(InputError, match="are named whole surface"):
        measure_traits(None, regions={WHOLE: (0.0, 0.0, 0.0, 0.01)})


def test_regions_off_the_surface_or_of_one_name_are_refused():
    surface = two_halves()
    with pytest.raises(InputError, match="no seen surface within"):
        analyse(surface, [RegionOfInterest("spot", (0.1, 0.0, 0.0), 0.005)])
    with pytest.raises(InputError, match="radius above 0"):
        RegionOfInterest("spot", (0.0, 0.0, 0.0), 0.0)
    spot = RegionOfInterest("spot", (0.0, 0.02, 0.02), 0.005)
    with pytest.raises(InputError, match="two regions are named spot"):
        analyse(surface, [spot, spot])
    ndvi = index_maps(surface, find_indices(["NDVI"], NM))
    with pytest.raises(InputError, match="two indices or calibrations are named NDVI"):
        analyse(surface, maps=ndvi * 2)
    with pytest.raises(InputError, match="raise the smoothing radius"):
        analyse(two_halves(seen=False))


def test_ideal_cloud_holds_what_cameras_see():
    surface = two_halves()
    weights = (surface.mesh.vertices[:, 1:2] > 0.0) * [1.0, -1.0] + [0.0, 1.0]
    true = TrueObject(("green", "brown"), surface.mesh, weights, LIBRARY.spectra, NM)
    cloud = true.cloud(5000, np.array([[0.5, 0.0, 0.2]]), noise_m=0.0)
    # Of the base, nothing but its rim.
    assert ((cloud.points[:, 2] > 1e-4) | (np.hypot(*cloud.points[:, :2].T) > 0.0195)).all()
    assert ((cloud.points[:, 0] > -1e-3) | (cloud.points[:, 2] > 0.0399)).all()
    away = np.abs(cloud.points[:, 1]) > 0.002
    expected = np.where(cloud.points[away, 1:2] > 0.0, GREEN, BROWN)
    np.testing.assert_allclose(cloud.spectra[away], expected, atol=1e-4)
    assert relative_rms(1.02 * GREEN, GREEN) == pytest.approx(0.02)
