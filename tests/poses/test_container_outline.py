"""The container's radius and foot in drawn frames."""

from dataclasses import astuple, replace

import cv2
import numpy as np
import pytest
from exact_turntable import marker_turntable, point_turntable
from scipy.spatial.transform import Rotation
from turntable_scene import MarkerScene

from hsi_sc_nerf.geometry.camera import project
from hsi_sc_nerf.poses.container_outline import container_outline, radius_by_camera

RADIUS_M, HEIGHT_M, OVER = 0.045, 0.07, 8
RATIO = HEIGHT_M / RADIUS_M / 2.0


@pytest.fixture(scope="module")
def turntable():
    scene = MarkerScene(size_px=192, frames=9)
    return scene, point_turntable(marker_turntable(scene), 100)


def drawn(scene, shift_m, contrast, k1=0.0):
    """Frames of a container before a noisy, patterned wall; its lid is at its height above z = 0."""
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.normal(size=(192, 192)), (0, 0), 3.0)
    images = []
    for pose in scene.camera_to_world:
        around = np.linspace(0.0, 2.0 * np.pi, 90)
        rim = RADIUS_M * np.stack([np.cos(around), np.sin(around)], axis=-1) + [shift_m, 0.0]
        corners = np.concatenate([np.column_stack([rim, np.full(90, z)]) for z in np.linspace(0.0, HEIGHT_M, 8)])
        pixels, _ = project(corners, pose, scene.intrinsics, (k1, 0.0, 0.0, 0.0))
        hull = cv2.convexHull(np.float32(pixels * OVER)).astype(np.int32)
        covered = cv2.fillConvexPoly(np.zeros((192 * OVER, 192 * OVER), np.float32), hull, 1.0)
        covered = cv2.resize(covered, (192, 192), interpolation=cv2.INTER_AREA)
        image = 120.0 + 30.0 * wall / wall.std() * 0.3 * (1.0 - covered) + contrast * covered
        images.append(np.clip(image + rng.normal(size=image.shape), 0, 255).astype(np.uint8))
    return images


def standing(turntable, above_lid_m=0.0, **changes):
    """The machine whose features end this far above the lid."""
    scene, machine = turntable
    points_3d = machine.points_3d.copy()
    lowest_m = np.percentile(points_3d[:, 2], 1.0)
    points_3d[:, 2] += HEIGHT_M + above_lid_m - scene.first_camera_to_world[2, 3] - lowest_m
    return replace(machine, points_3d=points_3d, **changes)


@pytest.mark.parametrize("ends_m", [0.0, 0.03])
@pytest.mark.parametrize("shift_m", [0.0, 0.002])
def test_radius_and_foot_are_those_of_the_drawn_container(turntable, shift_m, ends_m):
    """The features end where the lid is, or well above it."""
    scene, camera_m = turntable[0], turntable[0].first_camera_to_world[2, 3]
    found = container_outline(drawn(scene, shift_m, 60.0), standing(turntable, ends_m), RATIO)
    assert found.radius == pytest.approx(RADIUS_M, rel=2.0 * found.radius_sigma)
    assert found.radius_sigma < 0.015
    assert found.foot == pytest.approx(-camera_m, abs=2.0 * found.foot_sigma)
    assert found.foot_sigma < 0.002


def test_a_distorted_lens_shows_the_same_container(turntable):
    scene, camera_m = turntable[0], turntable[0].first_camera_to_world[2, 3]
    machine = standing(turntable, radial=(-2.0, 0.0))
    found = container_outline(drawn(scene, 0.0, 60.0, machine.radial[0]), machine, RATIO)
    assert found.radius == pytest.approx(RADIUS_M, rel=2.0 * found.radius_sigma)
    assert found.foot == pytest.approx(-camera_m, abs=2.0 * found.foot_sigma)


def test_pictures_that_lie_on_their_side_show_the_same_container(turntable):
    machine, images = standing(turntable), drawn(turntable[0], 0.0, 60.0)
    quarter = Rotation.from_euler("z", -90.0, True).as_matrix()
    aside = replace(machine, camera_rotation=quarter @ machine.camera_rotation)
    upright = container_outline(images, machine, RATIO)
    found = container_outline([np.rot90(image) for image in images], aside, RATIO)
    np.testing.assert_allclose(astuple(found), astuple(upright), rtol=1e-3)


def test_what_is_hardly_seen_is_not_measured(turntable):
    scene, machine = turntable
    assert container_outline(drawn(scene, 0.0, 0.0), machine, RATIO) is None


@pytest.mark.parametrize("parameter", range(5))
def test_radius_follows_the_camera_as_its_derivatives_say(turntable, parameter):
    """In the same pictures another camera finds another radius."""
    machine, images = standing(turntable), drawn(turntable[0], 0.0, 60.0)
    step = np.diag([0.03, 0.01, 0.001, 0.005, 0.03])[parameter]
    found = []
    for sign in (-1.0, 1.0):
        turn = Rotation.from_rotvec(sign * step[1:4]).as_matrix()
        other = replace(
            machine,
            focal_px=machine.focal_px * np.exp(sign * step[0]),
            camera_rotation=turn @ machine.camera_rotation,
            distance=machine.distance * np.exp(sign * step[4]),
        )
        found.append(container_outline(images, other, RATIO).radius)
    outline = container_outline(images, machine, RATIO)
    assert np.log(found[1] / found[0]) == pytest.approx(2.0 * step @ radius_by_camera(outline, machine), abs=0.002)


@pytest.mark.parametrize("factor", [1e-5, 1e-3, 0.01, 30.0])
def test_an_object_of_a_pixel_or_one_that_holds_the_camera_has_no_container(turntable, factor):
    """Wrong poses leave such points."""
    scene, machine = turntable
    machine = replace(machine, points_3d=factor * machine.points_3d)
    assert container_outline(drawn(scene, 0.0, 60.0), machine, RATIO) is None
