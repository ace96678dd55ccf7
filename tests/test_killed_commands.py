"""A small run of benchmarks/killed_commands.py: ``process`` killed three times goes on to the same dataset."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from killed_commands import KilledCommand, Moment, goes_on_after_ctrl_c, in_pieces, main, moments, start, undisturbed
from left_files import differences, files_in, half_written, leftovers

from hsi_sc_nerf.files import atomic_write, write_json


@pytest.mark.slow
def test_process_killed_again_and_again_goes_on_to_the_same_dataset(tiny_dataset, tmp_path, monkeypatch, command):
    data, session = tiny_dataset
    killed = KilledCommand("process", ("hsi-sc-nerf", "process", str(session), "--output-dir", "out"))
    out = tmp_path / "out"
    # Calibration and frames; poses; masks, effects and the end.
    for sign in (".cache/*.note", "poses.json", "masks/*.png"):
        process = start(killed.words, tmp_path)
        while process.poll() is None and not list(out.glob(sign)):
            time.sleep(0.01)
        assert process.poll() is None, (tmp_path / "log").read_text()
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        assert half_written(out, data) == []
        assert not (out / "transforms.json").exists()
    monkeypatch.chdir(tmp_path)
    assert command(*killed.again(tmp_path)[1:]) == 0
    assert differences(data, out) == []
    assert leftovers(out, data) == []


def test_what_is_wrong_is_found(tmp_path):
    reference, found = tmp_path / "reference", tmp_path / "found"
    write_json(reference / "a.json", {"a": 1})
    with atomic_write(reference / "b.bip") as (temporary,):
        temporary.write_bytes(b"1234")
    shutil.copytree(reference, found)
    assert half_written(found, reference) == differences(reference, found) == leftovers(found, reference) == []
    (found / "a.json").write_text('{"a": 2}')  # whole, but not the same
    (found / "b.bip").write_bytes(b"12")
    (found / ".partial-1-b.bip").write_bytes(b"12")
    assert half_written(found, reference) == [Path("b.bip")]
    assert differences(reference, found) == [Path("a.json"), Path("b.bip")]
    assert leftovers(found, reference) == [Path(".partial-1-b.bip")]
    (found / "a.json").write_text('{"a"')
    assert half_written(found, reference) == [Path("a.json"), Path("b.bip")]


def test_a_folder_that_vanishes_while_files_are_listed_is_left_out(tmp_path, monkeypatch):
    for name in ("stays", ".models-writing"):
        write_json(tmp_path / name / "a.json", {})

    def scandir(path, scan=os.scandir):
        if str(path).endswith("-writing"):
            raise FileNotFoundError(path)
        return scan(path)

    monkeypatch.setattr(os, "scandir", scandir)
    assert files_in(tmp_path) == [Path("stays/a.json")]


def test_moments_are_spread_and_repeat():
    found = list(moments(10, 2.0, 12.0, random.Random(1)))
    assert [int(moment.after_s / (2.0 if moment.writing else 2.4)) for moment in found] == [*range(5), *range(5)]
    assert [moment.writing for moment in found] == [False] * 5 + [True] * 5
    assert found == list(moments(10, 2.0, 12.0, random.Random(1)))


def test_a_run_that_was_stopped_goes_on_with_the_next_moments(tmp_path):
    expected, seen = list(moments(5, 2.0, 12.0, random.Random(1))), []

    def counted(piece):
        seen.append(piece)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return Counter({"runs to the end": 1, "leftovers": len(piece)})

    with pytest.raises(KeyboardInterrupt):
        in_pieces(expected, 2, counted, tmp_path / "counts.json")
    assert in_pieces(expected, 2, counted, tmp_path / "counts.json") == {"runs to the end": 3, "leftovers": 5}
    assert seen == [expected[:2], expected[2:4], expected[2:4], expected[4:]]
    assert in_pieces(expected, 2, pytest.fail, tmp_path / "counts.json")["leftovers"] == 5


def test_an_unknown_command_is_one_sentence(tmp_path):
    with pytest.raises(SystemExit, match=r"^--only unknown: no command [^\n]*process, ns-train, ns-export[^\n]*\.$"):
        main(only="unknown", keep=tmp_path)
    assert list(tmp_path.iterdir()) == []


IGNORES = "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
READY = "open('ready', 'w')\n"


# Where the tests were started in the background, Ctrl-C is ignored in all that they start.
HEEDS = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"


def python(script, folder):
    """A process as the benchmark starts them."""
    return subprocess.Popen(
        [sys.executable, "-c", HEEDS + script], cwd=folder, start_new_session=True, stderr=subprocess.DEVNULL
    )


@pytest.mark.parametrize(
    ("script", "ends_s", "swallows"),
    [
        (IGNORES + READY + "while True: pass", 0.2, True),
        (READY + "while True: pass", 60.0, False),
        (IGNORES + READY + "import time; time.sleep(0.3)", 60.0, False),  # ends by itself, however long it takes
    ],
    ids=["goes on", "ends", "was ending"],
)
def test_what_goes_on_after_ctrl_c_is_told_by_its_processor_time(script, ends_s, swallows, tmp_path):
    process = python(script, tmp_path)
    while not (tmp_path / "ready").exists():
        assert process.poll() is None
    assert goes_on_after_ctrl_c(process, ends_s) == swallows
    assert process.returncode is not None


@pytest.mark.parametrize("writing", [True, False])
def test_a_moment_after_the_end_does_not_come(writing, tmp_path):
    assert not Moment(60.0, writing).comes(python("", tmp_path), tmp_path)
    process = python("while True: pass", tmp_path)
    assert Moment(0.01, writing=False).comes(process, tmp_path)
    process.kill()
    process.wait()


def test_an_undisturbed_run_has_its_moments_until_all_is_written(tmp_path, monkeypatch):
    work = "import time, pathlib as p\ndef work(s):\n    while time.process_time() < s: pass\n"
    work += "p.Path('out').mkdir(); work(0.3); p.Path('out/a').touch(); work(0.6); p.Path('out/b').touch(); work(1.2)"
    monkeypatch.setattr("killed_commands.typed_command", lambda words: [sys.executable, "-c", work])
    first_file_s, written_s, seconds = undisturbed(KilledCommand("a", ()), tmp_path)
    assert 0.2 < first_file_s < written_s < seconds - 0.3
    assert all(moment.after_s < written_s for moment in moments(4, first_file_s, written_s, random.Random(0)))
