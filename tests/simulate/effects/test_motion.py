"""Effects of the turntable: closed forms, and what they leave alone."""

import json

import cv2
import numpy as np
import pytest
from turntable_scene import detected_corners

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL, rotation_about_z
from hsi_sc_nerf.simulate import assemble
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.light import render
from hsi_sc_nerf.simulate.render import Renderer
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth

SMALL = {"frames": 4, "size_px": 40, "bands": 10}


def scene(*names, name="cylinder", **values):
    return override(load_scene(name), **{**SMALL, **values}, effects=names)


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
        taken = np.searchsorted(whole.angles_deg, found.angles_deg)
        assert len(taken) == 8
        assert taken[0] == 0
        assert (np.diff(taken) > 0).all()
        np.testing.assert_array_equal(found.angles_deg, whole.angles_deg[taken])
        np.testing.assert_array_equal(found.elapsed, whole.elapsed[taken])
        chosen.add(tuple(taken.tolist()))
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
