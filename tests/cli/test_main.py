"""Whatever goes wrong that a user can mend is one line."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pressed_at_import
import pytest
import tyro

from hsi_sc_nerf.cli.main import COMMANDS, command_line
from hsi_sc_nerf.cli.sessions import MarkersCommand
from hsi_sc_nerf.errors import InputError

MAIN = [sys.executable, "-m", "hsi_sc_nerf.cli.main"]


def start(words):
    """A command that Ctrl-C reaches, also where the tests run in the background of a shell, which has it ignored."""
    return subprocess.Popen(
        [*MAIN, *words],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TERM": "dumb"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def test_a_file_that_the_system_refuses_is_one_line(monkeypatch, capsys, command):
    def refused(self):
        Path("/" + "a" * 300).read_bytes()

    monkeypatch.setattr(MarkersCommand, "main", refused)
    assert command("markers") == 2
    told = capsys.readouterr().err
    assert told.startswith("Error: /aaa")
    assert told.count("\n") == 1


def test_a_sentence_of_what_opens_runs_is_told_as_any_other(monkeypatch, capsys, command):
    """Data and model are nerfstudio's parts, which end its commands as well."""

    def refused(self):
        raise SystemExit("hsi-sc-nerf: cubes/a.hdr: is missing; process again.")

    monkeypatch.setattr(MarkersCommand, "main", refused)
    assert command("markers") == 2
    assert capsys.readouterr().err == "Error: cubes/a.hdr: is missing; process again.\n"


def test_an_error_that_is_no_file_is_not_hidden(monkeypatch, command):
    def broken(self):
        raise OSError("no file is named")

    monkeypatch.setattr(MarkersCommand, "main", broken)
    with pytest.raises(OSError, match="no file is named"):
        command("markers")


@pytest.mark.parametrize("other", [ImportError("a library failed to import"), InputError("a: is damaged.")])
def test_ctrl_c_that_a_library_turned_into_an_error_is_the_same_line(monkeypatch, capsys, command, other):
    def interrupted(self):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise other from None

    monkeypatch.setattr(MarkersCommand, "main", interrupted)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    assert command("markers") == 130
    assert capsys.readouterr() == ("", "Stopped.\n")


def test_ctrl_c_after_all_is_done_changes_nothing(monkeypatch, capsys, command):
    monkeypatch.setattr(MarkersCommand, "main", lambda self: None)
    assert command("markers") == 0
    signal.raise_signal(signal.SIGINT)
    assert capsys.readouterr() == ("", "")


def test_a_command_that_ignores_ctrl_c_from_its_start_goes_on_ignoring_it(monkeypatch, command):
    monkeypatch.setattr(MarkersCommand, "main", lambda self: signal.raise_signal(signal.SIGINT))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as nohup has it
    assert command("markers") == 0


@pytest.mark.slow
@pytest.mark.parametrize("library", ["tyro", "cv2", "trimesh"])
def test_ctrl_c_while_the_libraries_are_loaded_is_one_line(library):
    code = "from hsi_sc_nerf.cli.main import main\nmain()"
    ended = pressed_at_import.run(library, code, ["hsi-sc-nerf", "process", "nowhere", "--output-dir", "x"])
    assert ended.returncode == 130
    assert ended.stderr == "Stopped.\n"


@pytest.mark.slow
def test_ctrl_c_in_process_is_one_line_and_leaves_nothing_half_written(tiny_dataset, tmp_path, command):
    out = tmp_path / "data"
    words = ["process", str(tiny_dataset[1]), "--output-dir", str(out)]
    started = start(words)
    while not list(out.glob(".cache/*.note")):
        assert started.poll() is None, started.stderr.read()
        time.sleep(0.01)
    while started.poll() is None:  # a library's callback may swallow one
        started.send_signal(signal.SIGINT)
        time.sleep(0.05)
    told = started.communicate()[1]
    assert started.returncode == 130
    assert told.splitlines()[-1] == "Stopped; the same command goes on where it stopped."
    assert "Traceback" not in told
    assert not list(out.rglob(".partial-*"))
    assert not Path(out / "transforms.json").exists()
    assert command(*words) == 0
    for name in ("transforms.json", "cubes/pear_000.bip", "masks/pear_000.png"):
        assert (out / name).read_bytes() == (tiny_dataset[0] / name).read_bytes()


@pytest.mark.slow
def test_a_disk_that_fills_up_in_process_is_one_line_and_leaves_nothing_half_written(
    tiny_dataset, tmp_path, command, limit_of_files, capfd
):
    """A limit to the size of files stands for the disk: a frame's cube has 300 kB."""
    out = tmp_path / "data"
    with limit_of_files(250_000):
        assert command("process", tiny_dataset[1], "--output-dir", out) == 2
    told = capfd.readouterr().err
    (error,) = [line for line in told.splitlines() if line.startswith("Error: ")]
    assert "cannot be written" in error
    assert "Traceback" not in told
    assert not list(out.rglob("*.bip"))
    assert not list(out.rglob(".partial-*"))
    assert not (out / "transforms.json").exists()


def test_a_long_path_is_told_on_one_line(tmp_path, monkeypatch, capsys, command):
    monkeypatch.setenv("COLUMNS", "60")
    session = tmp_path / "a folder with a long name" / "of a session that was captured on Monday"
    assert command("simulate", "sphere", session, "--frames", "3", "--size", "24", "--bands", "3") == 0
    assert f"{session}: 3 frames" in capsys.readouterr().out


@pytest.mark.parametrize(("name", "told"), [("run", "little without a GPU;"), ("material", "this one. The object")])
def test_help_breaks_lines_where_the_terminal_ends_and_not_where_the_source_does(monkeypatch, capsys, name, told):
    monkeypatch.setenv("COLUMNS", "400")
    with pytest.raises(SystemExit):
        tyro.cli(command_line((name,)), args=[name, "--help"])
    assert told in capsys.readouterr().out


@pytest.mark.slow
def test_help_loads_no_numerical_library_and_a_command_only_its_own():
    """Loading all of them takes seconds."""
    code = """
import sys
from hsi_sc_nerf.cli import main
sys.argv = ["hsi-sc-nerf", *sys.argv[1:]]
try:
    main.main()
except SystemExit:
    pass
print(*sys.modules)
"""

    def loaded(*words):
        printed = subprocess.run([sys.executable, "-c", code, *words, "--help"], check=True, capture_output=True)
        *told, modules = printed.stdout.decode().splitlines()
        return "\n".join(told), set(modules.split())

    told, modules = loaded()
    assert all(f" {name} " in told for name in COMMANDS)
    assert not modules & {"numpy", "scipy", "matplotlib", "cv2", "torch", "nerfstudio"}
    told, modules = loaded("markers")
    assert "--output" in told
    assert "torch" not in modules
