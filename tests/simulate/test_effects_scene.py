"""Effects of the turntable, the chamber, the lamps and of time: closed forms, and what they leave alone."""

import functools
import json

import cv2
import numpy as np
import pytest
from turntable_scene import detected_corners

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL, rotation_about_z
from hsi_sc_nerf.simulate import assemble
from hsi_sc_nerf.simulate.effects import image
from hsi_sc_nerf.simulate.effects.detector import white_signal
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.light import render
from hsi_sc_nerf.simulate.materials import MATERIALS, PlantTissue, endmembers
from hsi_sc_nerf.simulate.render import Renderer
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth

SMALL = {"frames": 4, "size_px": 40, "bands": 10}


def scene(*names, name="cylinder", **values):
    return override(load_scene(name), **{**SMALL, **values}, effects=names)


@functools.cache
def plain(size_px):
    """The scene without effects, simulated once for all tests."""
    return Simulation(scene(size_px=size_px))


def signal(simulation, capture):
    """Counts above dark."""
    return capture.counts.astype(float) - simulation.scene.sensor.dark_level


def white(simulation):
    return white_signal(simulation.scene.sensor, simulation.wavelengths_nm)


# --- motion ---------------------------------------------------------------------------------------------------------


def plan(*names, **values):
    return assemble.frame_plan(scene(*names, **values))


def test_a_partial_turn_spans_its_angle_evenly_and_the_operator_knows_the_step():
    found = plan("{partial_turn: {span_deg: 90}}", frames=10)
    np.testing.assert_allclose(found.angles_deg, np.arange(10) * 10.0)
    assert found.nominal_step_deg == pytest.approx(10.0)
    assert plan("partial_turn", frames=1).angles_deg.tolist() == [0.0]


def test_clockwise_turns_the_other_way_and_the_operator_knows_and_not_of_missing_frames(tmp_path):
    names = "clockwise", "{missing_frames: {count: 2}}"
    session = simulate_session(scene(*names, frames=5, size_px=16), tmp_path / "s", False)
    written, truth = json.loads((session / "session.json").read_text()), load_truth(session)
    assert (written["direction"], written["nominal_step_deg"]) == ("cw", 72.0)
    assert truth.captures == ("cylinder_000", "cylinder_001", "cylinder_002")
    assert set(truth.angles_deg) < {0.0, -72.0, -144.0, -216.0, -288.0}
    assert (np.diff(truth.angles_deg) < 0.0).all()


def test_jitter_is_evenly_spread_and_leaves_the_first_frame_and_the_operators_belief():
    found = plan("{angle_jitter: {spread_deg: 2}}", frames=2000)
    errors = found.angles_deg - plan(frames=2000).angles_deg
    assert errors[0] == 0.0
    assert np.abs(errors).max() <= 2.0
    # An even spread of +-a has the standard deviation a / sqrt(3); five standard errors of it and of the mean.
    assert errors.std() == pytest.approx(2.0 / np.sqrt(3.0), rel=0.05)
    assert abs(errors.mean()) < 5 * 2.0 / np.sqrt(3.0 * 2000)
    assert found.nominal_step_deg == plan(frames=2000).nominal_step_deg
    # Another seed gives other errors, the same seed the same.
    np.testing.assert_array_equal(plan("angle_jitter").angles_deg, plan("angle_jitter").angles_deg)
    assert (plan("angle_jitter", seed=5).angles_deg[1:] != plan("angle_jitter", seed=6).angles_deg[1:]).all()


def test_missing_frames_leave_gaps_in_angle_and_time():
    whole = plan(frames=12)
    chosen = set()
    for seed in range(6):
        found = plan("{missing_frames: {count: 4}}", frames=12, seed=seed)
        places = np.searchsorted(whole.angles_deg, found.angles_deg)
        assert len(places) == 8
        assert places[0] == 0
        assert (np.diff(places) > 0).all()
        np.testing.assert_array_equal(found.angles_deg, whole.angles_deg[places])
        np.testing.assert_array_equal(found.elapsed, whole.elapsed[places])
        chosen.add(tuple(places.tolist()))
    assert len(chosen) > 1
    assert plan("{missing_frames: {count: 11}}", frames=12).angles_deg.tolist() == [0.0]


def test_repeated_frames_are_the_same_view_later():
    found = plan("{repeated_frames: {count: 3}}", "angle_jitter", frames=12)
    once = plan("angle_jitter", frames=12)
    angles, times_taken = np.unique(found.angles_deg, return_counts=True)
    np.testing.assert_array_equal(angles, once.angles_deg)
    assert sorted(times_taken.tolist()) == [1] * 9 + [2] * 3
    np.testing.assert_allclose(found.elapsed, np.linspace(0.0, 1.0, 15))
    assert (np.diff(found.angles_deg) >= 0.0).all()
    simulation = Simulation(scene("{repeated_frames: {count: 1}}"))
    first = int(np.flatnonzero(np.diff(simulation.plan.angles_deg) == 0.0)[0])
    np.testing.assert_array_equal(simulation.frame(first).counts, simulation.frame(first + 1).counts)


@pytest.mark.parametrize("effect", ["{missing_frames: {count: 4}}", "{repeated_frames: {count: 5}}"])
def test_more_frames_than_there_are_cannot_be_missing_or_repeated(effect):
    with pytest.raises(InputError, match=r"count is \d, but"):
        plan(effect)


def in_the_room(step, angle_deg):
    """Object to room by 4 x 4 matrices: turn about z, then lean by Rodrigues' formula about the axis across."""
    amplitude_deg, cycles = step
    azimuth = np.deg2rad(cycles * angle_deg)
    across = np.cross([0.0, 0.0, 1.0], [np.cos(azimuth), np.sin(azimuth), 0.0])
    lean = np.eye(4)
    lean[:3, :3] = cv2.Rodrigues(np.deg2rad(amplitude_deg) * across)[0]
    return lean @ rotation_about_z(angle_deg)


MOVED = (
    "clockwise",
    "{angle_jitter: {spread_deg: 5}}",
    "{axis_tilt: {tilt_deg: 12}}",
    "{wobble: {amplitude_deg: 3, cycles_per_turn: 2.5}}",
    "{off_centre: {shift_m: 0.011, azimuth_deg: 40}}",
)


@pytest.mark.slow
def test_the_poses_are_those_of_a_room_in_which_the_object_moves():
    """The room is rendered as it is: everything moved by 4 x 4 matrices, before a camera that stands still."""
    moved = scene(*MOVED, name="pear")
    simulation = Simulation(moved)
    camera = assemble.first_camera(moved.camera) @ rotation_about_z(12.0)
    np.testing.assert_allclose(simulation.plan.room_camera, camera, atol=1e-12)
    shift = 0.011 * np.array([np.cos(np.deg2rad(40)), np.sin(np.deg2rad(40)), 0.0])
    centred = scene(name="pear")
    parts = [assemble.object_part(centred), *assemble.support_parts(centred)]
    for i, angle in enumerate(simulation.plan.angles_deg):
        to_room = in_the_room((3.0, 2.5), angle)
        placed = []
        for part in parts:
            vertices = (part.mesh.vertices + shift) @ to_room[:3, :3].T + to_room[:3, 3]
            placed.append(type(part)(type(part.mesh)(vertices, part.mesh.triangles), part.materials, part.weights))
        camera_view = simulation.intrinsics, camera, moved.camera.supersampling
        expected = render(Renderer(placed), *camera_view).material_weights
        seen = simulation.frame(i).material_weights
        # Rays along an edge may fall on either side of it in float32.
        assert np.abs(seen - expected).mean() < 2e-5
        np.testing.assert_allclose(simulation.camera_to_world[i], np.linalg.inv(to_room) @ camera, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        [],
        ["{axis_tilt: {tilt_deg: 15}}"],
        ["{wobble: {amplitude_deg: 3}}"],
        ["{off_centre: {shift_m: 0.01}}"],
        ["{lens_distortion: {k1: -0.9, k2: 0.5, p1: 0.01, p2: -0.015}}"],
        MOVED,
    ],
    ids=lambda names: "+".join(name.strip("{").split(":")[0] for name in names),
)
def test_marker_corners_are_seen_where_opencv_projects_them(tmp_path, names):
    truth = load_truth(simulate_session(scene(*names, frames=3, size_px=256, bands=3), tmp_path / "s", False))
    errors = []
    for capture, pose in zip(truth.captures, truth.camera_to_world, strict=True):
        to_camera = np.linalg.inv(pose @ OPENCV_TO_OPENGL)
        rotation, _ = cv2.Rodrigues(to_camera[:3, :3])
        view = rotation, to_camera[:3, 3], truth.intrinsics.matrix(), np.array(truth.distortion)
        for number, seen in detected_corners(truth.reflectance(capture)[..., 0]).items():
            expected, _ = cv2.projectPoints(truth.marker_layout[number], *view)
            errors.append(seen - expected[:, 0])
    errors = np.array(errors)
    assert len(errors) >= 12
    assert np.median(np.linalg.norm(errors, axis=-1)) < 0.35
    # Pixel coordinates start at the corner: half a pixel of bias would be a wrong convention.
    assert np.abs(np.median(errors, axis=(0, 1))).max() < 0.1


# --- ageing ---------------------------------------------------------------------------------------------------------


def test_drying_takes_away_the_absorbance_of_the_lost_water():
    simulation = Simulation(scene("{drying: {water_loss: 0.4}}", name="apple", bands=204))
    nm = simulation.wavelengths_nm
    frame = simulation.frame(2)
    log_ratio = np.log10(frame.light.spectra / simulation.endmembers)
    elapsed = simulation.plan.elapsed[2]
    # The bands as gaussians, written out.
    shape = sum(
        height * np.exp(-((nm - centre) ** 2) / (2.0 * width**2))
        for height, centre, width in ((1.0, 970.0, 24.0), (0.3, 1010.0, 40.0), (0.06, 835.0, 18.0))
    )
    for i, name in enumerate(simulation.materials):
        of_object = name in simulation.object_part.materials
        water = MATERIALS[name].water if of_object else 0.0
        np.testing.assert_allclose(log_ratio[i], 0.4 * elapsed * water * shape, atol=1e-12)
    assert log_ratio[0].max() > 0.015
    # In the counts, to rounding.
    expected = frame.material_weights.astype(float) @ (frame.light.spectra * white(simulation))
    assert np.abs(signal(simulation, frame) - expected).max() <= 0.501
    # The first frame has not dried yet.
    np.testing.assert_array_equal(simulation.frame(0).light.spectra, simulation.endmembers)


def test_bone_dry_tissue_reflects_what_tissue_without_water_does():
    nm = np.linspace(397.0, 1003.0, 60)
    wet = {"wet": PlantTissue(1.0, chlorophyll=0.3, water=2.0), "flat": MATERIALS["paper"]}
    dry = {"wet": PlantTissue(1.0, chlorophyll=0.3), "flat": MATERIALS["paper"]}
    dried = image.Drying(1.0).spectra(endmembers(wet, nm, wet), list(wet.values()), nm, 1.0)
    np.testing.assert_allclose(dried, endmembers(dry, nm, dry), atol=1e-12)
    assert dried.max() <= 1.0
    # A table a sample, as for a detector's smile, is as many tables.
    samples_nm = nm + np.array([[0.0], [3.0]])
    tables = np.moveaxis(endmembers(wet, samples_nm, wet), 0, -2)
    both = image.Drying(0.5).spectra(tables, list(wet.values()), samples_nm, 0.6)
    for table, one, at_nm in zip(tables, both, samples_nm, strict=True):
        np.testing.assert_array_equal(one, image.Drying(0.5).spectra(table, list(wet.values()), at_nm, 0.6))


# --- illumination ---------------------------------------------------------------------------------------------------


def recovered(simulation, frame):
    """The illumination: counts divided by what the pixel would give under the lamps at the start."""
    without = frame.material_weights.astype(float) @ (simulation.endmembers * white(simulation))
    return signal(simulation, frame) / without, 0.501 / without


def planck_ratio(nm, kelvin):
    """Light of a black body over that of one at 3000 K: what is left of Planck's law in any unit."""
    hc_over_k_nm = 1.438776877e7
    return np.expm1(hc_over_k_nm / (nm * 3000.0)) / np.expm1(hc_over_k_nm / (nm * kelvin))


def test_drift_is_what_is_left_after_dividing_truth_out():
    simulation = Simulation(scene("{lamp_drift: {percent: -12, temperature_change_k: -150, settling: 0.4}}"))
    nm = simulation.wavelengths_nm
    for i, elapsed in enumerate(simulation.plan.elapsed):
        done = (1.0 - np.exp(-elapsed / 0.4)) / (1.0 - np.exp(-1.0 / 0.4))
        colour = planck_ratio(nm, 3000.0 - 150.0 * done) / planck_ratio(700.0, 3000.0 - 150.0 * done)
        expected = (1.0 - 0.12 * done) * colour
        found, rounding = recovered(simulation, simulation.frame(i))
        assert (np.abs(found - expected) <= rounding + 1e-5).all()
    assert expected[0] < 0.80 < 0.92 < expected[-1]
    # The tarp was taken before.
    even = plain(SMALL["size_px"])
    np.testing.assert_array_equal(simulation.white().counts, even.white().counts)
    np.testing.assert_array_equal(simulation.frame(0).counts, even.frame(0).counts)


def test_falloff_is_what_is_left_after_dividing_truth_out():
    simulation = Simulation(scene("{illumination_falloff: {edge_loss: 0.3}}"))
    size = SMALL["size_px"]
    y, x = np.mgrid[:size, :size] + 0.5 - size / 2
    # A light that falls on a plane under an angle loses cos^4 of it; the corner's angle makes the given loss.
    corner_angle = np.arccos(0.7**0.25)
    angle = np.arctan(np.hypot(y, x) / np.hypot(size / 2, size / 2) * np.tan(corner_angle))
    expected = np.cos(angle)[..., None] ** 4
    for i in (0, 3):
        frame = simulation.frame(i)
        found, rounding = recovered(simulation, frame)
        assert (np.abs(found - expected) <= rounding + 1e-5).all()
        # Tarp and object lose the same: divided by the tarp in its place, a frame is the true reflectance.
        tarp = simulation.white()
        on_tarp = tarp.light.weights[..., 0] == 1.0
        ratio = (signal(simulation, frame) / signal(simulation, tarp))[on_tarp]
        truth = (frame.material_weights.astype(float) @ simulation.endmembers)[on_tarp]
        assert (np.abs(ratio - truth) <= 0.501 * (1.0 + truth) / signal(simulation, tarp)[on_tarp] + 1e-5).all()
    factor = image.IlluminationFalloff(0.3).factor(1001, np.array([700.0]), 3000.0, 0.0)
    assert factor[500, 500, 0] == 1.0
    assert factor[0, 0, 0] == pytest.approx(0.7, abs=1e-3)


# --- surroundings ---------------------------------------------------------------------------------------------------


def test_the_background_stands_still_and_nothing_else_changes():
    simulation, even = Simulation(scene("textured_background", size_px=64)), plain(64)
    frames, bare = ([s.frame(i) for i in range(4)] for s in (simulation, even))
    same = [simulation.materials.index(name) for name in even.materials]
    wall = np.logical_and.reduce([frame.material_weights[..., -1] == 1.0 for frame in bare])
    assert wall.mean() > 0.3
    for frame, without in zip(frames, bare, strict=True):
        np.testing.assert_array_equal(frame.material_weights.sum(axis=-1), 1.0)
        np.testing.assert_array_equal(frame.counts[wall], frames[0].counts[wall])
        np.testing.assert_array_equal(frame.coverage, without.coverage)
        full = without.material_weights[..., -1] == 0.0
        np.testing.assert_array_equal(frame.material_weights[full][:, same], without.material_weights[full])
    # All three materials are there, and the wall's own is gone.
    fractions = frames[0].material_weights[wall].mean(axis=0)
    for name in image.TexturedBackground.materials:
        assert fractions[simulation.materials.index(name)] > 0.05
    assert fractions[-1] == 0.0
    half = Simulation(scene("{textured_background: {contrast: 0.5}}", size_px=64)).frame(0)
    np.testing.assert_allclose(half.material_weights[wall][:, -1], 0.5, atol=1e-3)
    # A larger image shows the same wall.
    large = Simulation(scene("textured_background", size_px=128)).frame(0).material_weights
    pooled = large.reshape(64, 2, 64, 2, -1).mean(axis=(1, 3))
    assert np.abs(pooled - frames[0].material_weights)[wall].mean() < 0.02
