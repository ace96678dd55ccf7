"""How points of a known ball change from view to view, and points of a hull as the frames see them."""

from dataclasses import replace

import numpy as np
import pytest
from capture_factory import INTRINSICS, SPHERE_CENTRE_M, SPHERE_RADIUS_M, sphere_mask, true_pose
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, pixel_rays
from hsi_sc_nerf.processing.view_changes import (
    COLOURS,
    MAX_INCIDENCE_DEG,
    PointViews,
    change_of,
    change_with_direction,
    change_with_height,
    colours_of,
    point_views,
)
from hsi_sc_nerf.processing.visual_hull import VotedHull, voted_hull

FRAMES, CHANNELS = 24, 3
NOISE = 0.02


def ball(light=lambda normal: 1.0, shade=lambda height: 1.0, drift=0.0, turn_deg=360.0, shifted=0.0, seed=0):
    """Points on a ball with a texture, seen at less than 60 degrees, and the relative light of each view."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(900, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    albedo = 0.4 + 0.1 * np.sin(9.0 * normals[:, :1] + np.arange(CHANNELS)) + 0.1 * rng.random((900, 1))
    camera = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # right, up, towards it
    point, frame, seen, lit = [], [], [], []
    for k in range(FRAMES):
        facing = normals @ Rotation.from_euler("z", turn_deg * k / FRAMES, degrees=True).as_matrix().T @ camera
        rows = np.flatnonzero(facing[:, 2] > 0.5)
        point.append(rows)
        frame.append(np.full(len(rows), k))
        seen.append(facing[rows])
        lit.append(light(facing[rows]) * (1.0 - drift * k / FRAMES) * np.ones(len(rows)))
    point, frame, seen, lit = map(np.concatenate, (point, frame, seen, lit))
    reflectance = albedo[point] * (lit * shade(normals[point, 2]))[:, None]
    # A wrong pose shows another part of the texture, here and there.
    reflectance *= 1.0 + shifted * rng.normal(size=(len(point), 1)) + NOISE * rng.normal(size=reflectance.shape)
    return PointViews(point, frame, seen, reflectance, 0.04 * normals, normals), lit


def within_points(seen, values):
    means = np.bincount(seen.point, values) / np.maximum(np.bincount(seen.point), 1)
    return float(np.sqrt(np.mean((values / means[seen.point] - 1.0) ** 2)))


@pytest.mark.parametrize("strength", [0.3, 0.05])
def test_a_lamp_shows_by_as_much_as_it_changes_points(strength):
    seen, lit = ball(light=lambda normal: 1.0 + strength * normal[:, 0])
    change = change_with_direction(seen)
    assert change.rms == pytest.approx(within_points(seen, lit), rel=0.1)
    assert change.noise < 0.1 * change.rms


@pytest.mark.parametrize(
    "disturbed", [{}, {"drift": 0.2, "turn_deg": 120.0}, {"shifted": 0.1}, {"shade": lambda z: 0.7 + 0.3 * z}]
)
def test_what_does_not_go_with_the_direction_is_no_view_dependence(disturbed):
    change = change_with_direction(ball(**disturbed)[0])
    assert change.rms < max(3.0 * change.noise, 0.005)
    assert change.noise < 0.01


def test_shade_shows_with_height_among_like_spectra():
    shaded = change_with_height(ball(shade=lambda z: 0.8 + 0.2 * z)[0])
    assert 0.05 < shaded.rms < 0.2
    even = change_with_height(ball()[0])
    assert even.rms < max(3.0 * even.noise, 0.01)


def test_change_of_independent_findings():
    change = change_of([0.04, 0.04, 0.04, 0.08], [1, 1, 1, 1])
    assert change.rms == pytest.approx(np.sqrt(0.05))
    assert change.noise == pytest.approx(0.01 / (2.0 * np.sqrt(0.05)))
    nothing = change_of([0.01, -0.01, 0.01, -0.01], [1, 1, 1, 1])
    assert nothing.rms == 0.0
    assert nothing.noise == pytest.approx(np.sqrt(0.01 * np.sqrt(4 / 3) / 2.0))


def test_points_that_face_alike_in_all_frames_show_no_change():
    seen = ball()[0]
    one_frame = replace(seen, frame=np.zeros_like(seen.frame), normal=np.zeros_like(seen.normal))
    assert change_with_direction(one_frame).rms == 0.0


LENS = PinholeIntrinsics(128, 128, 240.0, 240.0, 64.0, 64.0)

MISSING = 5  # the frame whose mask lacks its right half


def facing(pose):
    """Cosine of the angle of incidence at each pixel of the sphere; 0 beside it."""
    y, x = np.mgrid[: LENS.h, : LENS.w] + 0.5
    origin, directions = pixel_rays(LENS, pose, np.stack([x, y], axis=-1))
    towards = SPHERE_CENTRE_M - origin
    along = directions @ towards
    missed = np.maximum(towards @ towards - along**2, 0.0)
    return np.sqrt(np.maximum(1.0 - missed / SPHERE_RADIUS_M**2, 0.0))


@pytest.fixture(scope="module")
def looked_up():
    poses = np.stack([true_pose(angle) for angle in np.arange(0.0, 360.0, 15.0)])
    masks = np.stack([sphere_mask(pose, LENS) for pose in poses])
    images = [np.stack([facing(pose), np.full((LENS.h, LENS.w), 0.3)]) for pose in poses]
    hull = voted_hull(masks, poses, LENS)
    masks[MISSING, :, LENS.w // 2 :] = False
    return poses, point_views(images, masks, poses, LENS, np.zeros(4), hull)


def test_points_lie_on_the_sphere_with_its_normals(looked_up):
    _, found = looked_up
    outwards = found.positions_m - SPHERE_CENTRE_M
    radius_m = np.linalg.norm(outwards, axis=1)
    used = np.unique(found.point)
    assert np.median(radius_m[used]) == pytest.approx(SPHERE_RADIUS_M, abs=0.0015)
    angles = np.arccos((found.normals * outwards / radius_m[:, None]).sum(axis=1)[used].clip(-1.0, 1.0))
    assert np.rad2deg(np.median(angles)) < 12.0


def test_points_are_looked_up_where_the_camera_sees_them(looked_up):
    poses, found = looked_up
    incidence = found.normal[:, 2]
    assert incidence.min() > np.cos(np.deg2rad(MAX_INCIDENCE_DEG)) - 0.15
    # The picture shows the cosine of the angle of incidence, which the point's own normal has to give again.
    np.testing.assert_allclose(np.median(np.abs(found.reflectance[:, 0] - incidence)), 0.0, atol=0.05)
    np.testing.assert_allclose(found.reflectance[:, 1], 0.3, atol=1e-6)
    # No point behind the sphere is seen.
    outwards = found.positions_m[found.point] - SPHERE_CENTRE_M
    to_eye = poses[found.frame, :3, 3] - SPHERE_CENTRE_M
    assert ((outwards * to_eye).sum(axis=1) > 0.0).all()
    assert len(np.unique(found.frame)) == len(poses)


def test_points_beside_the_mask_are_left_out(looked_up):
    _, found = looked_up
    number = np.bincount(found.frame)
    assert number[MISSING] < 0.6 * number[MISSING - 1]


def test_a_hull_of_one_layer_has_no_points():
    masks, poses = np.ones((3, LENS.h, LENS.w), bool), np.stack([true_pose(angle) for angle in (0.0, 90.0, 180.0)])
    core = SPHERE_CENTRE_M + np.stack([*np.indices((9, 9)).reshape(2, -1), np.zeros(81)], axis=-1) * 1e-3
    hull = VotedHull(core, np.full(3, 1e-3), 3, masks, masks)
    assert len(point_views(np.ones((3, 2, LENS.h, LENS.w)), masks, poses, LENS, np.zeros(4), hull).point) == 0


def test_colours_are_means_of_neighbouring_bins():
    bins = np.arange(24.0)[:, None, None] * np.ones((24, *[INTRINSICS.h // 8] * 2))
    assert colours_of(bins)[:, 0, 0].tolist() == [1.5, 5.5, 9.5, 13.5, 17.5, 21.5]
    assert len(colours_of(bins[:3])) == 3 < COLOURS
