"""Traits of a simulated apple with a bruise, whose truth is known; and the whole command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from true_object import TrueObject, relative_rms

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed_mesh, open_edges
from hsi_sc_nerf.analysis.library import SpectralLibrary, read_library
from hsi_sc_nerf.analysis.size import size_of
from hsi_sc_nerf.analysis.spectral_mesh import with_spectra
from hsi_sc_nerf.analysis.traits import RegionOfInterest, classified, region_spectrum
from hsi_sc_nerf.cli.clouds import TraitsCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import SpectralCloud, read_spectral_ply, write_spectral_ply
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate.materials import endmembers
from hsi_sc_nerf.simulate.mesh import cylinder
from hsi_sc_nerf.simulate.plants import FRUIT_MATERIALS, apple, fruit_weights
from hsi_sc_nerf.simulate.scene import Fruit

NM = np.linspace(400.0, 1000.0, 25)
STAND_M = 0.07
NOISE_M = 0.0003


def eyes_around(count=8):
    """Cameras half a metre away, 22 degrees above the horizon."""
    azimuth = 2.0 * np.pi * np.arange(count) / count
    return np.stack([0.42 * np.cos(azimuth), 0.42 * np.sin(azimuth), np.full(count, 0.28)], axis=-1)


@pytest.fixture(scope="module")
def true_apple():
    rng = np.random.default_rng(3)
    fruit = Fruit("apple", height_m=0.075, bruise_diameter_m=0.026)
    shape = apple(fruit.height_m, rng)
    mesh = shape.mesh.moved(np.array([0.0, 0.0, STAND_M]))
    materials = FRUIT_MATERIALS["apple"]
    return TrueObject(materials, mesh, fruit_weights(shape, fruit, rng), endmembers(materials, NM), NM)


@pytest.fixture(scope="module")
def measured_apple(true_apple):
    cloud = true_apple.cloud(50_000, eyes_around(), NOISE_M)
    mesh = closed_mesh(cloud.points, cloud.normals, MeshConfig(octree_depth=7, base_height_m=STAND_M))
    return with_spectra(mesh, cloud, MeshConfig().smoothing_radius_m)


@pytest.fixture(scope="module")
def ideal_apple(true_apple):
    return true_apple.spectral_mesh(eyes_around())


@pytest.mark.slow
def test_area_is_within_three_and_volume_within_two_percent(true_apple, measured_apple):
    measured, true = size_of(measured_apple.mesh), size_of(true_apple.mesh)
    assert open_edges(measured_apple.mesh) == 0
    assert measured.area_m2 == pytest.approx(true.area_m2, rel=0.03)
    assert measured.volume_l == pytest.approx(true.volume_l, rel=0.02)
    assert measured.height_m == pytest.approx(true.height_m, rel=0.01)
    assert measured.largest_diameter_m == pytest.approx(true.largest_diameter_m, rel=0.01)
    assert measured.smallest_diameter_m == pytest.approx(true.smallest_diameter_m, rel=0.01)


@pytest.mark.slow
def test_only_the_base_and_the_basin_around_the_stalk_were_not_seen(true_apple, measured_apple):
    hidden = measured_apple.mesh.vertices[~measured_apple.seen]
    assert 0.02 < (~measured_apple.seen).mean() < 0.2
    in_basin = hidden[hidden[:, 2] >= STAND_M + 0.006]
    assert len(in_basin) < 0.002 * len(measured_apple.seen)
    assert np.hypot(in_basin[:, 0], in_basin[:, 1]).max() < 0.006
    assert true_apple.seen(in_basin, eyes_around()).mean() < 0.25


@pytest.mark.slow
def test_the_seen_area_does_not_reach_beyond_the_points(ideal_apple, measured_apple):
    """All vertices within 2 mm of a point would be 2.5 % too many."""
    measured, true = (one.areas_m2[one.seen].sum() for one in (measured_apple, ideal_apple))
    assert measured == pytest.approx(true, rel=0.012)


@pytest.mark.slow
def test_spectra_of_spots_are_within_two_percent(ideal_apple, measured_apple):
    high = np.flatnonzero(ideal_apple.seen & (ideal_apple.mesh.vertices[:, 2] > STAND_M + 0.01))
    for vertex in np.random.default_rng(0).choice(high, 8):
        spot = RegionOfInterest("spot", tuple(ideal_apple.mesh.vertices[vertex].tolist()), 0.005)
        measured, true = (region_spectrum(one, spot.of(one)) for one in (measured_apple, ideal_apple))
        assert relative_rms(measured.mean, true.mean) < 0.02


@pytest.mark.slow
def test_bruise_area_is_within_ten_percent_of_the_true_surface_classified_alike(
    ideal_apple, measured_apple, true_apple
):
    names = ("apple_skin", "bruise")
    spectra = true_apple.endmembers[[true_apple.materials.index(name) for name in names]]
    library = SpectralLibrary(names, NM, spectra)
    measured, true = (classified(one, library, 0.1) for one in (measured_apple, ideal_apple))
    assert measured.areas_m2[1] == pytest.approx(true.areas_m2[1], rel=0.1)
    assert [region.label for region in measured.regions].count(1) >= 1


@pytest.mark.slow
def test_bruise_area_by_mixture_is_within_three_percent_of_where_it_has_most(ideal_apple, measured_apple, true_apple):
    spectra = SpectralLibrary(true_apple.materials, NM, true_apple.endmembers)
    measured = classified(measured_apple, spectra, 0.1)
    bruise = true_apple.materials.index("bruise")
    most = ideal_apple.seen & (true_apple.weights[:, bruise] > 0.5)
    assert measured.mixture_areas_m2[bruise] == pytest.approx(ideal_apple.areas_m2[most].sum(), rel=0.03)


def small_cloud(path):
    """A green and brown cylinder as the command's input."""
    mesh: Mesh = cylinder(0.04, 0.05, segments=96, spacing_m=0.001).moved(np.array([0.0, 0.0, STAND_M]))
    weights = np.eye(2)[(mesh.vertices[:, 1] > 0.0).astype(int)]
    true = TrueObject(("skin", "bruise"), mesh, weights, endmembers(("apple_skin", "bruise"), NM), NM)
    cloud = true.cloud(6000, eyes_around(), 0.0)
    write_spectral_ply(path, replace(cloud, extra={}))
    return true


@pytest.mark.slow
def test_command_writes_all_results(tmp_path, capsys):
    true = small_cloud(tmp_path / "cloud.ply")
    rows = [f"{nm},{skin},{bruise}" for nm, skin, bruise in zip(NM, *true.endmembers, strict=True)]
    (tmp_path / "library.csv").write_text("\n".join(["wavelength_nm,skin,bruise", *rows]))
    (tmp_path / "sum.csv").write_text("# unit: %\n# intercept: 0\nwavelength_nm,coefficient\n600,1\n700,1\n")
    # Brackets would be taken for colours of the terminal.
    output = tmp_path / "out[bold]"
    TraitsCommand(
        tmp_path / "cloud.ply",
        output,
        mesh=MeshConfig(octree_depth=5, base_height_m=STAND_M),
        splits=1,
        library=tmp_path / "library.csv",
        roi=(("spot", 0.0, 0.02, STAND_M + 0.025, 0.006),),
        index=("PRI", "own = R800 / R670"),
        calibration=(tmp_path / "sum.csv",),
        components=4,
    ).main()
    assert str(output / "traits.md") in capsys.readouterr().err
    written = {path.name for path in output.iterdir()}
    pictures = ("components", "composites", "endmembers", "indices", "calibrations", "classes", "classes_by_mixture")
    assert written == {
        *("traits.md", "traits.json", "spectra.csv", "endmembers.csv", "mesh.ply", "region_spectra.png"),
        *("regions.sli", "regions.hdr"),
        *(f"{picture}.png" for picture in pictures),
    }
    content = json.loads((output / "traits.json").read_text())
    assert content["watertight"]
    assert content["size"]["area_m2"] == pytest.approx(true.mesh.area_m2(), rel=0.03)
    assert content["size"]["volume_l"] == pytest.approx(1000.0 * true.mesh.volume_m3(), rel=0.03)
    assert content["size_sd"]["volume_l"] > 0.0
    side_m2 = (content["seen_area_m2"]) / 2.0
    for area in ("areas_m2", "mixture_areas_m2"):
        assert content["classes"][area] == pytest.approx({"skin": side_m2, "bruise": side_m2}, rel=0.1)
    assert content["regions"]["spot"]["area_m2"] == pytest.approx(np.pi * 0.006**2, rel=0.15)
    table = np.loadtxt(output / "spectra.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table[:, 0], NM, rtol=1e-5)
    np.testing.assert_allclose(table[:, -2], true.endmembers[1], atol=0.002)
    regions = read_library(output / "regions.sli")
    assert regions.names == ("whole surface", "skin", "bruise", "spot")
    np.testing.assert_allclose(regions.spectra[-1], table[:, -2], rtol=1e-5)
    mesh = read_spectral_ply(output / "mesh.ply")
    assert len(mesh.points) > 1000
    assert {"index_PRI", "index_own", "calibration_sum", "component_1", "endmember_1"} <= set(mesh.extra)
    assert read_library(output / "endmembers.csv").names[0] == "endmember 1"
    spot = content["regions"]["spot"]
    at = [true.endmembers[1][np.abs(NM - nm).argmin()] for nm in (600, 700, 800, 670)]
    assert spot["calibrations"]["sum"]["mean"] == pytest.approx(at[0] + at[1], rel=0.02)
    assert spot["indices"]["own"]["mean"] == pytest.approx(at[2] / at[3], rel=0.02)
    page = (output / "traits.md").read_text()
    assert "watertight" in page
    assert all(f"({name})" in page for name in written if name.endswith(".png"))


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"splits": -1}, "--splits is -1"),
        ({"classes": ("bruise",)}, "give it with --library"),
        ({"mesh": MeshConfig(octree_depth=20)}, "octree-depth is 20"),
        ({"mesh": MeshConfig(octree_depth=4)}, "octree-depth is 4"),
        ({"mesh": MeshConfig(smoothing_radius_m=0.0)}, "smoothing-radius-m is 0.0"),
        ({"angle_rad": 0.0}, "--angle-rad is 0.0"),
        ({"angle_rad": 10.0}, "--angle-rad is 10.0"),
        ({}, "no such file"),
    ],
)
def test_command_refuses_what_it_cannot_use(tmp_path, settings, says):
    with pytest.raises(InputError, match=says):
        TraitsCommand(tmp_path / "cloud.ply", tmp_path / "out", **settings).main()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("bands", "says"), [(slice(None), "covers the cloud"), (slice(3, 4), "has one band")])
def test_a_library_that_does_not_fit_is_refused_before_the_work(tmp_path, bands, says):
    """A cloud of two points, which no mesh can be made of, shows which of the two is noticed first."""
    nothing = np.zeros((2, 3))
    cloud = SpectralCloud(nothing, nothing, nothing.astype(np.uint8), np.ones((2, len(NM[bands]))), NM[bands])
    write_spectral_ply(tmp_path / "cloud.ply", cloud)
    (tmp_path / "library.csv").write_text("nm,a\n450,0.1\n900,0.2\n")
    with pytest.raises(InputError, match=says):
        TraitsCommand(tmp_path / "cloud.ply", tmp_path / "out", library=tmp_path / "library.csv").main()
