"""Ctrl-C ends a command in one line, whatever is being done and whatever a library makes of it."""

import signal
import sys
import time

import pressed_at_import
import pytest

from hsi_sc_nerf import interruption

PLUGIN = "import hsi_sc_nerf.data.dataparser"


@pytest.fixture(autouse=True)
def python_handles_it():
    """Tests may run in the background of a shell, which has Ctrl-C ignored."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def press():
    signal.raise_signal(signal.SIGINT)


def wait():
    until = time.monotonic() + 30
    while time.monotonic() < until:
        time.sleep(0.01)


def test_a_command_of_nerfstudio_ends_in_one_line_from_the_moment_that_it_loads_the_plugin():
    ended = pressed_at_import.run("numpy", PLUGIN, ["/bin/ns-train", "hsi-sc-nerf", "--data", "x"])
    assert (ended.returncode, ended.stderr) == (130, "hsi-sc-nerf: stopped.\n")


@pytest.mark.parametrize(
    ("words", "ours"),
    [
        (("/bin/ns-train", "hsi-sc-nerf", "--data", "x"), True),
        (("ns-train.exe", "hsi-sc-nerf-paper"), True),
        (("ns-export", "pointcloud"), True),
        (("ns-train", "nerfacto"), False),
        (("ns-train",), False),
        (("-c", "hsi-sc-nerf"), True),
        (("-c", "nerfacto"), False),
        (("notebook", "hsi-sc-nerf"), False),
    ],
)
def test_other_programs_and_methods_keep_their_handler(monkeypatch, words, ours):
    monkeypatch.setattr(sys, "modules", {"nerfstudio.scripts.train": None})
    monkeypatch.setattr(sys, "argv", list(words))
    interruption.end_nerfstudio_command_at_once()
    assert (signal.getsignal(signal.SIGINT) is not signal.default_int_handler) == ours


def test_work_is_unwound_and_the_line_is_the_last(capsys):
    unwound = []

    def work():
        try:
            press()
            wait()
        finally:
            unwound.append(True)

    with pytest.raises(SystemExit) as ended, interruption.one_line(lambda: f"stopped {unwound}"):
        work()
    assert ended.value.code == 130
    assert capsys.readouterr().err == "stopped [True]\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_where_it_cannot_be_raised_it_comes_again_and_nothing_is_printed_there(capsys):
    class Destroyed:
        def __del__(self):
            press()

    def work():
        Destroyed()
        wait()

    with pytest.raises(SystemExit), interruption.one_line(lambda: "stopped"):
        work()
    assert capsys.readouterr().err == "stopped\n"


def test_a_library_is_loaded_to_its_end_before_it_is_raised(tmp_path, monkeypatch, capsys):
    (tmp_path / "slow_library.py").write_text("import signal\nsignal.raise_signal(signal.SIGINT)\nLOADED = True\n")
    monkeypatch.syspath_prepend(tmp_path)

    def work():
        import slow_library

        assert slow_library.LOADED
        wait()

    with pytest.raises(SystemExit), interruption.one_line(lambda: "stopped"):
        work()
    assert capsys.readouterr().err == "stopped\n"


def test_of_blocks_in_blocks_the_outer_one_speaks(capsys):
    with pytest.raises(SystemExit), interruption.one_line(lambda: "outer"), interruption.one_line(lambda: "inner"):
        press()
    assert capsys.readouterr().err == "outer\n"


def test_a_command_ignores_it_once_it_is_stopping_or_done(capsys):
    for ends in (press, lambda: None):
        interruption.end_at_once("at once")
        try:
            with interruption.one_line(lambda: "stopped"):
                ends()
        except SystemExit:
            pass
        interruption.ignore_when_done()
        press()
        signal.signal(signal.SIGINT, signal.default_int_handler)
    assert capsys.readouterr().err == "stopped\n"


def test_outside_of_commands_and_where_it_is_ignored_nothing_changes():
    interruption.ignore_when_done()
    interruption.leave_alone()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as nohup has it
    interruption.end_at_once("at once")
    with interruption.one_line():
        press()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_commands_on_runs_of_other_methods_get_pythons_own_handler_back():
    interruption.end_at_once("at once")
    interruption.leave_alone()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
