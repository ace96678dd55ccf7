"""Marker detection and the fit of a marker's pattern, against rendered markers with known corners."""

import cv2
import numpy as np
import pytest
from turntable_scene import MarkerScene

from hsi_sc_nerf.geometry.camera import project
from hsi_sc_nerf.poses.marker_detection import (
    detect_markers,
    dictionary_by_name,
    find_dictionary,
    marker_pattern,
)
from hsi_sc_nerf.poses.marker_fit import fit_marker
from hsi_sc_nerf.poses.marker_observations import find_blur

DICTIONARY = "DICT_5X5_50"


def truth_and_images(**options):
    scene = MarkerScene(**{"frames": 4, **options})
    corners = [
        {m: project(c, pose, scene.intrinsics)[0] for m, c in scene.corners_m.items()}
        for pose in scene.camera_to_world
    ]
    return corners, scene.render()


@pytest.fixture(scope="module")
def small():
    return truth_and_images(size_px=128, frames=2, noise=0.005)


def fits(truth, images, blur_px=0.0):
    for corners, image in zip(truth, images, strict=True):
        for marker, start in detect_markers(image, DICTIONARY).items():
            yield corners[marker], start, fit_marker(image.astype(float), DICTIONARY, marker, start, blur_px)


def side(corners):
    return np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=-1).mean()


@pytest.mark.parametrize("width", [1100, 300])
def test_detected_corners_count_from_the_images_corner(width):
    # At the first width the image is taken as it is, at the second it is magnified.
    page = np.full((200, width), 255, np.uint8)
    page[50:120, 40:110] = cv2.aruco.generateImageMarker(dictionary_by_name(DICTIONARY), 4, 70)
    found = detect_markers(page, DICTIONARY)
    np.testing.assert_allclose(found[4], [[40, 50], [110, 50], [110, 120], [40, 120]], atol=0.1)


@pytest.mark.slow
def test_fitted_corners_are_good_to_hundredths_of_a_pixel(small):
    found = [(truth, start, fitted) for truth, start, fitted in fits(*small) if fitted is not None]
    assert len(found) >= 6
    before = np.sqrt(np.mean([(start - truth) ** 2 for truth, start, _ in found]))
    after = np.sqrt(np.mean([(fitted.corners_px - truth) ** 2 for truth, _, fitted in found]))
    assert after < 0.06
    assert after < before / 4
    bias = np.mean([side(fitted.corners_px) / side(truth) - 1 for truth, _, fitted in found])
    assert abs(bias) < 0.002  # 1 mm in half a metre


@pytest.mark.slow
def test_covariance_tells_the_size_of_the_error():
    squared = [
        (fitted.corners_px - truth).ravel()
        @ np.linalg.solve(fitted.covariance_px2, (fitted.corners_px - truth).ravel())
        for truth, _, fitted in fits(*truth_and_images(size_px=160, noise=0.03))
        if fitted is not None
    ]
    assert 0.2 < np.median(squared) / 8 < 4.0


def test_fit_moves_with_the_image(small):
    _, images = small
    marker, start = next(iter(detect_markers(images[0], DICTIONARY).items()))
    image = images[0].astype(float)
    here = fit_marker(image, DICTIONARY, marker, start)
    moved = np.pad(image, ((2, 0), (3, 0)), mode="edge")
    there = fit_marker(moved, DICTIONARY, marker, start + np.array([3.0, 2.0]))
    np.testing.assert_allclose(there.corners_px - here.corners_px, np.tile([3.0, 2.0], (4, 1)), atol=1e-3)


def test_fit_does_not_mind_exposure_and_shading(small):
    _, images = small
    marker, start = next(iter(detect_markers(images[0], DICTIONARY).items()))
    image = images[0].astype(float)
    here = fit_marker(image, DICTIONARY, marker, start)
    darker = fit_marker(0.3 * image + 20.0, DICTIONARY, marker, start)
    np.testing.assert_allclose(darker.corners_px, here.corners_px, atol=2e-3)
    shaded = image * np.linspace(0.7, 1.3, image.shape[1])
    np.testing.assert_allclose(fit_marker(shaded, DICTIONARY, marker, start).corners_px, here.corners_px, atol=0.03)


def test_fit_does_not_mind_shade_that_bends_over_the_marker(small):
    """As beside a container: a third of the light is lost at one edge. Linear shading shifts corners by 0.09 px."""
    _, images = small
    x = np.arange(images[0].shape[1]) + 0.5
    shifts_px = []
    for image in images:
        for marker, start in detect_markers(image, DICTIONARY).items():
            low, high = start[:, 0].min(), start[:, 0].max()
            shade = 1.0 - 0.35 * np.clip((x - low) / (high - low), 0.0, 1.0) ** 2
            here, shaded = (
                fit_marker(one, DICTIONARY, marker, start) for one in (image.astype(float), image * shade)
            )
            if here is not None and shaded is not None:
                shifts_px.append(np.abs(shaded.corners_px - here.corners_px).max())
    assert len(shifts_px) >= 8
    assert max(shifts_px) < 0.05


@pytest.mark.parametrize("around", [0.78, 0.6])
def test_what_lies_beside_a_narrow_paper_does_not_shift_the_edges(around):
    """Small markers on paper whose border is 0.7 cells wide; pixels at its edge show what lies beside it."""
    over, middle, ratios = 8, 20.0, []
    grid = (np.arange(2 * middle * over) + 0.5) / over
    x, y = np.meshgrid(grid - middle, grid - middle)
    for number, angle in enumerate(np.linspace(0.0, 1.5, 30)):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        u, v = 7 / 15 * np.tensordot(turn.T, [x, y], 1)
        reach = np.maximum(np.abs(u), np.abs(v))
        image, ink = np.where(reach < 4.2, 0.9, around), reach < 3.5
        image[ink] = np.where(
            marker_pattern(DICTIONARY, number)[tuple((np.array([v, u])[:, ink] + 3.5).astype(int))], 0.9, 0.05
        )
        truth = middle + 7.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ turn.T
        image = 220.0 * image.reshape(40, over, 40, over).mean(axis=(1, 3))
        ratios.append(side(fit_marker(image, DICTIONARY, number, truth).corners_px) / side(truth))
    assert np.mean(ratios) == pytest.approx(1.0, abs=5e-4)


def test_fit_refuses_another_marker_and_the_images_edge(small):
    _, images = small
    marker, start = next(iter(detect_markers(images[0], DICTIONARY).items()))
    image = images[0].astype(float)
    assert fit_marker(image, DICTIONARY, (marker + 1) % 50, start) is None
    assert fit_marker(image, DICTIONARY, marker, start - np.array([start[:, 0].min(), 0.0])) is None
    assert fit_marker(np.full_like(image, 7.0), DICTIONARY, marker, start) is None


@pytest.mark.slow
@pytest.mark.parametrize("blur_px", [0.0, 0.7])
def test_blur_is_found(blur_px):
    _, images = truth_and_images(size_px=160, blur_px=blur_px, noise=0.005)
    detections = [detect_markers(image, DICTIONARY) for image in images]
    assert find_blur(images, DICTIONARY, detections) == pytest.approx(blur_px, abs=0.08)


@pytest.mark.parametrize("name", ["DICT_5X5_50", "DICT_4X4_50", "DICT_6X6_250"])
def test_dictionary_is_found(name):
    scene_dictionary = getattr(cv2.aruco, name)
    cells = int(name[5]) + 2
    book = cv2.aruco.getPredefinedDictionary(scene_dictionary)
    highest = book.bytesList.shape[0] - 1
    page = np.full((160, 320), 255, np.uint8)
    for k, marker in enumerate((0, 7, highest)):
        page[40 : 40 + 8 * cells, 20 + 100 * k : 20 + 100 * k + 8 * cells] = cv2.aruco.generateImageMarker(
            book, marker, 8 * cells
        )
    assert find_dictionary([page, page, page]) == name
