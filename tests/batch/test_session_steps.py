"""What a folder says of its steps is believed only where it can be."""

import os
from pathlib import Path

import pytest

from hsi_sc_nerf.batch.session_steps import STEPS_NAME, SessionSettings, Step, is_up_to_date, session_steps
from hsi_sc_nerf.files import write_json


@pytest.fixture
def step(tmp_path):
    (tmp_path / "traits.json").write_text("{}")
    return Step("traits", ("hsi-sc-nerf", "traits"), (), (tmp_path / "traits.json",))


def done(step, out, **changes):
    return {"fingerprint": step.fingerprint(out), "finished": True, "seconds": 1.5, "peak_memory_mib": 8} | changes


def test_a_finished_step_is_up_to_date_as_long_as_its_results_are_there(step, tmp_path):
    write_json(tmp_path / STEPS_NAME, {"traits": done(step, tmp_path)})
    assert is_up_to_date(step, tmp_path)
    step.outputs[0].unlink()
    assert not is_up_to_date(step, tmp_path)


@pytest.mark.parametrize("entry", [None, [], "done", 3, {}, {"finished": True}])
def test_an_entry_that_is_something_else_is_not_believed(step, tmp_path, entry):
    write_json(tmp_path / STEPS_NAME, {"traits": entry})
    assert not is_up_to_date(step, tmp_path)


@pytest.mark.parametrize(
    "changes", [{"finished": "yes"}, {"seconds": "1"}, {"seconds": float("nan")}, {"peak_memory_mib": [1]}]
)
def test_an_entry_with_damaged_figures_is_not_believed(step, tmp_path, changes):
    write_json(tmp_path / STEPS_NAME, {"traits": done(step, tmp_path, **changes)})
    assert not is_up_to_date(step, tmp_path)


@pytest.fixture
def captures(tmp_path, monkeypatch):
    """A session and results beside it, in the working folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("pear/a.raw", "out/data/transforms.json", "out/data/masks/a.png", "out/point_cloud.ply"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    return tmp_path


def fingerprints(session, out, folder=Path(), **settings):
    """Those of all steps by name."""
    out = Path(out)
    return {
        one.name: one.fingerprint(out)
        for one in session_steps(Path(session), out, SessionSettings(**settings), folder)
    }


@pytest.mark.parametrize("words", ["{}/own", "--option {}/own", "--option={}/own"])
@pytest.mark.parametrize("step", ["process", "train", "material", "traits"])
@pytest.mark.parametrize("lies_in", ["files", "out"])
def test_a_file_that_the_words_name_is_an_input(captures, step, words, lies_in):
    own = captures / lies_in / "own"
    own.parent.mkdir(exist_ok=True)
    own.write_text("1")
    settings = {step: words.format(lies_in)}
    before = fingerprints("pear", "out", **settings)
    assert fingerprints("pear", "out", **settings) == before
    own.write_text("22")
    after = fingerprints("pear", "out", **settings)
    assert [name for name in before if before[name] != after[name]] == [step]


def test_an_earlier_dataset_that_the_words_name_is_an_input(captures):
    (captures / "earlier").mkdir()
    (captures / "earlier" / "transforms.json").write_text("1")
    before = fingerprints("pear", "out", process="--camera earlier")
    (captures / "earlier" / "transforms.json").write_text("22")
    assert fingerprints("pear", "out", process="--camera earlier")["process"] != before["process"]


@pytest.mark.parametrize(
    ("named", "text", "beside"),
    [
        ("water.csv", "# Model: nets/water.onnx;;\nwavelength_nm\n500\n", "water.onnx"),
        ("skin.sli", "\0", "skin.hdr"),
        ("skin.hdr", "ENVI", "skin.sli"),
    ],
)
def test_a_file_that_is_read_with_one_that_the_words_name_is_an_input(captures, named, text, beside):
    (captures / named).write_text(text)
    (captures / beside).write_text("1")
    before = fingerprints("pear", "out", traits=f"--option {named}")
    (captures / beside).write_text("22")
    after = fingerprints("pear", "out", traits=f"--option {named}")
    assert [name for name in before if before[name] != after[name]] == ["traits"]


def test_relative_words_start_from_the_callers_folder(captures, monkeypatch):
    (captures / "own").write_text("1")
    here = fingerprints(captures / "pear", captures / "out", traits="own")
    monkeypatch.chdir(captures / "out")
    assert fingerprints(captures / "pear", captures / "out", captures, traits="own") == here


def test_paths_that_are_written_differently_are_the_same(captures, monkeypatch):
    before = fingerprints("pear", "out")
    assert fingerprints(captures / "pear", captures / "out") == before
    monkeypatch.chdir(captures / "pear")
    assert fingerprints(".", "../out") == before
    monkeypatch.chdir(captures / "out")
    assert fingerprints("../pear", ".") == before


def test_moved_folders_are_the_same_and_other_captures_are_not(captures):
    before = fingerprints("pear", "out")
    (captures / "disk").mkdir()
    os.rename("pear", "disk/pear_01")
    os.rename("out", "disk/results")
    assert fingerprints("disk/pear_01", "disk/results") == before
    (captures / "disk/pear_01/a.raw").write_text("another object")
    after = fingerprints("disk/pear_01", "disk/results")
    assert [name for name in before if before[name] != after[name]] == ["process"]


def test_captures_behind_a_link_are_inputs_and_circles_end(captures):
    (captures / "disk/two/capture").mkdir(parents=True)
    (captures / "pear/two").symlink_to(captures / "disk/two")
    (captures / "disk/two/round").symlink_to(captures / "pear")
    before = fingerprints("pear", "out")
    (captures / "disk/two/capture/two.raw").write_text("new")
    assert fingerprints("pear", "out")["process"] != before["process"]
