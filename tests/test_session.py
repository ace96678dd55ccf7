from __future__ import annotations

import json

import numpy as np
import pytest
from capture_factory import BANDS, INFO, SIZE_PX, WAVELENGTHS_NM, write_capture, write_session

from hsi_sc_nerf.data.envi import write_cube
from hsi_sc_nerf.data.session import is_session, open_session, read_session_info
from hsi_sc_nerf.errors import InputError

COUNTS = np.full((SIZE_PX, SIZE_PX, BANDS), 500, np.uint16)


@pytest.mark.parametrize("specim", [True, False])
def test_both_layouts(tmp_path, specim):
    write_session(tmp_path, angles_deg=(0, 90), specim=specim)
    write_capture(tmp_path, "ball_10", COUNTS, specim=specim)
    (tmp_path / "truth" / "pixels").mkdir(parents=True)
    (tmp_path / "notes").mkdir()
    session = open_session(tmp_path)
    assert [frame.name for frame in session.frames] == ["ball_1", "ball_2", "ball_10"]
    assert session.white.name == "white_reference"
    assert session.info.object == "ball"
    np.testing.assert_array_equal(session.wavelengths_nm, WAVELENGTHS_NM)
    for capture in (*session.frames, session.white):
        assert capture.dark is not None
        assert capture.dark.header_path.name == f"DARKREF_{capture.name}.hdr"
    assert is_session(tmp_path)


def test_plain_folder_with_one_dark_cube_and_a_named_white(tmp_path):
    for name in ("a", "b", "tarp", "dark_reference", "WHITEREF_a"):
        write_cube(tmp_path / f"{name}.hdr", COUNTS, wavelengths_nm=WAVELENGTHS_NM)
    (tmp_path / "session.json").write_text(json.dumps({"white_reference": "tarp"}))
    session = open_session(tmp_path)
    assert [frame.name for frame in session.frames] == ["a", "b"]
    assert session.white.name == "tarp"
    assert {c.dark.header_path.name for c in (*session.frames, session.white) if c.dark} == {"dark_reference.hdr"}


def test_without_dark_cubes_and_session_json(tmp_path):
    for name in ("a", "b", "White_Reference"):
        write_cube(tmp_path / f"{name}.hdr", COUNTS, wavelengths_nm=WAVELENGTHS_NM)
    session = open_session(tmp_path)
    assert session.white.name == "White_Reference"
    assert [frame.dark for frame in session.frames] == [None, None]
    assert session.info.marker_side_m is None


def test_is_session(tmp_path):
    assert not is_session(tmp_path)
    assert not is_session(tmp_path / "absent")
    (tmp_path / "x.hdr").write_text("ENVI\n")
    assert is_session(tmp_path)


def test_missing_and_empty_folders(tmp_path):
    with pytest.raises(InputError, match="no such session folder"):
        open_session(tmp_path / "absent")
    with pytest.raises(InputError, match="holds no captures"):
        open_session(tmp_path)


def test_no_white_reference(tmp_path):
    for name in ("a", "b"):
        write_capture(tmp_path, name, COUNTS)
    with pytest.raises(InputError, match="no capture called white_reference"):
        open_session(tmp_path)


@pytest.mark.parametrize(("frames", "words"), [(["a"], "a single frame"), ([], "no frames")])
def test_too_few_frames(tmp_path, frames, words):
    for name in (*frames, "white_reference"):
        write_capture(tmp_path, name, COUNTS)
    with pytest.raises(InputError, match=words):
        open_session(tmp_path)


def test_a_capture_folder_without_its_cube(tmp_path):
    write_session(tmp_path)
    (tmp_path / "ball_3" / "capture" / "ball_3.hdr").unlink()
    with pytest.raises(InputError, match=r"ball_3: has no capture/ball_3\.hdr"):
        open_session(tmp_path)


@pytest.mark.parametrize("name", ["ball_2", "white_reference"])
def test_other_wavelengths(tmp_path, name):
    write_session(tmp_path)
    write_capture(tmp_path, name, COUNTS, wavelengths_nm=WAVELENGTHS_NM + 0.5)
    with pytest.raises(InputError, match=rf"{name}\.hdr: its bands differ.*ball_1\.hdr"):
        open_session(tmp_path)


def test_other_band_count(tmp_path):
    write_session(tmp_path)
    write_capture(tmp_path, "ball_4", COUNTS[..., 1:], wavelengths_nm=WAVELENGTHS_NM[1:])
    with pytest.raises(InputError, match=r"ball_4\.hdr: its bands differ"):
        open_session(tmp_path)


def test_other_size(tmp_path):
    write_session(tmp_path)
    write_capture(tmp_path, "ball_2", COUNTS[1:])
    with pytest.raises(InputError, match=r"ball_2\.hdr: its \(47, 48\) lines and samples differ"):
        open_session(tmp_path)


def test_two_shared_dark_cubes(tmp_path):
    for name in ("a", "b", "white_reference", "dark_1", "dark_2"):
        write_cube(tmp_path / f"{name}.hdr", COUNTS, wavelengths_nm=WAVELENGTHS_NM)
    with pytest.raises(InputError, match=r"dark_1\.hdr and dark_2\.hdr"):
        open_session(tmp_path)


def test_session_info_round_trip(tmp_path):
    path = tmp_path / "session.json"
    path.write_text(json.dumps({**INFO, "nominal_step_deg": 10, "direction": "cw", "marker_dictionary": None}))
    info = read_session_info(path)
    assert (info.nominal_step_deg, info.direction, info.marker_dictionary) == (10, "cw", None)
    assert info.container_height_m == 0.07


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "no JSON"),
        ("[]", "no JSON object"),
        ('{"marker_size": 1}', "does not know the key marker_size"),
        ('{"marker_side_m": "2 cm"}', "marker_side_m is '2 cm'"),
        ('{"marker_side_m": 0}', "positive number"),
        ('{"marker_side_m": true}', "positive number"),
        ('{"direction": "left"}', "ccw or cw"),
        ('{"object": 3}', "must be a text"),
        ('{"container_height_m": 0.07}', "one dimension of the container"),
    ],
)
def test_bad_session_info(tmp_path, text, message):
    path = tmp_path / "session.json"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"session\.json.*{message}"):
        read_session_info(path)
