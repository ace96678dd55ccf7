"""Pixels that follow one common course, in drawn courses."""

from __future__ import annotations

import numpy as np
import pytest

from hsi_sc_nerf.calibration.static_pixels import Courses, grey_deviation, static_pixels


def find_static(counts, variance):
    return static_pixels(Courses.of(counts.astype(np.float32), variance))[0]


def test_counts_that_cannot_be_used():
    counts, variance = np.full((200, 4, 3), 1000.0), np.full((200, 3), 4.0)
    assert find_static(counts, variance).all()
    variance[:50] = np.inf
    counts[50:100, 2] = 0.0
    static = find_static(counts, variance)
    assert not static[:100].any()
    assert static[100:].all()
    assert not find_static(counts, np.full((200, 3), np.inf)).any()


@pytest.mark.parametrize("bins", [1, 3])
def test_a_course_that_is_off_by_little_in_each_frame_but_in_all_of_them(bins):
    frames, spread = 40, 5.0
    counts = 1000.0 + spread * np.random.default_rng(1).standard_normal((400, frames, bins))
    # Three standard deviations, tolerance included, up and down in turn.
    counts[:50] += 3.0 * np.hypot(spread, 2.0) * (-1.0) ** np.arange(frames)[:, None]
    static = find_static(counts, np.full((400, bins), spread**2))
    assert not static[:50].any()
    assert static[50:].mean() > 0.99


def test_what_moves_with_its_neighbours_is_not_static():
    """A texture that passes by scatters as much as the wall does, but neighbours have it in common."""
    rng = np.random.default_rng(2)
    grey = 0.04 * rng.standard_normal((640, 12))
    grey[320:] = 0.04 * np.repeat(rng.standard_normal((10, 12)), 32, axis=0)
    static = find_static(1000.0 * np.exp(grey)[..., None] * np.ones(4), np.full((640, 4), 1.0))
    assert static[:320].mean() > 0.9
    assert static[320:].mean() < 0.1


@pytest.mark.parametrize(
    ("common", "beside_an_object"),
    [(0.0, False), (0.0, True), (0.01, False)],
    ids=["independent", "independent beside an object", "alike in a region"],
)
def test_error_of_the_common_grey_level(common, beside_an_object):
    """It covers errors that neighbours share, wherever the static pixels are."""
    static = np.ones((32, 40), bool)
    static[8:, 10:30] = not beside_an_object
    rng = np.random.default_rng(3)
    errors, stated = [], []
    for _ in range(40):
        of_region = common * rng.standard_normal((4, 4, 5)).repeat(8, axis=0).repeat(10, axis=1)
        grey = 0.05 * rng.standard_normal((32, 40, 5)) + of_region
        counts = 1000.0 * np.exp(grey).reshape(1280, 5, 1) * np.ones(4)
        courses = Courses.of(counts.astype(np.float32), np.full((1280, 4), 1.0))
        deviation, scatter, error = grey_deviation(courses, static, np.zeros((5, 4)))
        course = np.log(counts[static.ravel(), :, 0]) - deviation
        course = (course - course.mean(axis=1, keepdims=True)).mean(axis=0)
        errors.append(course)
        stated.append(error)
        assert scatter == pytest.approx(0.05, rel=0.2)
    # Five frames about their own mean have four fifths of the variance.
    assert np.sqrt(np.mean(np.square(errors)) * 5 / 4) == pytest.approx(np.sqrt(np.mean(np.square(stated))), rel=0.25)
