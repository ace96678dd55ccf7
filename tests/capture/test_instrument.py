"""Whole SPECIM IQ captures: metadata, whites of their own, finished reflectance, images on their side."""

import json
from pathlib import Path

import numpy as np
import pytest
from capture_factory import BANDS, SIZE_PX, WAVELENGTHS_NM

from hsi_sc_nerf.calibration.white_source import white_source
from hsi_sc_nerf.capture.envi import write_cube
from hsi_sc_nerf.capture.instrument import natural_order, read_metadata
from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.processing.frames import capture_files, session_files

XML = """<?xml version="1.0" encoding="UTF-8"?>
<properties><metadata>
  <key field="integration_time">{time}</key><key field="WR_mode">{mode}</key>
  <key field="datetime">01 Jun 2024 10:00:00 +0000</key>
</metadata></properties>
"""
COUNTS = np.full((SIZE_PX, SIZE_PX, BANDS), 500, np.uint16)
SLAB = np.full((1, SIZE_PX, BANDS), 900, np.uint16)
REFLECTANCE = np.full((SIZE_PX, SIZE_PX, BANDS), 0.4, np.float32)


def write(header: Path, cube: np.ndarray, tint: float | None = None, **fields) -> None:
    suffix = ".dat" if cube.dtype == np.float32 else ".raw"
    extra = fields if tint is None else {"tint": tint, **fields}
    write_cube(header, cube, wavelengths_nm=WAVELENGTHS_NM, data_suffix=suffix, extra_header=extra)


def write_capture(
    session: Path,
    name: str,
    *,
    counts: bool = True,
    white: bool = True,
    white_dark: bool = True,
    product: bool = True,
    tints: tuple[float | None, float | None] = (10.0, 4.0),
    xml: str | None = None,
) -> None:
    """``tints``: of the capture and of its white."""
    capture = session / name / "capture"
    if counts:
        write(capture / f"{name}.hdr", COUNTS, tints[0])
        write(capture / f"DARKREF_{name}.hdr", SLAB, tints[0])
    if white:
        write(capture / f"WHITEREF_{name}.hdr", SLAB, tints[1])
    if white_dark:
        write(capture / f"WHITEDARKREF_{name}.hdr", SLAB, tints[1])
    if product:
        write(session / name / "results" / f"REFLECTANCE_{name}.hdr", REFLECTANCE)
    if xml is not None:
        (session / name / "metadata").mkdir()
        (session / name / "metadata" / f"{name}.xml").write_text(xml)


@pytest.mark.parametrize(
    ("fields", "fwhm_nm"),
    [
        ({"sensor type": "SPECIM IQ", "binning": [1, 1]}, 7.0),
        ({"description": "Data recorded with Specim IQ"}, 7.0),
        ({"sensor type": "SPECIM IQ", "fwhm": [5.5] * BANDS}, 5.5),
        ({"sensor type": "SPECIM IQ", "binning": [2, 1]}, None),
        ({"sensor type": "FX10"}, None),
        ({}, None),
    ],
)
def test_band_widths_are_listed_or_those_of_the_camera(tmp_path, fields, fwhm_nm):
    for name in ("a", "b"):
        write(tmp_path / f"REFLECTANCE_{name}.hdr", REFLECTANCE, **fields)
    widths_nm = open_session(tmp_path).frames[0].cube.fwhm_nm
    assert widths_nm is None if fwhm_nm is None else (widths_nm == np.full(BANDS, fwhm_nm)).all()


def two(session: Path, **options) -> Path:
    for name in ("444", "445"):
        write_capture(session, name, **options)
    return session


def name_of(cube) -> str | None:
    return None if cube is None else cube.header_path.stem


def test_a_whole_capture(tmp_path):
    session = open_session(two(tmp_path, xml=XML.format(time=10, mode="Custom")))
    assert session.white is None
    assert (session.has_counts, session.has_own_whites, session.has_products) == (True, True, True)
    first = session.frames[0]
    cubes = (first.cube, first.dark, first.white, first.white_dark, first.product)
    assert [name_of(cube) for cube in cubes] == [
        "444", "DARKREF_444", "WHITEREF_444", "WHITEDARKREF_444", "REFLECTANCE_444",
    ]  # fmt: skip
    assert first.has_counts
    assert first.product.data_path.suffix == ".dat"
    assert (first.integration_time_ms, first.white_integration_time_ms) == (10.0, 4.0)


def test_finished_reflectance_alone(tmp_path):
    session = open_session(two(tmp_path, counts=False, white=False, white_dark=False))
    assert (session.has_counts, session.has_own_whites, session.has_products) == (False, False, True)
    first = session.frames[0]
    assert first.cube is first.product
    assert not first.has_counts
    assert first.cubes == (first.product,)
    np.testing.assert_array_equal(first.cube.read(), REFLECTANCE)


@pytest.mark.parametrize("raw", [True, False])
def test_a_tarp_beside_frames_that_have_everything_is_a_white_if_it_has_counts(tmp_path, raw):
    write_capture(two(tmp_path), "white_reference", counts=raw, white=raw, white_dark=raw, tints=(2.5, None))
    session = open_session(tmp_path)
    assert (session.white and session.white.integration_time_ms) == (2.5 if raw else None)
    assert [frame.name for frame in session.frames] == ["444", "445"]


@pytest.mark.parametrize(
    ("mode", "options", "expected"),
    [
        ("Custom", {}, "WHITEDARKREF_444"),
        ("Simultaneous", {}, "DARKREF_444"),
        (" simultaneous ", {"white_dark": False}, "DARKREF_444"),
        ("Custom", {"white_dark": False}, None),  # exposed otherwise, 4 ms: no dark fits
        ("Custom", {"white_dark": False, "tints": (10.0, 10.0)}, "DARKREF_444"),
        (None, {}, "WHITEDARKREF_444"),
    ],
)
def test_dark_of_the_white(tmp_path, mode, options, expected):
    session = open_session(two(tmp_path, xml=XML.format(time=10, mode=mode) if mode else None, **options))
    assert name_of(session.frames[0].white_dark) == expected


@pytest.mark.parametrize(
    ("tints", "time", "mode", "expected"),
    [
        ((10.0, 4.0), "99", "Custom", (10.0, 4.0)),  # the headers go before the metadata
        ((None, None), "12.5", "Simultaneous", (12.5, 12.5)),
        ((None, None), "12.5", "Custom", (12.5, None)),  # a white of another time
    ],
)
def test_integration_times(tmp_path, tints, time, mode, expected):
    first = open_session(two(tmp_path, tints=tints, xml=XML.format(time=time, mode=mode))).frames[0]
    assert (first.integration_time_ms, first.white_integration_time_ms) == expected


@pytest.mark.parametrize(
    "text",
    [
        '<p xmlns="http://x"><d><key field="integration_time">8</key></d></p>',
        '<a:p xmlns:a="http://x"><a:key field="Integration Time" unit="ms"> 8.0 </a:key></a:p>',
        "<p><integrationTime>8 ms</integrationTime></p>",
        '<p><key name="INTEGRATION-TIME">8e0</key></p>',
        '<p><key field="tint">8</key></p>',
    ],
)
def test_spellings_of_the_integration_time(tmp_path, text):
    (tmp_path / "a.xml").write_text(text)
    assert read_metadata(tmp_path / "a.xml").integration_time_ms == 8.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not readable XML"),
        ('<p><key field="integration_time">', "not readable XML"),
        ('<?xml version="1.0" encoding="klingon"?><p/>', "not readable XML"),
        ('<p><key field="integration_time">long</key></p>', "'long' is not a positive number of ms"),
        ('<p><key field="integration_time">0</key></p>', "'0' is not a positive"),
        ('<p><key field="integration_time">1.2.3</key></p>', "'1.2.3' is not a positive"),
    ],
)
def test_broken_metadata(tmp_path, text, message):
    (tmp_path / "a.xml").write_text(text)
    with pytest.raises(InputError, match=rf"a\.xml: .*{message}"):
        read_metadata(tmp_path / "a.xml")


def test_broken_metadata_matter_only_where_something_in_them_is_needed(tmp_path):
    assert len(open_session(two(tmp_path, white=False, white_dark=False, xml="<broken")).frames) == 2
    write_capture(tmp_path, "446", xml="<broken")
    with pytest.raises(InputError, match=r"446 \(is not readable XML"):
        open_session(tmp_path)


@pytest.mark.parametrize(
    ("fields", "rotation_deg"),
    [
        ({"sensor type": "SPECIM IQ"}, 90),
        ({"description": "{Specim IQ capture}"}, 90),
        ({"sensor type": "simulated SPECIM IQ"}, 0),
        ({}, 0),
    ],
)
def test_a_real_instrument_lies_on_its_side(tmp_path, fields, rotation_deg):
    two(tmp_path)
    write(tmp_path / "444" / "capture" / "444.hdr", COUNTS, 10.0, **fields)
    session = open_session(tmp_path)
    assert session.image_rotation_deg == rotation_deg


@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
def test_quarter_turns_set_upright(tmp_path, rotation_deg):
    two(tmp_path, xml=XML.format(time=10, mode="Custom"))
    (tmp_path / "session.json").write_text(json.dumps({"image_rotation_deg": rotation_deg}))
    session = open_session(tmp_path)
    upright = np.arange(6).reshape(2, 3)
    lying = np.rot90(upright, rotation_deg // 90)
    np.testing.assert_array_equal(np.rot90(lying, session.quarter_turns), upright)
    assert 0 <= session.quarter_turns < 4


def test_a_renamed_folder(tmp_path):
    two(tmp_path, xml=XML.format(time=10, mode="Custom"))
    (tmp_path / "444").rename(tmp_path / "apple_left")
    session = open_session(tmp_path)
    assert [frame.name for frame in session.frames] == ["445", "apple_left"]
    assert name_of(session.frames[1].white) == "WHITEREF_444"
    assert session.frames[1].metadata.path.name == "444.xml"


def test_names_that_differ_in_capitals_only_are_refused(tmp_path):
    for name in ("Ball_1", "ball_1", "ball_2"):
        write(tmp_path / f"{name}.hdr", COUNTS)
    with pytest.raises(InputError, match="Ball_1 and ball_1 differ in capitals only"):
        open_session(tmp_path)


def test_a_digit_that_is_no_number_is_a_letter():
    assert natural_order("apple_2²") < natural_order("apple_10")


def test_plain_folder_with_the_same_prefixes(tmp_path):
    for name in ("a", "b"):
        write(tmp_path / f"{name}.raw.hdr", COUNTS, 10.0)
        (tmp_path / f"{name}.raw.raw").rename(tmp_path / f"{name}.raw")
        for prefix in ("DARKREF", "WHITEREF", "WHITEDARKREF"):
            write(tmp_path / f"{prefix}_{name}.hdr", SLAB, 10.0)
        write(tmp_path / f"REFLECTANCE_{name}.hdr", REFLECTANCE)
    write(tmp_path / "REFLECTANCE_c.hdr", REFLECTANCE)
    session = open_session(tmp_path)
    assert [frame.name for frame in session.frames] == ["a", "b", "c"]
    assert [name_of(cube) for cube in session.frames[1].cubes] == [
        "b.raw", "DARKREF_b", "WHITEREF_b", "WHITEDARKREF_b", "REFLECTANCE_b",
    ]  # fmt: skip
    assert [frame.has_counts for frame in session.frames] == [True, True, False]
    assert (session.has_own_whites, session.has_products) == (False, True)


@pytest.mark.parametrize("of_446", [False, True])
def test_nothing_to_calibrate_with(tmp_path, of_446):
    two(tmp_path, white=of_446, product=False)
    write_capture(tmp_path, "446", white=False, product=False)
    with pytest.raises(InputError, match=r"no capture called white_reference; .*WHITEREF_NAME or REFLECTANCE_NAME"):
        white_source(open_session(tmp_path))


def test_a_frame_that_no_white_can_serve(tmp_path):
    for name in ("1", "2", "white_reference"):
        write_capture(tmp_path, name, white=False, product=False)
    write_capture(tmp_path, "3", counts=False, white=False)
    with pytest.raises(InputError, match=r"REFLECTANCE_3\.hdr: there are no raw counts"):
        white_source(open_session(tmp_path))


def test_fingerprint_covers_every_file_that_matters(tmp_path):
    two(tmp_path, xml=XML.format(time=10, mode="Custom"))
    write_capture(tmp_path, "white_reference", white=False, white_dark=False, product=False)
    (tmp_path / "bands.csv").write_text("wavelength_nm\n" + "".join(f"{w}\n" for w in WAVELENGTHS_NM))
    (tmp_path / "panel.csv").write_text("wavelength_nm,reflectance\n400,0.98\n1000,0.97\n")
    (tmp_path / "session.json").write_text('{"band_centres": "bands.csv", "panel_reflectance": "panel.csv"}')
    session = open_session(tmp_path)
    assert sorted(name for name, _, _ in capture_files(session, session.frames[0])) == sorted(
        [f"444/capture/{prefix}444{suffix}" for prefix in ("", "DARKREF_", "WHITEREF_", "WHITEDARKREF_")
         for suffix in (".hdr", ".raw")]
        + ["444/results/REFLECTANCE_444.hdr", "444/results/REFLECTANCE_444.dat", "444/metadata/444.xml"]
    )  # fmt: skip
    shared = {name for name, _, _ in session_files(session)[0]}
    assert {"session.json", "bands.csv", "panel.csv", "white_reference/capture/white_reference.raw"} <= shared
    before = session_files(session)
    (tmp_path / "panel.csv").write_text("wavelength_nm,reflectance\n400,0.98\n1000,0.975\n")
    assert session_files(session) != before
