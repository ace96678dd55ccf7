"""The pictures that poses are measured on: which of a frame's band groups is best, and what the others fill in."""

import json
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from capture_factory import INTRINSICS, WAVELENGTHS_NM, frame_reflectance, true_pose, true_poses, write_session
from exact_turntable import marker_turntable
from rich.console import Console
from scipy.special import ndtr
from turntable_scene import MarkerScene

from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import refuse_red
from hsi_sc_nerf.geometry.camera import project
from hsi_sc_nerf.packed.cube import FLAGGED, PixelFlag, pack, unpack, write_packed_cube
from hsi_sc_nerf.poses.feature_poses import KnownCamera
from hsi_sc_nerf.poses.marker_detection import find_dictionary
from hsi_sc_nerf.poses.marker_observations import observe_expected, observe_markers
from hsi_sc_nerf.poses.session_pictures import (
    BAND_GROUPS_NM,
    GRAY,
    GRAY_NM,
    FramePictures,
    SessionPictures,
    edge_precision,
    frame_pictures,
    group_means,
)
from hsi_sc_nerf.processing.posed_frames import pose_frames
from hsi_sc_nerf.processing.process import process_session
from hsi_sc_nerf.simulate.assemble import marker_layout
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.spectra import to_8_bit

DICTIONARY = "DICT_5X5_50"


def test_group_means_count_what_was_measured():
    rng = np.random.default_rng(0)
    packed = rng.integers(0, 50_000, (70, 5, 9)).astype(np.uint16)
    packed[rng.random(packed.shape) < 0.2] = FLAGGED
    packed[40:, 2] = FLAGGED
    members = rng.random((4, 9)) < 0.4
    members[:, 3] = True
    means, flagged_fraction = group_means(packed, members)
    for k, inside in enumerate(members):
        values, valid = (part[..., inside] for part in unpack(packed))
        with np.errstate(invalid="ignore"):
            np.testing.assert_allclose(means[k], values.sum(-1) / valid.sum(-1), rtol=1e-5)
        np.testing.assert_allclose(flagged_fraction[k], 1.0 - valid.mean(-1), atol=1e-6)


@pytest.fixture(scope="module")
def many_bands():
    """A noisy step in 120 bands; beyond 700 nm there is less noise."""
    wavelengths_nm = np.linspace(400.0, 1000.0, 120)
    sigma = np.where(wavelengths_nm < 700.0, 0.04, 0.02)
    cube = edge(noise=0.0)[..., None] + sigma * np.random.default_rng(2).normal(size=(80, 100, 120))
    return np.clip(cube, 0.0, 1.0), wavelengths_nm


def test_scores_from_a_few_bands_are_those_of_all(many_bands, tmp_path):
    cube, wavelengths_nm = many_bands
    frame = pictures_of(cube, wavelengths_nm, tmp_path)
    for name, (low, high) in {GRAY: GRAY_NM, **BAND_GROUPS_NM}.items():
        inside = bands(wavelengths_nm, low, high)
        assert inside.sum() >= 10
        assert frame.scores[name] == pytest.approx(edge_precision(cube[..., inside].mean(-1)), rel=0.2)
    assert frame.ranking[0] == "near infrared"


def test_what_was_not_measured_is_white_if_it_is_saturated_and_black_else(many_bands, tmp_path):
    cube, wavelengths_nm = many_bands
    cube = cube.copy()
    cube[:10, :20] = np.nan
    frame = pictures_of(cube, wavelengths_nm, tmp_path)
    assert (frame.picture("red")[:10, :20] == 255).all()
    cv2.imwrite(str(tmp_path / "c.png"), np.zeros((80, 100), np.uint8))
    frame = frame_pictures(tmp_path / "c.hdr", tmp_path / "c.png", frame.picture(GRAY))
    assert (frame.picture("red")[:10, :20] == 0).all()


def edge(contrast=0.6, blur_px=2.0, noise=0.01):
    """A blurred step along the columns of a noisy picture."""
    picture = np.where(np.arange(100) < 50, 0.1, 0.1 + contrast) * np.ones((80, 1))
    blurred = cv2.GaussianBlur(picture, (0, 0), blur_px)
    return blurred + noise * np.random.default_rng(0).normal(size=blurred.shape)


@pytest.mark.parametrize(("contrast", "blur_px", "noise"), [(0.6, 2.0, 0.01), (0.3, 3.0, 0.004), (0.5, 2.0, 0.02)])
def test_edge_precision_is_the_steepest_slope_over_the_noise(contrast, blur_px, noise):
    # Central differences of a step under a Gaussian; 2 % of 100 columns are the two at the step.
    slope = contrast * (ndtr(1.5 / blur_px) - ndtr(-0.5 / blur_px)) / 2.0
    assert edge_precision(edge(contrast, blur_px, noise)) == pytest.approx(slope / noise, rel=0.1)


def test_edges_do_not_count_where_their_place_is_lost():
    picture = edge()
    assert edge_precision(picture) > 5.0 * edge_precision(np.minimum(2.0 * picture, 1.0), picture < 0.2)
    assert edge_precision(picture, np.zeros(picture.shape, bool)) == 0.0
    assert edge_precision(np.ones((9, 9))) == 0.0
    assert edge_precision(np.zeros((9, 9))) == 0.0


@pytest.fixture(scope="module")
def pear():
    """Reflectance of three frames of a pear, their bands, and the corners of the markers in each."""
    scene = override(load_scene("pear"), size_px=192, frames=3, bands=16, effects=[], seed=None)
    simulation = Simulation(scene)
    white = simulation.white().counts[96, 96].astype(float) - scene.sensor.dark_level
    reflectance = [(simulation.frame(i).counts - float(scene.sensor.dark_level)) / white for i in range(3)]
    corners_m = marker_layout(scene)
    corners_px = [
        {m: project(c, pose, simulation.intrinsics)[0] for m, c in corners_m.items()}
        for pose in simulation.camera_to_world
    ]
    return reflectance, simulation.wavelengths_nm, corners_px


def bands(wavelengths_nm, low, high):
    return (wavelengths_nm >= low) & (wavelengths_nm <= high)


def spoilt(reflectance, wavelengths_nm, kinds):
    rng = np.random.default_rng(1)
    cube = reflectance.astype(np.float32)
    if "blue is noisy" in kinds:
        blue = bands(wavelengths_nm, 0.0, 520.0)
        cube[..., blue] += 0.1 * rng.normal(size=cube[..., blue].shape)
    if "near infrared is blurred" in kinds:
        infrared = bands(wavelengths_nm, 740.0, 2000.0)
        for k in np.flatnonzero(infrared):
            cube[..., k] = cv2.GaussianBlur(cube[..., k], (0, 0), 1.5)
    cube = np.clip(cube, 0.0, 1.0)
    if "the visible is saturated" in kinds:
        visible = bands(wavelengths_nm, 0.0, 670.0)
        cube[..., visible] = np.where(cube[..., visible] > 0.6, np.nan, cube[..., visible])
    return cube


def pictures_of(cube, wavelengths_nm, folder):
    packed = pack(cube)
    write_packed_cube(folder / "c.hdr", packed, wavelengths_nm)
    flags = np.where((packed == FLAGGED).any(axis=-1), np.uint8(PixelFlag.SATURATED), np.uint8(0))
    cv2.imwrite(str(folder / "c.png"), flags)
    # As when the frame is packed: what is saturated has its clipped value.
    gray = np.nan_to_num(cube[..., bands(wavelengths_nm, *GRAY_NM)], nan=0.6).mean(axis=-1)
    return frame_pictures(folder / "c.hdr", folder / "c.png", to_8_bit(gray))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kinds", "best", "worse"),
    [
        ((), {GRAY}, ()),
        (("blue is noisy",), {GRAY, "green", "red", "red edge", "near infrared"}, ("blue",)),
        (("near infrared is blurred",), {GRAY}, ("near infrared",)),
        (("the visible is saturated",), {"red edge", "near infrared"}, ("green", "blue", GRAY)),
        (
            ("the visible is saturated", "near infrared is blurred", "blue is noisy"),
            {"red edge"},
            ("near infrared", "blue", "green", GRAY),
        ),
    ],
)
def test_the_best_picture_is_sharp_quiet_and_well_exposed(pear, tmp_path, kinds, best, worse):
    reflectance, wavelengths_nm, truth = pear
    frames = []
    for number, cube in enumerate(reflectance):
        folder = tmp_path / str(number)
        folder.mkdir()
        frames.append(pictures_of(spoilt(cube, wavelengths_nm, kinds), wavelengths_nm, folder))
    for frame in frames:
        assert frame.ranking[0] in best
        assert all(frame.scores[name] < 0.75 * frame.scores[frame.ranking[0]] for name in worse)
    found = observe_markers(SessionPictures(frames), DICTIONARY).observations
    assert len(found) >= 15
    true = np.array([truth[i][m] for i, m in zip(found.frame, found.marker, strict=True)])
    assert np.sqrt(np.mean((found.corners_px - true) ** 2)) < 0.1


@pytest.fixture(scope="module")
def machine():
    scene = MarkerScene(size_px=128, frames=6, noise=0.003)
    return scene, scene.render()


def two_pictures(best, other):
    """Session pictures whose first picture is called red, and whose second is the broad mean."""
    return SessionPictures(
        [
            FramePictures({"red": a, GRAY: b}.__getitem__, {"red": 2.0, GRAY: 1.0})
            for a, b in zip(best, other, strict=True)
        ]
    )


@pytest.mark.slow
def test_few_markers_in_the_best_picture_are_joined_by_those_of_the_others(machine):
    _, images = machine
    blank = [np.full_like(image, 100) for image in images]
    glare = [image.copy() for image in images]
    for image in glare:
        image[:, 56:] = 100
    alone, whole, joined = (
        observe_markers(SessionPictures.of(shown), DICTIONARY).observations
        for shown in (glare, images, two_pictures(glare, images))
    )
    assert len(alone) < len(whole) == len(joined)
    # Corners of the best picture go first.
    where = {pair: i for i, pair in enumerate(zip(alone.frame.tolist(), alone.marker.tolist(), strict=True))}
    taken = [
        (where[pair], i)
        for i, pair in enumerate(zip(joined.frame.tolist(), joined.marker.tolist(), strict=True))
        if pair in where
    ]
    assert len(taken) == len(alone)
    first, again = np.array(taken).T
    np.testing.assert_allclose(joined.corners_px[again], alone.corners_px[first], atol=0.05)
    np.testing.assert_array_equal(
        observe_markers(two_pictures(blank, images), DICTIONARY).observations.corners_px, whole.corners_px
    )


def test_ink_that_the_best_picture_does_not_show_is_found_in_the_broad_mean():
    images = MarkerScene(size_px=128, frames=1).render()
    blank = [np.full_like(image, 100) for image in images]
    assert find_dictionary(blank) is None
    assert find_dictionary(two_pictures(blank, images)) == DICTIONARY


@pytest.mark.slow
def test_markers_that_were_not_detected_are_fitted_where_they_are_expected(machine):
    scene, images = machine
    observed, true = observe_markers(images, DICTIONARY), marker_turntable(scene)
    some = observed.observations.select(np.arange(len(observed.observations)) % 4 > 0)
    found = observe_expected(images, DICTIONARY, true, some, observed.blur_px)
    assert len(found) >= len(observed.observations)
    np.testing.assert_array_equal(found.corners_px[: len(some)], some.corners_px)
    np.testing.assert_allclose(found.corners_px, true.reproject(found), atol=0.2)


ANGLES_DEG = (0.0, 90.0, 180.0, 270.0)


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_the_packed_frames_pictures_are_read_and_reported(tmp_path):
    folder = write_session(tmp_path / "session", ANGLES_DEG)
    session = open_session(folder)
    data = process_session(folder, tmp_path / "data", progress=False, estimate_poses=true_poses)
    got = []

    def poses(images, names, **_):
        got.append(images)
        return replace(true_poses(images, names), method="colmap")

    grays = [
        to_8_bit(frame_reflectance(angle)[..., bands(WAVELENGTHS_NM, *GRAY_NM)].mean(-1)) for angle in ANGLES_DEG
    ]
    pose_frames(session, grays, SessionInfo(), None, "colmap", data, Console(quiet=True), poses)
    (pictures,) = got
    report = json.loads((data / "poses.json").read_text())["pictures"]
    assert list(report["best"].values()) == [frame.ranking[0] for frame in pictures.frames]
    infrared = bands(WAVELENGTHS_NM, *BAND_GROUPS_NM["near infrared"])
    for frame, gray, angle in zip(pictures.frames, grays, ANGLES_DEG, strict=True):
        np.testing.assert_array_equal(frame.picture(GRAY), gray)
        expected = 255.0 * frame_reflectance(angle)[..., infrared].mean(-1)
        np.testing.assert_allclose(frame.picture("near infrared"), expected, atol=1.5)


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_pictures_are_not_read_where_nothing_is_measured(tmp_path):
    session = open_session(write_session(tmp_path / "session", ANGLES_DEG))
    blank = [np.zeros((48, 48), np.uint8)] * 4
    camera = KnownCamera(INTRINSICS, (0.0, 0.0, 0.0, 0.0), true_pose(0.0))
    got = []

    def poses(images, names, **_):
        got.append(images)
        return replace(true_poses(images, names), method="angles")

    info = SessionInfo(nominal_step_deg=90.0)
    pose_frames(session, blank, info, camera, "angles", tmp_path, Console(quiet=True), poses)
    assert got == [blank]
    assert "pictures" not in json.loads((tmp_path / "poses.json").read_text())
    cw = replace(info, direction="cw")
    with pytest.raises(InputError, match="--accept poses-direction"):
        pose_frames(session, blank, cw, camera, "angles", tmp_path, Console(quiet=True), poses)
    check = partial(refuse_red, accepted=["poses-direction"])
    pose_frames(session, blank, cw, camera, "angles", tmp_path, Console(quiet=True), poses, check=check)
