"""What the checks of poses find, by name and level."""

from dataclasses import replace

import numpy as np
import pytest
from capture_factory import true_poses

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.poses import report
from hsi_sc_nerf.poses.report import check_poses, pose_report
from hsi_sc_nerf.poses.result import Scale, Uncertainty

GOOD = true_poses([None] * 4, list("abcd"))
SCALE = Scale("markers", 0.03, 0.002, {}, {}, 0.09, 0.0905)
ODD = replace(SCALE, marker_sides={3: 1.02, 4: 0.98}, marker_side_sigmas={3: 0.002, 4: 0.02})
STEPS = SessionInfo(nominal_step_deg=90.0, direction="ccw")


def levels(poses, info=STEPS):
    return {finding.name: finding.level for finding in check_poses(poses, info)}


UNSURE = replace(GOOD, uncertainty=Uncertainty(0.01, 0.01, 0.01, np.full(4, 0.01), 0.5, 0.0004))
FEATURES = {"method": "colmap", "dictionary": None, "metric": False}


@pytest.mark.parametrize(("metric", "unit"), [(True, "m"), (False, "distances of the camera")])
def test_the_figure_states_the_unit_of_lengths(monkeypatch, tmp_path, metric, unit):
    drawn = []
    monkeypatch.setattr(report, "save_figure", lambda figure, path: drawn.append(figure))
    poses = replace(GOOD, metric=metric)
    report.draw_poses(poses, pose_report(poses, STEPS), tmp_path / "poses.png")
    assert drawn[0].axes[0].get_xlabel() == f"x ({unit})"


@pytest.mark.parametrize(
    ("poses", "advice", "percent"),
    [
        (replace(UNSURE, scale=SCALE), ["markers"], 0.2),
        (replace(UNSURE, scale=replace(SCALE, source="container")), ["marker_side_m", "markers"], 0.2),
        (replace(UNSURE, **FEATURES), ["markers", "--camera"], None),
        (replace(UNSURE, **FEATURES, camera_given=True), ["markers"], None),
    ],
)
def test_uncertain_poses_come_with_advice_that_can_help(poses, advice, percent):
    (finding,) = [finding for finding in check_poses(poses, SessionInfo()) if finding.name == "poses-uncertain"]
    assert finding.level == "amber"
    assert finding.values["scale_percent"] == percent
    report = pose_report(poses, SessionInfo())
    for position_mm in (finding.values["position_mm"], report["uncertainty"]["position_mm"]):
        assert position_mm == (pytest.approx(0.4) if poses.metric else None)
    told = finding.sentence.split("; ", 1)[1]
    assert [word for word in ("marker_side_m", "markers", "--camera") if word in told] == advice
    assert ("not known" in finding.sentence) == (percent is None)


def test_places_of_captures_that_are_left_out_count():
    gap, info = replace(GOOD, angles_deg=np.array([0.0, 60, 180, 240])), replace(STEPS, nominal_step_deg=60.0)
    assert levels(gap, info) == {"poses-angles": "amber"}
    assert check_poses(gap, info, (0, 1, 3, 4)) == []
    assert pose_report(gap, info, places=(0, 1, 3, 4))["steps_deg"]["largest_deviation_from_nominal"] == 0.0


@pytest.mark.parametrize(
    ("places", "method", "expected"),
    [
        ((0, 1, 3, 4), "colmap", {"poses-angles": "amber"}),
        ((0, 2, 4, 6), "markers", {"poses-angles": "amber"}),
        ((0, 1, 3, 4), "angles", {"angles": "red"}),
        ((4, 5, 6, 7), "angles", {}),
    ],
)
def test_a_table_that_did_not_turn_for_a_capture_that_is_left_out(places, method, expected):
    """A retake at the same angle; poses at held angles do not show it."""
    poses = replace(GOOD, method=method)
    if method == "angles":
        poses = replace(poses, angles_deg=90.0 * (np.array(places) - places[0]))
    found = check_poses(poses, STEPS, places)
    assert {finding.name: finding.level for finding in found} == expected
    assert all("frame_angles_deg" in finding.sentence for finding in found)
    assert check_poses(poses, replace(STEPS, nominal_step_deg=None), places) == []


@pytest.mark.parametrize(
    ("poses", "info", "expected"),
    [
        (GOOD, STEPS, {}),
        (GOOD, SessionInfo(), {}),
        (replace(GOOD, overall_error_px=1.2), STEPS, {"poses-error": "amber"}),
        (replace(GOOD, dropped={"a": "hidden"}), STEPS, {"poses-frames": "amber"}),
        (GOOD, replace(STEPS, direction="cw"), {"poses-direction": "red"}),
        (GOOD, replace(STEPS, camera_distance_m=0.41), {}),
        (GOOD, replace(STEPS, camera_distance_m=0.5), {"poses-scale": "red"}),  # an earlier dataset gives 0.4
        (replace(GOOD, metric=False), replace(STEPS, camera_distance_m=0.5), {}),
        (GOOD, replace(STEPS, nominal_step_deg=80.0), {"poses-angles": "red"}),
        (replace(GOOD, angles_deg=np.array([0.0, 90, 210, 270])), STEPS, {"poses-angles": "amber"}),
        (GOOD, SessionInfo(frame_angles_deg=(5.0, 95.0, 185.0, 275.5)), {}),
        (GOOD, SessionInfo(frame_angles_deg=(0.0, -90.0, -180.0, -270.0)), {}),
        (GOOD, SessionInfo(frame_angles_deg=(270.0, 0.0, 90.0, 180.0)), {}),
        (GOOD, SessionInfo(frame_angles_deg=(0.0, 90.0, 180.0, 280.0)), {"poses-angles": "amber"}),
        (GOOD, SessionInfo(frame_angles_deg=(0.0, 80.0, 160.0, 240.0)), {"poses-angles": "red"}),
        (replace(GOOD, used=np.array([True, False, True, True])), STEPS, {}),
        (replace(GOOD, scale=SCALE), STEPS, {"poses-scale": "green"}),
        (replace(GOOD, scale=replace(SCALE, measured_container_diameter_m=0.0958)), STEPS, {"poses-scale": "red"}),
        (replace(GOOD, scale=replace(SCALE, measured_container_diameter_m=0.0865)), STEPS, {"poses-scale": "red"}),
        (
            replace(GOOD, scale=replace(SCALE, measured_container_diameter_m=0.0958, uncertainty=0.03)),
            STEPS,
            {"poses-scale": "green"},
        ),
        (replace(GOOD, scale=ODD), STEPS, {"poses-scale": "green", "poses-markers": "amber"}),
    ],
)
def test_contradictions_are_found(poses, info, expected):
    assert levels(poses, info) == expected
