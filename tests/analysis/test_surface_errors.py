"""How uncertain surfaces are, on a ball that cameras around it see, with and without a dent."""

import capture_factory as factory
import numpy as np
import pytest

from hsi_sc_nerf.analysis.surface_errors import (
    HOLLOW_FRACTION,
    MOST_OBLIQUE,
    SURFACE_PX,
    hollow_std_m,
    most_frontal_cosine,
    surface_std_m,
)
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate.mesh import revolve

POSES = np.stack([factory.true_pose(angle_deg) for angle_deg in range(0, 360, 15)])
PIXEL_M = np.linalg.norm(POSES[0, :3, 3] - factory.SPHERE_CENTRE_M) / factory.INTRINSICS.fl_x


def ball() -> Mesh:
    angle = np.linspace(-np.pi / 2, np.pi / 2, 80)
    profile = factory.SPHERE_RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    profile[[0, -1], 0] = 0.0
    return revolve(profile, 160).moved(factory.SPHERE_CENTRE_M)


def outward(mesh: Mesh) -> np.ndarray:
    return (mesh.vertices - factory.SPHERE_CENTRE_M) / factory.SPHERE_RADIUS_M


def hollow_of(mesh: Mesh, masks: np.ndarray) -> np.ndarray:
    cosine = most_frontal_cosine(mesh, POSES[:, :3, 3])
    return hollow_std_m(mesh, cosine, masks, POSES, factory.INTRINSICS, PIXEL_M)


def test_the_more_obliquely_a_surface_is_seen_the_less_is_known_of_its_place():
    mesh = ball()
    std_m = surface_std_m(most_frontal_cosine(mesh, POSES[:, :3, 3]), PIXEL_M)
    towards = POSES[:, None, :3, 3] - mesh.vertices
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    cosine = np.einsum("fvi,vi->fv", towards, outward(mesh)).max(axis=0)
    np.testing.assert_allclose(most_frontal_cosine(mesh, POSES[:, :3, 3]), cosine, atol=0.01)
    np.testing.assert_allclose(std_m, SURFACE_PX * PIXEL_M / np.maximum(cosine, MOST_OBLIQUE), rtol=0.04)
    assert std_m[mesh.vertices[:, 2].argmin()] == pytest.approx(SURFACE_PX * PIXEL_M / MOST_OBLIQUE)


def test_a_dent_is_uncertain_by_its_depth_below_the_outlines():
    mesh, masks = ball(), np.stack([factory.sphere_mask(pose) for pose in POSES])
    side = outward(mesh) @ [1.0, 0.0, 0.0] > 0.95
    dented = Mesh(mesh.vertices - 5.0 * PIXEL_M * side[:, None] * outward(mesh), mesh.triangles)
    whole, hollow = (hollow_of(one, masks) for one in (mesh, dented))
    assert whole.max() <= HOLLOW_FRACTION * PIXEL_M
    assert (whole > 0.0).mean() < 0.02
    middle = outward(mesh) @ [1.0, 0.0, 0.0] > 0.97
    # Depths count from one pixel below the hull, in whole pixels.
    assert hollow[middle].max() == pytest.approx(4.0 * HOLLOW_FRACTION * PIXEL_M)
    assert hollow[middle].min() >= 2.99 * HOLLOW_FRACTION * PIXEL_M
    assert hollow[outward(mesh) @ [1.0, 0.0, 0.0] < 0.9].max() <= HOLLOW_FRACTION * PIXEL_M


def test_where_no_camera_looks_the_hull_tells_of_no_hollow():
    mesh = ball()
    masks = np.ones((len(POSES), factory.INTRINSICS.h, factory.INTRINSICS.w), bool)
    std_m = hollow_of(mesh, masks)
    unseen = most_frontal_cosine(mesh, POSES[:, :3, 3]) <= MOST_OBLIQUE
    assert unseen.any()
    assert (std_m[unseen] == 0.0).all()
    assert (std_m[~unseen] > 0.0).all()
