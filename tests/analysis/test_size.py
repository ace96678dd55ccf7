"""Uncertainty of sizes, against spheres whose sizes change by a known amount."""

import numpy as np
import pytest
from ball_run import write_ball_dataset
from standing_sphere import RADIUS_M, STAND_M, sphere_points

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed_mesh
from hsi_sc_nerf.analysis.size import (
    Size,
    SystematicErrors,
    combined,
    offset,
    scale_uncertainty,
    size_of,
    size_uncertainty,
    sizes_to_find,
    systematic_errors,
)
from hsi_sc_nerf.analysis.surface_errors import SURFACE_PX
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.packed.dataset import open_packed

CONFIG = MeshConfig(octree_depth=5, smoothing_radius_m=0.003, base_height_m=STAND_M)


def uncertainty(cloud, splits=0, done=int):
    """Without errors that points share, for which alone the mesh is needed."""
    return size_uncertainty(*cloud, None, CONFIG, splits, None, done)


@pytest.mark.slow
def test_scatter_from_halves_is_that_of_independent_clouds():
    clouds = [sphere_points(3000, seed, 0.0005, above=-0.93) for seed in range(11)]
    volumes = [size_of(closed_mesh(*cloud, CONFIG)).volume_l for cloud in clouds[1:]]
    told = []
    parts = uncertainty(clouds[0], splits=5, done=told.append)
    assert told == list(range(1, sizes_to_find(5, None) + 1))
    # The ratio of a spread from five differences to one of ten clouds is 0.4 to 1.9 nineteen times in twenty.
    assert 0.35 < parts["points"].volume_l / np.std(volumes, ddof=1) < 2.2


@pytest.fixture(scope="module")
def smooth_parts():
    """Of a smooth sphere whose points share errors."""
    cloud, told = sphere_points(6000, above=-0.93), []
    mesh = closed_mesh(*cloud, CONFIG)
    everywhere = np.ones(len(mesh.vertices))
    systematic = SystematicErrors(0.01, 0.001, surface_m=0.0003 * everywhere, hollow_m=0.0002 * everywhere)
    parts = size_uncertainty(*cloud, mesh, CONFIG, 0, systematic, told.append)
    assert told[-1] == sizes_to_find(0, systematic)
    return parts


@pytest.mark.slow
def test_what_points_share_changes_a_sphere_as_calculus_says(smooth_parts):
    parts = smooth_parts
    area_m2, volume_l = 4 * np.pi * RADIUS_M**2, 4000 * np.pi * RADIUS_M**3 / 3
    assert parts["scale"].area_m2 == pytest.approx(0.02 * area_m2, rel=0.02)
    assert parts["scale"].volume_l == pytest.approx(0.03 * volume_l, rel=0.02)
    assert parts["scale"].height_m == pytest.approx(0.01 * 2 * RADIUS_M, rel=0.02)
    assert parts["surface"].volume_l == pytest.approx(1000 * area_m2 * 0.0003, rel=0.05)
    assert parts["surface"].largest_diameter_m == pytest.approx(0.0006, rel=0.05)
    assert parts["hollows"].volume_l == pytest.approx(1000 * area_m2 * 0.0002, rel=0.05)
    # The base does not move down: the sphere grows at its top alone.
    assert parts["surface"].height_m == pytest.approx(0.0003, rel=0.1)
    assert parts["base"].height_m == pytest.approx(0.001, rel=0.2)


@pytest.mark.slow
def test_the_more_of_the_base_is_unseen_the_less_is_known():
    seen, unseen = (uncertainty(sphere_points(6000, above=above))["base"] for above in (-0.97, -0.8))
    assert seen.volume_l < 0.3 * unseen.volume_l
    # A cylinder around the unseen cap is what the sphere could be at most.
    assert unseen.volume_l < 1000 * np.pi * (0.6 * RADIUS_M) ** 2 * 0.2 * RADIUS_M


@pytest.mark.slow
def test_detail_that_smoothing_changes_is_uncertain(smooth_parts):
    points, normals = sphere_points(6000, above=-0.93)
    ripples = 0.001 * np.sin(2 * np.pi * points[:, 2] / 0.012)
    rough = points + ripples[:, None] * normals
    assert uncertainty((rough, normals))["detail"].area_m2 > 3 * smooth_parts["detail"].area_m2


def test_an_object_too_small_to_be_smoothed_twice_as_much_is_told_before_it_is_measured():
    points, normals = sphere_points(6000, above=-0.93)
    grain = 0.15 * (points - [0.0, 0.0, STAND_M]) + [0.0, 0.0, STAND_M], normals
    closed_mesh(*grain, CONFIG)
    with pytest.raises(InputError, match=r"also needs twice the smoothing radius, and .* of 0\.006 m.* lower the"):
        uncertainty(grain, done=pytest.fail)


def test_causes_add_up_in_squares():
    parts = {"points": Size(*[3.0] * 6), "scale": Size(*[4.0] * 6)}
    assert combined(parts) == Size(*[5.0] * 6)


def test_an_offset_base_stays_on_what_it_stands_on():
    mesh = closed_mesh(*sphere_points(6000, above=-0.8), CONFIG)
    moved = offset(mesh, np.full(len(mesh.vertices), 0.001))
    assert moved.vertices[:, 2].min() == pytest.approx(mesh.vertices[:, 2].min(), abs=2e-4)
    assert np.ptp(moved.vertices[:, 0]) == pytest.approx(np.ptp(mesh.vertices[:, 0]) + 0.002, abs=2e-4)


def test_a_dataset_tells_scale_and_pixels(tmp_path):
    dataset = open_packed(write_ball_dataset(tmp_path))
    eye_m = dataset.frames[0].camera_to_world[:3, 3]
    pixel_m = np.linalg.norm(eye_m - dataset.object_box_m.mean(axis=0)) / dataset.intrinsics.fl_x
    mesh = closed_mesh(*sphere_points(3000, above=-0.93), CONFIG)
    known, unknown = (systematic_errors(mesh, dataset, base_known=known) for known in (True, False))
    assert known.scale == 0.0
    assert known.surface_m.min() == pytest.approx(SURFACE_PX * pixel_m, rel=0.02)
    assert known.hollow_m.shape == known.surface_m.shape == (len(mesh.vertices),)
    assert unknown.base_m > known.base_m
    write_json(dataset.root / "poses.json", {"scale": {"uncertainty_percent": 0.5}})
    assert systematic_errors(mesh, dataset, base_known=True).scale == pytest.approx(0.005)


@pytest.mark.parametrize(
    "scale", [5, "wide", [1], {"uncertainty_percent": "a"}, {"uncertainty_percent": [1]}, {"uncertainty_percent": -1}]
)
def test_a_damaged_scale_is_refused_and_a_missing_one_is_not_known(tmp_path, scale):
    path = tmp_path / "poses.json"
    assert scale_uncertainty(path) == 0.0
    write_json(path, {"scale": None})
    assert scale_uncertainty(path) == 0.0
    write_json(path, {"scale": scale})
    with pytest.raises(InputError, match=r"^[^\n]*poses\.json: holds no uncertainty of the scale[^\n]*\.$"):
        scale_uncertainty(path)
