"""``process`` makes the checks before anything else, and ``inspect`` exits by them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from inspection_session import SIZE_PX, frame_picture, write_one

from hsi_sc_nerf.cli.sessions import InspectCommand, ProcessCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.processing.process import ProcessConfig, process_session


def reached(images, names, *, places, **_):
    raise InputError(f"reached the poses of {len(names)} frames at {places}")


def process(session: Path, output: Path, **settings) -> None:
    process_session(session, output, ProcessConfig(**settings), progress=False, estimate_poses=reached)


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_red_is_refused_before_anything_is_written_unless_it_is_accepted_or_left_out(session, tmp_path):
    image = frame_picture(np.full((SIZE_PX, SIZE_PX), 90.0))
    write_one(session, "fruit_05", image, **{"acquisition date": "15-02-2021"})
    with pytest.raises(InputError, match=r"fruit_05.*--accept dates"):
        process(session, tmp_path / "data")
    assert not (tmp_path / "data").exists()
    with pytest.raises(InputError, match="reached the poses of 12"):
        process(session, tmp_path / "data", accept=("dates", "other-object"))
    with pytest.raises(InputError, match="reached the poses of 11"):
        process(session, tmp_path / "data", exclude=("fruit_05",))


def test_a_file_and_the_session_itself_are_no_folder_for_the_dataset(session, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="file: cannot be written"):
        process(session, tmp_path / "file")
    names = sorted(path.name for path in session.iterdir())
    with pytest.raises(InputError, match="session itself"):
        ProcessCommand(session, session / "." / "fruit_00" / "..").main()
    assert sorted(path.name for path in session.iterdir()) == names


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_all_damaged_captures_are_named_or_left_out(session, tmp_path):
    (session / "fruit_02" / "capture" / "fruit_02.raw").write_bytes(b"")
    shutil.rmtree(session / "fruit_08" / "capture")
    with pytest.raises(InputError, match=r"fruit_08.*fruit_02.*0 bytes"):
        process(session, tmp_path / "data")
    with pytest.raises(InputError, match=r"reached the poses of 10 frames at \(0, 1, 3, 4, 5, 6, 7, 9, 10, 11\)"):
        process(session, tmp_path / "data", skip_damaged=True)


@pytest.mark.slow
def test_inspect_prints_all_findings_and_a_session_json(session, tmp_path, capsys):
    InspectCommand(session, output_dir=tmp_path / "out").main()
    assert (tmp_path / "out" / "inspection.png").is_file()
    findings = json.loads((tmp_path / "out" / "inspection.json").read_text())["findings"]
    printed = capsys.readouterr().out
    assert all(finding["name"] in printed for finding in findings)
    assert "marker_dictionary" not in printed
    (session / "session.json").unlink()
    session = session.rename(tmp_path / ("fruit of a long name " * 5))  # no line of the JSON is broken
    with pytest.raises(InputError, match="nothing gives a scale"):
        InspectCommand(session).main()
    printed = capsys.readouterr().out
    assert json.loads(printed[printed.rindex("{") :])["marker_dictionary"] == "DICT_5X5_50"
