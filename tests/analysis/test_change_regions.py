"""Outlines of changed areas on a plane, against circles."""

import numpy as np
import pytest

from hsi_sc_nerf.analysis.change_regions import changed_regions, grown_regions
from hsi_sc_nerf.analysis.change_significance import surface_patches
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate.materials import smoothstep

STEP_M = 0.0005
SIDE = 120


@pytest.fixture(scope="module")
def plane():
    x, y = np.meshgrid(np.arange(SIDE) * STEP_M, np.arange(SIDE) * STEP_M)
    corner = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + SIDE + 1], axis=-1)
    upper = np.stack([corner, corner + SIDE + 1, corner + SIDE], axis=-1)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    return Mesh(points, np.concatenate([lower, upper])), np.full(x.size, STEP_M**2)


def disc(plane, x_m, radius_m):
    """1 inside, 0 outside, and an edge of 4 mm."""
    off_m = np.linalg.norm(plane[0].vertices - [x_m, 0.03, 0.0], axis=1)
    return smoothstep((radius_m - off_m) / 0.004 + 0.5)


def outlined(plane, change, noise=0.02, smallest_m2=5e-6, before=None):
    mesh, areas_m2 = plane
    patches = surface_patches(mesh.vertices, areas_m2, np.ones(len(areas_m2), bool))
    significant = np.linalg.norm(patches.means(change, areas_m2), axis=1) > 0.3
    before = np.zeros_like(change) if before is None else before
    return changed_regions(
        mesh, areas_m2, patches, before, change, significant, np.full(change.shape[1], noise), smallest_m2
    )


def test_a_blurred_disc_has_the_area_of_the_disc(plane):
    labels, (region,) = outlined(plane, disc(plane, 0.03, 0.01)[:, None])
    assert region.area_m2 == pytest.approx(np.pi * 0.01**2, rel=0.03)
    assert region.area_m2 == pytest.approx(plane[1][labels == 0].sum())
    assert region.centre_m == pytest.approx((0.03, 0.03, 0.0), abs=3e-4)
    # 0.02 of the height of an edge of 4 mm.
    assert 0.0 < region.area_sd_m2 < 0.05 * region.area_m2


@pytest.mark.parametrize("direction", [[-1.0], [0.6, 0.8, 0.0]])
def test_growth_by_a_ring_is_the_rings_area_in_any_direction_of_change(plane, direction):
    ring = disc(plane, 0.03, 0.013) - disc(plane, 0.03, 0.009)
    _, (region,) = outlined(plane, ring[:, None] * direction)
    assert region.area_m2 == pytest.approx(np.pi * (0.013**2 - 0.009**2), rel=0.06)


@pytest.mark.parametrize("direction", [[-1.0], [0.6, 0.8, 0.0]])
def test_a_ring_that_is_as_narrow_as_its_edges_has_the_area_between_both_days_edges(plane, direction):
    """Its change has no plateau; what it is to reach is seen inside, where nothing changed."""
    before, after = (disc(plane, 0.03, radius_m)[:, None] * direction for radius_m in (0.009, 0.0116))
    _, (region,) = outlined(plane, after - before, before=before)
    true_m2 = np.pi * (0.0116**2 - 0.009**2)
    assert region.area_m2 == pytest.approx(true_m2, rel=0.06)
    _, (of_change_alone,) = outlined(plane, after - before)
    assert of_change_alone.area_m2 > 1.1 * true_m2


def test_other_colours_of_the_surface_do_not_move_the_edge_far(plane):
    """One side is brighter by three times what changed."""
    bright = 3.0 * (plane[0].vertices[:, :1] > 0.03)
    _, (region,) = outlined(plane, disc(plane, 0.03, 0.01)[:, None], before=bright)
    assert region.area_m2 == pytest.approx(np.pi * 0.01**2, rel=0.1)


def test_what_rose_and_what_fell_are_two_regions_and_small_ones_are_left_out(plane):
    change = (disc(plane, 0.02, 0.008) - disc(plane, 0.042, 0.006))[:, None]
    labels, regions = outlined(plane, change)
    assert [round(region.centre_m[0], 3) for region in regions] == [0.02, 0.042]
    assert set(labels.tolist()) == {-1, 0, 1}
    labels, regions = outlined(plane, change, smallest_m2=1.5e-4)
    assert len(regions) == 1
    assert set(labels.tolist()) == {-1, 0}


def test_without_a_significant_patch_there_is_no_region(plane):
    labels, regions = outlined(plane, np.zeros((len(plane[1]), 1)))
    assert regions == []
    assert (labels == -1).all()


def test_a_region_that_grew_one_that_is_new_and_one_that_is_gone(plane):
    before = (disc(plane, 0.02, 0.006) > 0.5) | (disc(plane, 0.05, 0.004) > 0.5)
    after = (disc(plane, 0.021, 0.008) > 0.5) | (disc(plane, 0.037, 0.003) > 0.5)
    found = grown_regions(*plane, before, after)
    expected = [(np.pi * 0.006**2, np.pi * 0.008**2), (np.pi * 0.004**2, 0.0), (0.0, np.pi * 0.003**2)]
    assert [one.before_m2 for one in found] == pytest.approx([a for a, _ in expected], rel=0.05)
    assert [one.after_m2 for one in found] == pytest.approx([b for _, b in expected], rel=0.05)
