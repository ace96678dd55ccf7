"""The markers' paper tells of a white that is none, or of an exposure that was not as long as its header says."""

import json
import re

import numpy as np
import pytest
from inspection_session import INFO, LAMP, WAVELENGTHS_NM, write_white

from hsi_sc_nerf.capture.envi import open_cube, write_cube
from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.inspection.inspect import inspect_session

PAPER = 0.76
"""Of the scene, relative to its white."""


def paper(folder):
    (found,) = [f for f in inspect_session(open_session(folder)).findings if f.name == "paper"]
    return found


@pytest.mark.parametrize(("white", "level"), [(0.9, "green"), (0.45, "amber"), (0.2, "red")])
def test_a_grey_white(session, white, level):
    write_white(session, white)
    found = paper(session)
    assert found.level == level
    assert found.values["reflectance"] == pytest.approx(PAPER / white, rel=0.15)
    assert ("too high" in found.sentence) == (level != "green")


def test_a_tarp_that_is_not_used_is_not_judged(session):
    write_white(session, 0.2)
    findings = inspect_session(open_session(session), white_source="target").findings
    assert {finding.level for finding in findings if finding.name.startswith("white")} == {"green"}
    assert "paper" not in [finding.name for finding in findings]


@pytest.mark.parametrize(("stated_ms", "level"), [(10, "green"), (40, "amber"), (10_000, "red")])
def test_an_integration_time_that_is_not_as_stated(session, stated_ms, level):
    for header in session.glob("fruit_*/capture/*.hdr"):
        header.write_text(re.sub(r"tint = \d+", f"tint = {stated_ms}", header.read_text()))
    found = paper(session)
    assert found.level == level
    assert found.values["reflectance"] == pytest.approx(PAPER * 10 / stated_ms, rel=0.1)
    assert ("too low" in found.sentence) == (level != "green")


@pytest.mark.parametrize(("veil", "level"), [(0.0, "green"), (0.1, "amber"), (0.2, "red")])
def test_stray_light_over_all_frames(session, veil, level):
    for frame in session.glob("fruit_*"):
        cube = open_cube(frame / "capture" / f"{frame.name}.hdr")
        counts = np.clip(cube.read() + np.rint(veil * LAMP), 0, 4095).astype(np.uint16)
        write_cube(cube.header_path, counts, wavelengths_nm=WAVELENGTHS_NM)
    (found,) = [f for f in inspect_session(open_session(session)).findings if f.name == "veil"]
    assert found.level == level
    assert found.values["value"] == pytest.approx((0.03 + veil) / (PAPER + veil), abs=0.05)


def test_without_a_tarp_or_markers_nothing_is_said(session):
    (session / "session.json").write_text(json.dumps({**INFO, "marker_dictionary": "DICT_7X7_50"}))
    assert [f for f in inspect_session(open_session(session)).findings if f.name in ("paper", "veil")] == []
