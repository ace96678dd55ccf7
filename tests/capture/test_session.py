import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from capture_factory import BANDS, INFO, SIZE_PX, WAVELENGTHS_NM, write_capture, write_session

from hsi_sc_nerf.capture.envi import write_cube
from hsi_sc_nerf.capture.session import is_session, open_session
from hsi_sc_nerf.capture.session_info import read_session_info
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


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["a", "white_reference"], "a single frame"),
        (["white_reference"], "no frames"),
        ([], "holds no captures"),
    ],
)
def test_captures_that_make_no_session(tmp_path, names, words):
    for name in names:
        write_capture(tmp_path, name, COUNTS)
    with pytest.raises(InputError, match=words):
        open_session(tmp_path)
    with pytest.raises(InputError, match="no such session folder"):
        open_session(tmp_path / "absent")


def other_bands(session: Path, name: str) -> None:
    write_capture(session, name, COUNTS, wavelengths_nm=WAVELENGTHS_NM + 0.5)


def fewer_bands(session: Path, name: str) -> None:
    write_capture(session, name, COUNTS[..., 1:], wavelengths_nm=WAVELENGTHS_NM[1:])


def no_header(session: Path, name: str) -> None:
    (session / name / "capture" / f"{name}.hdr").unlink()


def no_bytes(session: Path, name: str) -> None:
    (session / name / "capture" / f"{name}.raw").write_bytes(b"")


def no_capture_folder(session: Path, name: str) -> None:
    (session / name / "capture").rename(session / name / "cubes")


DAMAGE = {
    other_bands: r"ball_2 \(its bands differ.*ball_1\.hdr",
    fewer_bands: r"ball_2 \(its bands differ",
    lambda session, name: write_capture(session, name, COUNTS[1:]): r"ball_2 \(its \(47, 48\) lines",
    no_header: r"ball_2 \(has no capture/ball_2\.hdr",
    no_bytes: r"ball_2 \(has 0 bytes, fewer",
    no_capture_folder: r"ball_2 \(has no folder capture/",
}


@pytest.mark.parametrize(("damage", "message"), DAMAGE.items())
def test_a_damaged_capture_is_named_or_left_out(tmp_path, damage, message):
    write_session(tmp_path)
    damage(tmp_path, "ball_2")
    with pytest.raises(InputError, match=message + ".*--skip-damaged"):
        open_session(tmp_path)
    session = open_session(tmp_path, skip_damaged=True)
    assert [frame.name for frame in session.frames] == ["ball_1", "ball_3", "ball_4"]
    assert list(session.damaged) == ["ball_2"]
    assert not open_session(tmp_path, exclude=["ball_2"]).damaged


def test_all_damaged_captures_are_named_at_once_and_the_first_frame_may_be_one(tmp_path):
    write_session(tmp_path, angles_deg=(0, 60, 120, 180, 240))
    no_bytes(tmp_path, "ball_1")
    no_header(tmp_path, "ball_4")
    fewer_bands(tmp_path, "ball_5")
    with pytest.raises(InputError, match=r"ball_4 \(.*ball_1 \(.*0 bytes.*ball_5 \("):
        open_session(tmp_path)
    assert [frame.name for frame in open_session(tmp_path, skip_damaged=True).frames] == ["ball_2", "ball_3"]


@pytest.mark.parametrize(
    ("left_out", "names", "places"),
    [
        ({}, ["ball_1", "ball_2", "ball_3", "ball_4"], (0, 1, 2, 3)),
        ({"skip_damaged": True}, ["ball_1", "ball_3", "ball_4"], (0, 2, 3)),
        ({"exclude": ["ball_2", "tarp_3"]}, ["ball_1", "ball_3", "ball_4"], (0, 2, 3)),
        ({"exclude": ["ball_1"], "skip_damaged": True}, ["ball_3", "ball_4"], (2, 3)),
    ],
)
@pytest.mark.parametrize("specim", [True, False])
def test_a_capture_that_is_left_out_keeps_its_place_in_the_turn(tmp_path, specim, left_out, names, places):
    angles_deg = [0, 90, 180, 270] if "exclude" not in left_out else [0, 90, 180, 271]
    write_session(tmp_path, specim=specim, info={**INFO, "frame_angles_deg": angles_deg})
    if "skip_damaged" in left_out:
        (next(tmp_path.rglob("ball_2.*[!r]"))).write_bytes(b"")
    if "tarp_3" in left_out.get("exclude", ()):
        write_capture(tmp_path, "tarp_3", COUNTS, specim=specim)
    session = open_session(tmp_path, **left_out)
    assert ([frame.name for frame in session.frames], session.places) == (names, places)
    assert session.info.frame_angles_deg == tuple(angles_deg[place] for place in places)
    (tmp_path / "session.json").write_text(json.dumps({"frame_angles_deg": [0.5] * len(names)}))
    assert open_session(tmp_path, **left_out).info.frame_angles_deg == (0.5,) * len(names)


@pytest.mark.parametrize("specim", [True, False])
def test_the_table_did_not_turn_for_a_copy_that_is_left_out(tmp_path, specim):
    write_session(tmp_path, specim=specim, info={**INFO, "frame_angles_deg": [0, 90, 180, 270]})
    copy = "ball_2 - Copy"
    for file in list(tmp_path.rglob("*ball_2.*")):
        to = tmp_path / copy / "capture" if specim else tmp_path
        to.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, to / file.name.replace("ball_2", copy))
    assert open_session(tmp_path).places == (0, 1, 2, 3, 4)
    for left_out, names, places in (
        ([copy], ["ball_1", "ball_2", "ball_3", "ball_4"], (0, 1, 2, 3)),
        (["ball_2"], ["ball_1", copy, "ball_3", "ball_4"], (0, 1, 2, 3)),
        (["ball_2", copy], ["ball_1", "ball_3", "ball_4"], (0, 2, 3)),
    ):
        session = open_session(tmp_path, exclude=left_out)
        assert ([frame.name for frame in session.frames], session.places) == (names, places)
        assert session.info.frame_angles_deg == tuple(90.0 * place for place in places)
    # One angle of each capture, the copy's too.
    (tmp_path / "session.json").write_text(json.dumps({**INFO, "frame_angles_deg": [0, 90, 90, 180, 270]}))
    assert open_session(tmp_path, exclude=[copy]).info.frame_angles_deg == (0.0, 90.0, 180.0, 270.0)


def test_a_damaged_white_is_not_left_out(tmp_path):
    write_session(tmp_path)
    no_bytes(tmp_path, "white_reference")
    with pytest.raises(InputError, match=r"white_reference\.raw: has 0 bytes"):
        open_session(tmp_path, skip_damaged=True)


@pytest.mark.parametrize("specim", [True, False])
def test_everything_in_the_folder_is_accounted_for(tmp_path, specim):
    write_session(tmp_path, specim=specim)
    (tmp_path / "notes").mkdir()
    for ending in ("hdr", "raw"):  # as macOS leaves them on a memory card
        (tmp_path / f"._ball_1.{ending}").write_bytes(b"\0\5\x16\7")
    session = open_session(tmp_path, exclude=["ball_3"])
    assert [frame.name for frame in session.frames] == ["ball_1", "ball_2", "ball_4"]
    assert (session.excluded, list(session.skipped)) == (("ball_3",), ["notes"])
    with pytest.raises(InputError, match="has no capture ball_33"):
        open_session(tmp_path, exclude=["ball_33"])


def test_a_cube_without_header_is_named(tmp_path):
    write_session(tmp_path, specim=False)
    (tmp_path / "ball_3.hdr").unlink()
    assert list(open_session(tmp_path, skip_damaged=True).damaged) == ["ball_3.raw"]


def test_a_white_that_is_stated_but_not_there_is_not_replaced_by_another(tmp_path):
    write_session(tmp_path, info={**INFO, "white_reference": "ball_33"})
    for number in range(1, 5):
        white = tmp_path / f"ball_{number}" / "capture" / f"WHITEREF_ball_{number}.hdr"
        write_cube(white, COUNTS[:2], wavelengths_nm=WAVELENGTHS_NM)
    with pytest.raises(InputError, match=r"session\.json: names ball_33 as white_reference, but there is no such"):
        open_session(tmp_path)


@pytest.mark.parametrize(("others", "white"), [((), "Tarp_2"), (("panel",), None)])
def test_a_white_is_known_by_its_name_if_it_is_the_only_one(tmp_path, others, white):
    for name in ("a", "b", "Tarp_2", *others):
        write_capture(tmp_path, name, COUNTS)
    session = open_session(tmp_path)
    if white is None:
        assert session.white is None
    else:
        assert (session.white.name, session.info.white_reference) == (white, white)


def test_opening_reads_no_data(tmp_path, monkeypatch):
    write_session(tmp_path)
    monkeypatch.setattr(np, "memmap", None)
    open_session(tmp_path)


def test_two_shared_dark_cubes(tmp_path):
    for name in ("a", "b", "white_reference", "dark_1", "dark_2"):
        write_cube(tmp_path / f"{name}.hdr", COUNTS, wavelengths_nm=WAVELENGTHS_NM)
    with pytest.raises(InputError, match=r"dark_1\.hdr and dark_2\.hdr"):
        open_session(tmp_path)


def without_wavelengths(header: Path) -> None:
    text = header.read_text()
    header.write_text(text[: text.index("wavelength = {")])


def test_wavelengths_of_another_cube(tmp_path):
    write_session(tmp_path)
    for name in ("ball_1", "DARKREF_ball_1", "ball_3"):
        without_wavelengths(tmp_path / name.removeprefix("DARKREF_") / "capture" / f"{name}.hdr")
    session = open_session(tmp_path)
    for frame in session.frames:
        np.testing.assert_array_equal(frame.cube.wavelengths_nm, WAVELENGTHS_NM)


def test_wavelengths_of_a_list_beside_session_json(tmp_path):
    write_session(tmp_path, info={**INFO, "band_centres": "bands.csv", "panel_reflectance": "panel.csv"})
    (tmp_path / "bands.csv").write_text("wavelength_nm\n" + "".join(f"{w:.3f}\n" for w in WAVELENGTHS_NM))
    (tmp_path / "panel.csv").write_text("wavelength_nm,reflectance\n400,0.98\n")
    for header in tmp_path.rglob("*.hdr"):
        without_wavelengths(header)
    session = open_session(tmp_path)
    np.testing.assert_allclose(session.wavelengths_nm, WAVELENGTHS_NM, atol=1e-3)
    assert session.panel_reflectance_path == tmp_path / "panel.csv"


def test_wavelengths_that_a_header_rounds_to_equal_ones(tmp_path):
    rounded = np.where(np.arange(BANDS) == 5, WAVELENGTHS_NM[4], WAVELENGTHS_NM).round()
    for name in ("a", "b", "white_reference"):
        write_capture(tmp_path, name, COUNTS, wavelengths_nm=rounded)
    with pytest.raises(InputError, match=f"lists {rounded[4]:g} nm twice.*band_centres"):
        open_session(tmp_path)
    write_cube(tmp_path / "a" / "capture" / "DARKREF_a.hdr", COUNTS, wavelengths_nm=WAVELENGTHS_NM)
    np.testing.assert_array_equal(open_session(tmp_path).wavelengths_nm, WAVELENGTHS_NM)
    (tmp_path / "bands.csv").write_text("wavelength (um)\n" + "".join(f"{w / 1000:.6f}\n" for w in WAVELENGTHS_NM))
    (tmp_path / "session.json").write_text('{"band_centres": "bands.csv"}')
    write_cube(tmp_path / "a" / "capture" / "DARKREF_a.hdr", COUNTS, wavelengths_nm=rounded)
    np.testing.assert_allclose(open_session(tmp_path).wavelengths_nm, WAVELENGTHS_NM, atol=1e-3)
    (tmp_path / "bands.csv").write_text("400\n500\n")
    with pytest.raises(InputError, match=f"lists {rounded[4]:g} nm twice"):
        open_session(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("wavelength_nm\n400\n500\n400\n", r"bands\.csv: lists 400 nm twice"),
        ("wavelength (um)\n400\n500\n", r"bands\.csv: its band centres are not wavelengths"),
        ("wavelength_nm\n400\n500\n", "2 band centres do not fit"),
        ("wavelength_nm\nred\n", r"bands\.csv: is not a list of band centres"),
        ("wavelength_nm\n", r"bands\.csv: its band centres are not wavelengths in nm"),
        ("wavelength_nm\n0.4\n0.5\n", r"bands\.csv: its band centres are not wavelengths in nm"),
        (None, r"\.hdr: gives no wavelengths; .*'band_centres' in session\.json"),
    ],
)
def test_without_band_centres_that_can_be_used(tmp_path, content, message):
    write_session(tmp_path, info={**INFO, **({"band_centres": "bands.csv"} if content else {})})
    (tmp_path / "bands.csv").write_text(content or "")
    for header in tmp_path.rglob("*.hdr"):
        without_wavelengths(header)
    with pytest.raises(InputError, match=message):
        open_session(tmp_path)


def test_something_else_in_the_place_of_session_info_is_not_taken_for_none(tmp_path):
    (tmp_path / "session.json").mkdir()
    (tmp_path / "elsewhere.json").symlink_to(tmp_path / "gone.json")
    for name in ("session.json", "elsewhere.json"):
        with pytest.raises(InputError, match=rf"{name}: cannot be read"):
            read_session_info(tmp_path / name)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not a JSON object [^][]*nominal_step_deg, direction"),
        ("[]", "not a JSON object"),
        ('{"marker_size": 1}', "marker_size is not a known key; .*marker_side_m"),
        ('{"marker_side_m": "2 cm"}', "marker_side_m is '2 cm'"),
        ('{"marker_side_m": 0}', "positive number"),
        ('{"marker_side_m": 36}', "marker_side_m is 36, but must be a length in metres"),
        ('{"camera_distance_m": 450}', "a length in metres"),
        ('{"container_diameter_m": 9, "container_height_m": 0.07}', "a length in metres"),
        ('{"marker_side_m": true}', "must be a number"),
        ('{"direction": "left"}', "must be one of ccw, cw"),
        ('{"object": 3}', "must be a text"),
        ('{"object": ""}', "must be a text"),
        ('{"marker_dictionary": "DICT_9X9_50"}', "OpenCV's name of a dictionary"),
        ('{"marker_dictionary": "Dictionary"}', "OpenCV's name of a dictionary"),
        ('{"image_rotation_deg": 45}', "0, 90, 180 or 270 degrees"),
        ('{"image_rotation_deg": false}', "a whole number"),
        ('{"band_centres": "absent.csv"}', "band_centres is 'absent.csv', but must be the name of a CSV file beside"),
        ('{"panel_reflectance": "."}', "panel_reflectance is '.', but must be the name of a CSV file beside"),
        ('{"panel_reflectance": 0.98}', "panel_reflectance is 0.98, but must be a text"),
        ('{"container_height_m": 0.07}', "one dimension of the container"),
        (f'{{"marker_side_m": 1{"0" * 400}}}', "must be a number"),
        (f'{{"marker_side_m": {"9" * 5000}}}', "not a JSON object"),
        (f'{{"frame_angles_deg": [0, 1{"0" * 400}]}}', r"frame_angles_deg\[1\] is .* must be a number"),
        (f'{{"band_centres": "{"a" * 5000}"}}', "the name of a CSV file beside"),
        (f'{{"object": {"[" * 900}{"]" * 900}}}', "must be a text"),
        ('{"object": "\\ud800"}', "not a JSON object"),
        ("[" * 100_000, "not a JSON object"),
    ],
)
def test_bad_session_info(tmp_path, text, message):
    path = tmp_path / "session.json"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"session\.json.*{message}"):
        read_session_info(path)
