import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from hsi_sc_nerf.cli.change import ChangeCommand
from hsi_sc_nerf.cli.clouds import CompareCommand, TraitsCommand
from hsi_sc_nerf.cli.light import MaterialCommand
from hsi_sc_nerf.cli.sessions import InspectCommand, ProcessCommand
from hsi_sc_nerf.cli.trained_runs import ExportCommand, RenderCommand, ReportCommand, SampleCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import (
    atomic_write,
    delete_remains,
    read_json,
    read_picture,
    require_writable,
    write_json,
    write_png,
)

NOTHING = Path("nothing")


@pytest.mark.parametrize(
    "command",
    [
        lambda: ReportCommand(NOTHING, output=Path()),
        lambda: SampleCommand(NOTHING, NOTHING, output=Path()),
        lambda: SampleCommand(Path(), NOTHING),
        lambda: MaterialCommand(Path(), NOTHING),
    ],
)
def test_a_folder_in_the_place_of_a_file_is_told_before_anything_is_computed(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"^\.: "):
        command().main()


@pytest.mark.parametrize(
    "command",
    [
        lambda out: ChangeCommand((NOTHING, NOTHING), out),
        lambda out: CompareCommand(NOTHING, NOTHING, out),
        lambda out: ExportCommand(NOTHING, out),
        lambda out: TraitsCommand(NOTHING, out),
        lambda out: MaterialCommand(NOTHING, NOTHING, output=out / "cloud.ply"),
        lambda out: SampleCommand(NOTHING, NOTHING, output=out / "cloud.ply"),
        lambda out: RenderCommand(NOTHING, out),
        lambda out: ReportCommand(NOTHING, output=out / "report.html"),
        lambda out: InspectCommand(NOTHING, out),
        lambda out: ProcessCommand(NOTHING, out),
    ],
)
def test_commands_refuse_a_place_that_cannot_be_written_to_before_they_read_anything(tmp_path, command):
    (tmp_path / "file").write_text("months of work")
    with pytest.raises(InputError, match=r"^[^\n]*cannot be written to[^\n]*\.$"):
        command(tmp_path / "file" / "out").main()
    assert (tmp_path / "file").read_text() == "months of work"


def test_a_place_that_can_be_made_is_not_made_yet(tmp_path):
    require_writable(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    with pytest.raises(InputError, match="is no folder"):
        require_writable(tmp_path / "link" / "out")


@pytest.mark.parametrize(("channels", "shape"), [(1, (5, 7)), (3, (5, 7, 3))])
def test_pictures_come_back_and_damaged_ones_are_none(tmp_path, channels, shape):
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    path = tmp_path / "a.png"
    write_png(path, image)
    np.testing.assert_array_equal(read_picture(path, channels), image)
    whole = path.read_bytes()
    # The head claims 65536 x 65536 pixels, for which there would be room in no such file.
    head = b"IHDR" + b"\0\1\0\0\0\1\0\0" + whole[24:29]
    huge = whole[:12] + head + zlib.crc32(head).to_bytes(4, "big") + whole[33:]
    long = whole[:33] + b"\x7f\xff\xff\xf0" + whole[37:]  # a part of 2 GB
    flipped = whole[:-20] + bytes([whole[-20] ^ 1]) + whole[-19:]
    for content in (b"", whole[:20], whole[:-30], huge, long, flipped, b"BM" + whole[2:], b"no picture"):
        path.write_bytes(content)
        assert read_picture(path, channels) is None
    assert read_picture(tmp_path / "missing.png", channels) is None


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, f'{{"a": {"9" * 5000}}}', '{"a": "\\ud800"}', "\0"])
def test_what_is_no_json_object_is_refused_in_a_sentence(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"a\.json: is not a JSON object.*; mend it\."):
        read_json(path, "mend it")


def test_json_of_a_windows_editor(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes('{\r\n"object": "Äpfel"\r\n}\r\n'.encode("utf-8-sig"))
    assert read_json(path, "mend it") == {"object": "Äpfel"}


def test_a_full_disk_names_the_file_and_no_temporary_one(tmp_path, limit_of_files):
    def write():
        with atomic_write(tmp_path / "a.json", tmp_path / "b.json") as (first, second):
            write_json(first, {"a": "b" * 1000})
            write_json(second, {})

    with limit_of_files(100), pytest.raises(InputError, match=rf"^{tmp_path}/a\.json: cannot be written"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_replaces_a_folder_whole_or_not_at_all(tmp_path):
    target = tmp_path / "cloud.zarr"

    def write(content, fails=False):
        with atomic_write(target) as (temporary,):
            temporary.mkdir()
            (temporary / content).touch()
            assert not fails

    write("old")
    write("new")
    with pytest.raises(AssertionError):
        write("half", fails=True)
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["cloud.zarr", "cloud.zarr/new"]


def test_what_a_killed_process_left_is_deleted_and_what_a_running_one_writes_is_kept(tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    target = tmp_path / "cloud[1].ply"
    left, folder = (tmp_path / f".partial-{ended.pid}-{name}" for name in (target.name, "b.zarr"))
    others = [tmp_path / f".partial-{os.getppid()}-{target.name}", tmp_path / f".partial-{ended.pid}-cloud.ply"]
    for path in (left, *others, folder / "c" / "0"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("half")
    with atomic_write(target) as (temporary,):
        temporary.write_text("whole")
    assert not left.exists()
    assert target.read_text() == "whole"
    assert all(path.exists() for path in others)
    delete_remains(tmp_path / "b.zarr")
    assert not folder.exists()
