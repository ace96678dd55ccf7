import signal

import numpy as np
import pytest
from inspection_session import SIZE_PX, frame_picture, write_one

from hsi_sc_nerf.cli.sessions import InspectCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.inspection.watch import Watch

IMAGE = frame_picture(np.full((SIZE_PX, SIZE_PX), 90.0))


def test_a_line_for_each_new_capture_that_is_complete(tmp_path):
    watch = Watch(tmp_path)
    assert watch.new_lines() == []
    write_one(tmp_path, "white_reference", np.full(IMAGE.shape, 0.98))
    (line,) = watch.new_lines()
    assert line.startswith("white_reference:")
    assert line.endswith("ok")
    for number in range(3):
        write_one(tmp_path, f"fruit_{number}", IMAGE)
    assert [line.split(":")[0] for line in watch.new_lines()] == ["fruit_0", "fruit_1", "fruit_2"]
    assert watch.new_lines() == []


def test_a_white_that_only_its_name_tells_of(tmp_path):
    """As `process` finds it."""
    watch = Watch(tmp_path)
    write_one(tmp_path, "White_tile", np.full((SIZE_PX // 2, *IMAGE.shape[1:]), 0.98))
    write_one(tmp_path, "fruit_0", IMAGE)
    of_fruit, of_white = sorted(watch.new_lines(), key=str.lower)
    assert "sharpness" in of_fruit
    assert "sharpness" not in of_white
    assert watch.flagged == []


def test_the_first_frame_waits_for_its_dark_cube_if_the_white_had_one(tmp_path):
    watch = Watch(tmp_path)
    write_one(tmp_path, "white_reference", np.full(IMAGE.shape, 0.98))
    write_one(tmp_path, "fruit_0", IMAGE)
    dark = tmp_path / "fruit_0" / "capture" / "DARKREF_fruit_0.hdr"
    text = dark.read_text()
    dark.unlink()
    watch.new_lines()
    assert watch.incomplete == {"fruit_0": "its dark cube is missing"}
    dark.write_text(text)
    assert [line.split(":")[0] for line in watch.new_lines()] == ["fruit_0"]


def test_a_capture_that_stays_incomplete_is_named_when_a_later_one_is_complete(tmp_path):
    watch = Watch(tmp_path)
    for number in range(3):
        write_one(tmp_path, f"fruit_{number}", IMAGE)
    short = tmp_path / "fruit_1" / "capture" / "fruit_1.raw"
    whole = short.read_bytes()
    short.write_bytes(whole[:1000])
    (tmp_path / "fruit_2" / "capture" / "DARKREF_fruit_2.hdr").unlink()
    assert [line.split(":")[0] for line in watch.new_lines()] == ["fruit_0"]  # the others may still be written
    assert list(watch.incomplete) == ["fruit_1", "fruit_2"]
    assert watch.new_lines() == []
    write_one(tmp_path, "fruit_3", IMAGE)
    complete, broken, without_dark = watch.new_lines()
    assert complete.startswith("fruit_3:")
    assert broken.startswith("fruit_1: NOT COMPLETE, ")
    assert without_dark == "fruit_2: NOT COMPLETE, its dark cube is missing"
    write_one(tmp_path, "fruit_4", IMAGE)
    assert len(watch.new_lines()) == 1
    short.write_bytes(whole)
    assert [line.split(":")[0] for line in watch.new_lines()] == ["fruit_1"]
    assert list(watch.incomplete) == ["fruit_2"]


@pytest.mark.parametrize(
    ("content", "told_of"),
    [
        ("{", "session.json"),
        ('{"marker_sidem": 1}', "session.json"),
        ('{"marker_dictionary": "DICT_9X9_50"}', "session.json"),
        ('{"band_centres": "bands.csv"}', "bands.csv"),
    ],
)
def test_a_session_json_that_cannot_be_used_is_told_once_and_the_watch_goes_on(tmp_path, content, told_of):
    """It may be written while captures are taken, as may a table that it names."""
    watch = Watch(tmp_path)
    (tmp_path / "session.json").write_text(content)
    (tmp_path / "bands.csv").write_text("wavelength_nm\n")
    write_one(tmp_path, "fruit_0", IMAGE)
    (told,) = watch.new_lines()
    assert told.startswith(f"{tmp_path / told_of}: ")
    assert told.endswith(".")
    assert watch.new_lines() == []
    (tmp_path / "session.json").write_text("{}")
    (line,) = watch.new_lines()
    assert line.startswith("fruit_0:")


@pytest.mark.slow
def test_what_is_wrong_is_flagged_at_once(tmp_path):
    watch = Watch(tmp_path)
    for number in range(3):
        write_one(tmp_path, f"fruit_{number}", IMAGE)
    watch.new_lines()
    write_one(tmp_path, "fruit_3", 9.0 * IMAGE)
    write_one(tmp_path, "fruit_4", IMAGE, **{"acquisition date": "15-02-2021"})
    write_one(tmp_path, "fruit_5", IMAGE[:-8])
    bright, late, small = watch.new_lines()
    assert "OVEREXPOSED" in bright
    assert "15-02-2021" in late
    assert "SIZE" in small
    assert watch.flagged == ["fruit_3", "fruit_4", "fruit_5"]
    assert len(watch.captures) == 6


def test_ctrl_c_ends_in_one_line(tmp_path, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    write_one(tmp_path, "fruit_0", IMAGE)
    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 1.0)
    try:
        InspectCommand(tmp_path, watch=True).main()
    finally:
        signal.signal(signal.SIGALRM, before)
    assert capsys.readouterr().out.splitlines()[-1].endswith(".")
    with pytest.raises(InputError, match="no such folder"):
        InspectCommand(tmp_path / "absent", watch=True).main()
