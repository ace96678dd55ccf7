"""Each mistake of a session is found, by its name; a good session has none."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from inspection_session import (
    INFO,
    LAMP,
    READ_NOISE_COUNTS,
    SIZE_PX,
    frame_picture,
    rendered,
    write_one,
    write_turntable,
)

from hsi_sc_nerf.calibration.session_calibration import CalibrationConfig, calibrate_session
from hsi_sc_nerf.capture.envi import open_cube, write_cube
from hsi_sc_nerf.capture.session import Session, open_session
from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.inspection.capture_checks import acquisition_day, check_frames
from hsi_sc_nerf.inspection.inspect import (
    Inspection,
    check_angles,
    draw_inspection,
    filled_in,
    inspect_session,
    is_named,
)
from hsi_sc_nerf.inspection.marker_checks import Markers

SEEN = Markers("DICT_5X5_50", [{}] * 12, np.arange(12) * 30.0, 0, 20.0, 0.1)


def inspect(path: Path) -> tuple[Inspection, dict[str, Finding]]:
    inspection = inspect_session(open_session(path, skip_damaged=True))
    return inspection, {finding.name: finding for finding in inspection.findings}


def found(path: Path, level: str) -> dict[str, str]:
    _, findings = inspect(path)
    return {name: finding.sentence for name, finding in findings.items() if finding.level == level}


def test_a_good_session_is_green(good, tmp_path):
    inspection, findings = inspect(good)
    assert {name: f.sentence for name, f in findings.items() if f.level != "green"} == {}
    assert findings["turn"].values["direction"] == "ccw"
    assert findings["turn"].values["usual_step_deg"] == pytest.approx(30.0, abs=0.5)
    noise = float(np.median(READ_NOISE_COUNTS / (0.98 * LAMP)))
    assert noise < findings["expected-accuracy"].values["reflectance_noise"] < 2.0 * noise
    assert findings["frames"].values["frames"] == [f"fruit_{i:02d}" for i in range(12)]
    draw_inspection(inspection, tmp_path / "inspection.png")
    assert (tmp_path / "inspection.png").stat().st_size > 10_000
    assert json.loads(json.dumps(inspection.report()))["findings"][0]["name"] == "frames"


def test_a_frame_given_as_the_white(session):
    (session / "session.json").write_text(json.dumps({**INFO, "white_reference": "fruit_03"}))
    red = found(session, "red")
    assert "white" in red
    assert "white_reference" in red["white"]


def test_frames_of_another_day(session):
    image = np.rot90(frame_picture(np.full((SIZE_PX, SIZE_PX), 200.0)), 0)
    for name in ("fruit_05", "fruit_06"):
        write_one(session, name, image, seed=1, **{"acquisition date": "15-02-2021"})
    red = found(session, "red")
    for part in ("fruit_05, fruit_06", "15-02-2021", "--exclude fruit_05 --exclude fruit_06"):
        assert part in red["dates"]


@pytest.mark.parametrize(
    ("stated", "day"),
    [
        ("DATE(yyyy-mm-dd): 2018-06-21", "2018-06-21"),
        ("2018-06-21T10:11:12", "2018-06-21"),
        ("6/21/2018 10:11", "6/21/2018"),
        ("21-Jun-2018 10:11:12", "21-Jun-2018"),
        ("Thu Jun 21 10:11:12 2018", "Jun 21 2018"),
        ("20180621 101112", "20180621"),
        ("10:11:12", None),
        ("", None),
    ],
)
def test_the_day_without_the_time(stated, day):
    capture = SimpleNamespace(cube=SimpleNamespace(fields={"acquisition date": stated}))
    assert acquisition_day(capture) == day


@pytest.mark.parametrize(
    ("name", "named"),
    [("fruit_1", True), ("plum 2", True), ("fruit_3", True), ("fruit", False), ("fruit_10", False), ("3", False)],
)
def test_frames_that_red_findings_name_are_marked(name, named):
    sentences = "S: another object: fruit_1, plum 2; leave out with --exclude fruit_1 --exclude 'plum 2'. fruit_3."
    assert is_named(name, sentences) == named


def test_another_object_on_the_same_day(session):
    gray = np.full((SIZE_PX, SIZE_PX), 0.35 * 255)
    write_one(session, "fruit_07", frame_picture(gray, radius_px=40.0))
    red = found(session, "red")
    assert list(red) == ["other-object"]
    assert "fruit_07" in red["other-object"]
    assert "fruit_06" not in red["other-object"]


def test_a_frame_with_markers_that_no_other_shows(session):
    """Another turntable: its picture alone need not be unlike the others."""
    quicklooks = inspect_session(open_session(session)).quicklooks
    ours, others = {1: np.zeros((4, 2)), 2: np.zeros((4, 2))}, {7: np.zeros((4, 2)), 8: np.zeros((4, 2))}
    findings = check_frames(open_session(session), quicklooks, [ours] * 5 + [others] + [ours] * 6)
    (red,) = [finding for finding in findings if finding.level == "red"]
    assert red.values["unknown_markers"] == ["fruit_05"]
    assert "--exclude fruit_05" in red.sentence


@pytest.mark.parametrize("lost", ["pixels", "a band", "a frame"])
def test_cubes_with_values_that_are_no_data(session, tmp_path, lost):
    """Some pixels or a whole band cost nothing; a frame without any data is found."""
    rng = np.random.default_rng(0)
    for header in session.glob("fruit_*/capture/fruit_*.hdr"):
        cube = open_cube(header)
        counts = cube.read().astype(np.float32)
        if lost == "pixels":
            counts[rng.random(counts.shape) < 0.002] = np.nan
        if lost == "a band":
            counts[..., 2] = np.nan
        if lost == "a frame" and header.stem == "fruit_04":
            counts[:] = np.nan
        write_cube(header, counts, wavelengths_nm=cube.wavelengths_nm)
    inspection, findings = inspect(session)
    draw_inspection(inspection, tmp_path / "inspection.png")
    red = [name for name, finding in findings.items() if finding.level == "red"]
    assert red == (["exposure", "other-object"] if lost == "a frame" else [])
    if lost == "a frame":
        assert "fruit_04" in findings["exposure"].sentence
    else:
        assert findings["turn"].level == "green"


@pytest.mark.parametrize("bad", [4, 7])
def test_a_band_that_is_marked_as_bad_may_hold_anything(session, bad):
    """Here the tarp fills a part of its image only, and pictures show the one band and not the other."""
    rng, listed = np.random.default_rng(0), np.arange(9) != bad
    white = np.full((SIZE_PX, SIZE_PX, len(listed)), 0.1)
    white[:, 40:] = 0.98
    write_one(session, "white_reference", white)
    for header in session.glob("*/capture/*.hdr"):
        cube = open_cube(header)
        counts = cube.read()
        counts[..., bad] = rng.integers(60_000, 65_535, counts.shape[:2])
        fields = {"tint": 10, "bbl": listed.astype(int).tolist()}
        write_cube(header, counts, wavelengths_nm=cube.wavelengths_nm, extra_header=fields)
    assert found(session, "red") == {}
    assert found(session, "amber") == {}
    calibration = calibrate_session(open_session(session), CalibrationConfig())
    assert calibration.white.roi == (40, 0, SIZE_PX, SIZE_PX)
    np.testing.assert_allclose(calibration.white.measured[0, listed], 0.98 * LAMP[listed], rtol=5e-3)


def test_damaged_captures_are_named(session):
    (session / "fruit_04" / "capture" / "fruit_04.raw").write_bytes(b"")
    inspection, findings = inspect(session)
    assert findings["damaged"].level == "red"
    assert list(findings["damaged"].values) == ["fruit_04"]
    left_out = inspect_session(open_session(session, skip_damaged=True), skip_damaged=True).findings
    (told,) = [finding for finding in left_out if finding.name == "damaged"]
    assert told.level == "amber"
    assert "fruit_04" in told.sentence
    assert len(inspection.quicklooks) == 11


def test_a_copied_frame(session):
    for file in (session / "fruit_02" / "capture").iterdir():
        shutil.copy(file, session / "fruit_09" / "capture" / file.name.replace("fruit_02", "fruit_09"))
    red = found(session, "red")
    assert "fruit_09 is a copy of fruit_02" in red["copies"]


def test_exposures_that_differ_and_one_that_is_too_long(session):
    gray = np.full((SIZE_PX, SIZE_PX), 0.35 * 255)
    write_one(session, "fruit_08", 9.0 * frame_picture(gray), tint=90)
    _, findings = inspect(session)
    assert findings["integration-times"].values["others"] == {"fruit_08": 90.0}
    assert findings["exposure"].level == "red"
    assert "fruit_08" in findings["exposure"].sentence


def test_a_blurred_frame_without_markers_is_amber(session):
    image = frame_picture(np.full((SIZE_PX, SIZE_PX), 0.35 * 255))
    smooth = np.stack(
        [np.mean([np.roll(image[..., band], shift, 1) for shift in range(-7, 8)], 0) for band in range(9)]
    )
    write_one(session, "fruit_10", np.moveaxis(smooth, 0, -1))
    amber = found(session, "amber")
    assert "fruit_10" in amber["focus"]
    assert "fruit_10" in amber["markers"]


@pytest.mark.parametrize(
    ("stated", "poses", "level"),
    [
        ({"frame_angles_deg": list(range(0, 360, 30))}, "angles", None),
        ({"frame_angles_deg": [0, 30]}, "angles", "red"),
        ({"frame_angles_deg": [0, 30]}, "auto", "amber"),
        ({}, "angles", "red"),
        ({}, "auto", None),
        ({"nominal_step_deg": 30}, "angles", None),
    ],
)
def test_angles_that_poses_need_are_asked_for(session, stated, poses, level):
    (session / "session.json").write_text(json.dumps({**INFO, **stated}))
    findings = check_angles(open_session(session), poses, SEEN)
    assert [(f.name, f.level) for f in findings] == ([] if level is None else [("angles", level)])


def test_angles_are_asked_for_before_any_computing(session):
    (session / "session.json").write_text(json.dumps({**INFO, "frame_angles_deg": [0, 30]}))
    findings = inspect_session(open_session(session), "angles").findings
    assert [f.level for f in findings if f.name == "angles"] == ["red"]


@pytest.mark.parametrize(
    ("name", "stated", "poses", "level"),
    [
        ("fruit_05", {"nominal_step_deg": 30}, "angles", "red"),
        ("fruit_05", {"nominal_step_deg": 30}, "colmap", "amber"),
        ("fruit_05", {"nominal_step_deg": 30}, "auto", "green"),
        ("fruit_05", {"frame_angles_deg": list(range(0, 360, 30))}, "angles", None),
        ("fruit_11", {"nominal_step_deg": 30}, "angles", None),
    ],
)
def test_the_place_of_a_capture_that_is_left_out_is_stated(session, name, stated, poses, level):
    (session / "session.json").write_text(json.dumps({**INFO, "nominal_step_deg": None, **stated}))
    findings = check_angles(open_session(session, exclude=[name]), poses, SEEN)
    assert [finding.level for finding in findings] == ([] if level is None else [level])
    for finding in findings:
        assert name in finding.sentence
        assert finding.values["fruit_06"] == 180.0


@pytest.mark.slow
def test_without_session_json_it_is_written_for_the_user(good, tmp_path):
    session = Path(shutil.copytree(good, tmp_path / "fruits"))
    (session / "session.json").unlink()
    inspection, findings = inspect(session)
    assert findings["scale"].level == "red"
    assert inspection.session_json == {
        "object": "fruits",
        "marker_dictionary": "DICT_5X5_50",
        "marker_side_m": None,
        "nominal_step_deg": 30.0,
        "direction": "ccw",
    }
    assert inspect_session(open_session(session), poses="colmap").findings[-1].level == "amber"


@pytest.mark.parametrize(
    ("captures", "left_out", "turned_deg", "nominal_deg"),
    [
        (60, [30], [6.01 * place for place in range(60)], 6.0),
        (60, [0, 59], [5.99 * place for place in range(60)], 6.0),
        (60, range(1, 60, 2), [6.01 * place for place in range(60)], 6.0),
        (61, [30], [6.01 * (place - (place > 30)) for place in range(61)], 6.0),  # the table did not turn for it
        (20, [10], [6.01 * place for place in range(20)], 6.0),
        (60, [], [6.01 * place for place in range(60)], 6.0),
    ],
)
def test_a_whole_turn_counts_captures_that_are_left_out(tmp_path, captures, left_out, turned_deg, nominal_deg):
    turn = tuple(f"fruit_{place:02d}" for place in range(captures))
    kept = [place for place in range(captures) if place not in left_out]
    frames = tuple(SimpleNamespace(name=turn[place]) for place in kept)
    markers = Markers("DICT_5X5_50", [{}] * len(kept), np.array(turned_deg)[kept], 0, 20.0, 0.1)
    content = filled_in(Session(tmp_path, SessionInfo(), None, frames, turn=turn), markers)
    assert (content["nominal_step_deg"], content["direction"]) == (nominal_deg, "ccw")


@pytest.mark.parametrize("quarter_turns", [0, 3])
def test_upright_is_measured_and_goes_before_the_instruments_habit(tmp_path, quarter_turns):
    session = write_turntable(tmp_path / "s", info=INFO, quarter_turns=quarter_turns, clockwise=True)
    for header in session.glob("fruit_*/capture/fruit_*.hdr"):
        header.write_text(header.read_text() + "sensor type = SPECIM IQ\n")
    opened = open_session(session)
    assert opened.image_rotation_deg == 90
    inspection, findings = inspect(session)
    assert inspection.session.image_rotation_deg == 90 * quarter_turns
    assert findings["turn"].values["direction"] == "cw"


@pytest.mark.parametrize(
    ("spoil", "poses", "name", "level"),
    [
        ({"direction": "cw"}, "auto", "turn", "red"),
        ({"image_rotation_deg": 90}, "colmap", "upright", "amber"),
        ({"image_rotation_deg": 180}, "auto", "upright", "amber"),
        ({"image_rotation_deg": 180}, "colmap", "upright", "red"),
        ({"image_rotation_deg": 180}, "angles", "upright", "red"),
    ],
)
def test_session_json_that_the_markers_contradict(session, spoil, poses, name, level):
    (session / "session.json").write_text(json.dumps({**INFO, **spoil}))
    findings = inspect_session(open_session(session), poses).findings
    assert [finding.level for finding in findings if finding.name == name] == [level]


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "dictionary_is_stated"), [(0, False), (1, True)])
def test_mirrored_images(session, axis, dictionary_is_stated):
    for header in session.glob("*/capture/*.hdr"):
        cube = open_cube(header)
        counts = np.flip(cube.read(), axis if not header.name.startswith("DARKREF") else 1)
        write_cube(header, counts, wavelengths_nm=cube.wavelengths_nm)
    if not dictionary_is_stated:
        (session / "session.json").unlink()
    red = list(found(session, "red"))
    # Without session.json nothing gives the scale.
    assert red == ["mirrored"] if dictionary_is_stated else "mirrored" in red


def test_a_session_without_markers_is_not_mirrored(session):
    for number in range(12):
        gray = np.full((SIZE_PX, SIZE_PX), 90.0)
        write_one(session, f"fruit_{number:02d}", frame_picture(gray, spot_px=7.0, angle_deg=30.0 * number))
    assert "mirrored" not in found(session, "red")


def test_a_turn_with_a_gap_and_a_stop(session):
    for name in ("fruit_05", "fruit_06"):
        shutil.rmtree(session / name)
    for file in (session / "fruit_09" / "capture").iterdir():
        shutil.copy(file, session / "fruit_10" / "capture" / file.name.replace("fruit_09", "fruit_10"))
    _, findings = inspect(session)
    assert findings["turn"].level == "amber"
    assert "fruit_09 to fruit_10" in findings["turn"].sentence
    assert findings["turn"].values["largest_gap_deg"] == pytest.approx(90.0, abs=6.0)


def test_frames_of_a_table_that_turned_there_and_back(session):
    for number, shown in enumerate([0, 2, 4, 6, 8, 10, 10, 8, 6, 4, 2, 0]):
        write_one(session, f"fruit_{number:02d}", rendered(12)[shown])
    inspection, findings = inspect(session)
    assert findings["turn"].level == "amber"
    assert "order" in findings["turn"].sentence
    assert "direction" not in inspection.session_json
