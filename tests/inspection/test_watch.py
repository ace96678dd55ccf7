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


def test_a_capture_that_is_being_written_is_waited_for(tmp_path):
    watch = Watch(tmp_path)
    write_one(tmp_path, "fruit_0", IMAGE)
    data = tmp_path / "fruit_0" / "capture" / "fruit_0.raw"
    whole = data.read_bytes()
    data.write_bytes(whole[:1000])
    assert watch.new_lines() == []
    data.write_bytes(whole)
    assert len(watch.new_lines()) == 1


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
    assert watch.captures == 6


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
