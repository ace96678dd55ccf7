"""Pictures of frames are reflectance, whatever the white is and however long it was exposed."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from inspection_session import INFO, WAVELENGTHS_NM, rendered, write_one, write_white

from hsi_sc_nerf.capture.envi import write_cube
from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.inspection.capture_checks import DARK_RED
from hsi_sc_nerf.inspection.inspect import inspect_session
from hsi_sc_nerf.inspection.quicklook import Quicklook, quicklooks_of, reflectance_noise
from hsi_sc_nerf.poses.marker_detection import detect_markers, marker_pattern

WHITE = 0.98
"""Of the scene; what is as bright counts as 1."""


def brightness(folder):
    return float(quicklooks_of(open_session(folder))[0].picture.mean())


@pytest.mark.parametrize("wall", [0.02, 0.2])
@pytest.mark.parametrize("highlights", [0.0, 0.003])
@pytest.mark.parametrize("exposed", [0.2, 1.0, 5.0])
def test_markers_in_a_dark_chamber_that_paper_hardly_fills(wall, highlights, exposed):
    picture = np.full((256, 256), wall)
    picture.ravel()[: round(highlights * picture.size)] = 4.0
    for number in range(2):
        picture[100:140, 60 + 80 * number : 100 + 80 * number] = 0.85
        pattern = marker_pattern("DICT_5X5_50", number).repeat(4, axis=0).repeat(4, axis=1)
        picture[106:134, 66 + 80 * number : 94 + 80 * number] = np.where(pattern, 0.85, 0.04)
    look = SimpleNamespace(picture=exposed * np.repeat(picture[..., None], 3, axis=-1))
    assert sorted(detect_markers(Quicklook.gray.fget(look), "DICT_5X5_50")) == [0, 1]


@pytest.mark.parametrize("times_as_long", [0.8, 5.0])
def test_frames_that_were_exposed_longer_or_shorter_than_the_white(session, times_as_long):
    expected, noise = brightness(session), reflectance_noise(open_session(session))
    write_white(session, WHITE / times_as_long, tint=10 / times_as_long)
    assert brightness(session) == pytest.approx(expected, rel=0.02)
    assert reflectance_noise(open_session(session)) == pytest.approx(noise, rel=0.1)
    levels = {finding.name: finding.level for finding in inspect_session(open_session(session)).findings}
    assert (levels["markers"], levels["turn"], levels["paper"]) == ("green", "green", "green")


@pytest.mark.parametrize(("side_px", "glare_lines"), [(25, 0), (60, 8)])
def test_a_white_that_fills_little_of_a_dark_chamber(session, side_px, glare_lines):
    """It is neither darker because of the chamber, nor brighter because of what mirrors a lamp beside it."""
    expected = brightness(session)
    white = np.full((128, 128, len(WAVELENGTHS_NM)), 0.02)
    white[40 : 40 + side_px, 40 : 40 + side_px] = WHITE
    white[110 : 110 + glare_lines] = 1.4
    write_one(session, "white_reference", white)
    assert brightness(session) == pytest.approx(expected, rel=0.03)
    red = [found.name for found in inspect_session(open_session(session)).findings if found.level == "red"]
    assert red == []


@pytest.mark.parametrize("roi", [None, (30, 30, 90, 90)])
def test_a_white_before_a_wooden_wall_is_judged_where_it_is_stated_to_be(session, roi):
    wood = 0.7 * (1.0 + 0.3 * np.random.default_rng(0).uniform(-1.0, 1.0, (128, 128, 1)))
    white = np.repeat(wood, len(WAVELENGTHS_NM), axis=-1)
    white[30:90, 30:90] = WHITE
    write_one(session, "white_reference", white)
    findings = {finding.name: finding for finding in inspect_session(open_session(session), roi=roi).findings}
    assert findings["white"].level == ("red" if roi is None else "green")
    assert findings["paper"].values["reflectance"] == pytest.approx(0.77 if roi else 0.98, rel=0.05)


def test_a_panel_whose_reflectance_is_known(session):
    expected = brightness(session)
    write_white(session, 0.4)
    (session / "panel.csv").write_text(f"wavelength_nm,reflectance\n400,{0.4 / WHITE}\n1000,{0.4 / WHITE}\n")
    (session / "session.json").write_text(json.dumps({**INFO, "panel_reflectance": "panel.csv"}))
    assert brightness(session) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("references", [False, True])
def test_finished_reflectance_beside_a_raw_white(session, references):
    """Of the counts, which take the most room, only their dark cubes may be left."""
    expected = brightness(session)
    for number, image in enumerate(rendered(12)):
        name = f"fruit_{number:02d}"
        shutil.rmtree(session / name)
        product = session / name / "results" / f"REFLECTANCE_{name}.hdr"
        write_cube(product, image.astype(np.float32), wavelengths_nm=WAVELENGTHS_NM)
        if references:
            header = session / name / "capture" / f"DARKREF_{name}.hdr"
            write_cube(header, np.full((1, *image.shape[1:]), 100, np.uint16), wavelengths_nm=WAVELENGTHS_NM)
    inspection = inspect_session(open_session(session))
    assert inspection.session.white is not None
    assert {frame.dark for frame in inspection.session.frames} == {None}
    # The brightest part of a frame is paper.
    assert inspection.quicklooks[0].picture.mean() == pytest.approx(expected / 0.76, rel=0.2)
    assert inspection.markers.usual_step_deg == pytest.approx(30.0, abs=0.5)


@pytest.mark.parametrize("lines", [1, 2, 8])
def test_a_covered_frame_is_dark_however_few_lines_its_dark_cube_has(session, lines):
    rng = np.random.default_rng(0)
    for prefix, shape in (("", (128, 128, 9)), ("DARKREF_", (lines, 128, 9))):
        header = session / "fruit_00" / "capture" / f"{prefix}fruit_00.hdr"
        counts = np.rint(rng.normal(100.0, 4.0, shape)).astype(np.uint16)
        write_cube(header, counts, wavelengths_nm=WAVELENGTHS_NM, extra_header={"tint": 10})
    covered, lit, *_ = quicklooks_of(open_session(session))
    assert covered.dark_fraction.mean() > DARK_RED
    assert lit.dark_fraction.mean() < 0.05
