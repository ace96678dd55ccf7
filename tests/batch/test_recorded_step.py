"""Whatever happens to a session, its records say it; and what is to be made again."""

import json
import sys
from functools import partial
from pathlib import Path

import pytest
from quick_steps import quick_run

from hsi_sc_nerf.batch.plan import INSPECTION_NAME, STEPS, outdated, read_plan, write_plan
from hsi_sc_nerf.batch.recorded_step import copy_record, record_step, runner_of
from hsi_sc_nerf.batch.session_steps import STEPS_NAME, SessionSettings
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json


@pytest.fixture
def planned(tmp_path, monkeypatch):
    """One object of a batch; gives what reads it anew."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "session").mkdir()
    rows = [{"object": "pear", "session": str(tmp_path / "session"), "train": "--own 1"}]

    def plan(**settings):
        write_plan(tmp_path, rows, SessionSettings(**settings))
        return read_plan(tmp_path)

    plan()
    return plan


def do(one, steps=STEPS, run=None):
    for name in steps:
        record_step(one, name, run or partial(quick_run, one))


def records(one):
    return {name: json.loads(one.record(name).read_text()) for name in STEPS}


def forced(plan, retry=False):
    return [path.stem for path in outdated(plan, retry)]


def test_words_of_a_row_come_after_those_of_the_batch(planned):
    plan = planned(train="--all 2", preset="fast")
    assert plan["pear"].step("train").words[-5:] == ("fast", "--all", "2", "--own", "1")


@pytest.mark.parametrize("there", [True, False])
def test_a_step_runs_where_the_batch_was_called(planned, tmp_path, monkeypatch, there):
    """Relative paths in the user's words were checked there; on a pod, that folder can be missing."""
    (tmp_path / "caller").mkdir()
    monkeypatch.chdir(tmp_path / "caller")
    planned()
    monkeypatch.chdir(tmp_path)
    if not there:
        (tmp_path / "caller").rmdir()
    one = read_plan(tmp_path)["pear"]
    code = "import pathlib; print(pathlib.Path.cwd())"
    runner_of(one)("process", [sys.executable, "-c", code], tmp_path / "log.txt")
    assert (tmp_path / "log.txt").read_text().strip() == str(one.caller if there else tmp_path)
    assert one.caller == tmp_path / "caller"


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python always looks into the working folder")
@pytest.mark.parametrize("words", [("-c", "import colorsys"), ("-m", "colorsys")])
def test_a_file_in_the_callers_folder_is_no_module_of_a_step(planned, tmp_path, words):
    (tmp_path / "colorsys.py").write_text("raise SystemExit(3)")
    runner_of(planned()["pear"])("process", [sys.executable, *words], tmp_path / "log.txt")


def test_a_file_that_words_name_is_looked_for_where_the_batch_was_called(planned, tmp_path, monkeypatch):
    (tmp_path / "skin.csv").write_text("1")
    do(planned(traits="--library skin.csv")["pear"])
    (tmp_path / "skin.csv").write_text("22")
    monkeypatch.chdir(tmp_path / "objects")
    assert [path.stem for path in outdated(read_plan(tmp_path), False)] == ["traits"]


@pytest.mark.parametrize(("key", "value", "told"), [("preset", "slow", "'slow' is none"), ("train", "'", "split")])
def test_words_that_cannot_be_used_are_told_before_the_start(tmp_path, key, value, told):
    with pytest.raises(InputError, match=told):
        write_plan(tmp_path, [{"object": "a", "session": "s", key: value}], SessionSettings())
    assert not any(tmp_path.iterdir())


def test_all_steps_are_recorded_and_nothing_is_done_twice(planned, tmp_path):
    one = planned()["pear"]
    do(one)
    found = records(one)
    assert {record["status"] for record in found.values()} == {"done"}
    assert found["train"] == {
        "step": "train",
        "status": "done",
        "seconds": 1.0,
        "peak_memory_mib": 100.0,
        "sentence": "",
    }
    do(one)  # as where the records were lost
    assert records(one) == found
    assert (tmp_path / "ran.txt").read_text().split()[1::2] == list(STEPS)
    assert forced(planned()) == []


def test_what_was_changed_or_removed_is_made_again(planned, tmp_path):
    do(planned()["pear"])
    assert forced(planned(num_points=5)) == ["export"]
    assert forced(planned(train="--new 3")) == ["train"]
    (tmp_path / "objects" / "pear" / "eval.json").unlink()
    assert forced(planned()) == ["evaluate"]
    (tmp_path / "session" / "new.raw").write_text("counts")
    assert forced(planned()) == ["inspect", "process", "evaluate"]
    # Results of a training that was repeated are not those of the one before.
    write_json(tmp_path / "objects/pear/training/hsi-sc-nerf/run/nerfstudio_models/step-10.ckpt", {"new": 1})
    assert forced(planned())[-4:] == ["evaluate", "export", "material", "report"]


def test_a_failure_has_its_sentence_and_ends_only_what_needs_it(planned, tmp_path):
    (tmp_path / "session" / "broken").write_text("")
    one = planned()["pear"]
    do(one)
    found = records(one)
    assert found["process"]["sentence"] == "the white reference is missing; capture it."
    assert [record["status"] for record in found.values()] == ["done", "failed", *["skipped"] * 6]
    assert found["report"]["sentence"] == "The step 'process' failed."
    assert forced(planned()) == []
    assert forced(planned(), retry=True) == ["process"]
    assert forced(planned(process="--poses angles")) == ["process"]
    (tmp_path / "session" / "broken").unlink()
    assert forced(planned()) == ["inspect", "process"]


def test_sentences_name_files_as_they_lie_in_the_session_and_in_the_objects_folder(planned, tmp_path):
    one = planned()["pear"]
    told = f"{one.session}: holds a/b.raw ({one.session}/a/b.raw); see {one.folder}/logs in {one.folder}."

    def run(name, argv, log):
        raise InputError(told)

    do(one, run=run)
    found = records(one)
    assert found["process"]["sentence"] == "session: holds a/b.raw (a/b.raw); see logs in pear."
    assert not any(str(tmp_path) in record["sentence"] for record in found.values())


@pytest.mark.parametrize("content", ["{", "{}", '{"status": 1}', '{"status": "halfway"}', "[]"])
def test_a_damaged_record_is_one_sentence(planned, content):
    one = planned()["pear"]
    do(one, ("inspect", "process"))
    one.record("process").write_text(content)
    with pytest.raises(InputError, match=r"process\.json: .*delete it and start"):
        do(one, ("train",))


def test_what_fails_before_the_command_is_not_told_by_the_log_of_an_earlier_attempt(planned):
    one = planned()["pear"]
    (one.session / "broken").write_text("")
    do(one, ["inspect", "process"])
    (one.folder / STEPS_NAME).write_text("{")
    do(one, ["process"])
    assert json.loads(one.record("process").read_text())["sentence"].startswith(f"{STEPS_NAME}: is not a JSON")


def test_without_the_material_the_other_steps_do_without(planned):
    one = planned()["pear"]

    def run(name, argv, log):
        cost = quick_run(one, name, argv, log)
        if name == "material":
            raise InputError("no light was found.")
        return cost

    do(one, run=run)
    found = records(one)
    assert {name for name, record in found.items() if record["status"] == "failed"} == {"material"}
    assert found["material"]["sentence"] == "no light was found."
    assert not (one.folder / "point_cloud-material.ply").exists()
    assert forced(planned()) == []


@pytest.mark.parametrize("opened", [True, False])
def test_what_is_red_is_left_to_process_which_may_accept_it(planned, opened):
    one = planned()["pear"]

    def run(name, argv, log):
        if opened:
            quick_run(one, name, argv, log)
        raise InputError("no markers are seen.")

    write_json(one.folder / INSPECTION_NAME, {"of": "an earlier attempt"})
    do(one, ["inspect"], run)
    record = json.loads(one.record("inspect").read_text())
    assert (record["status"], record["sentence"]) == ("done" if opened else "failed", "no markers are seen.")
    assert forced(planned()) == []
    do(one, ["process"])
    assert json.loads(one.record("process").read_text())["status"] == "done"
    (one.session / "new.raw").write_text("counts")
    assert forced(planned()) == ["inspect", "process"]


@pytest.mark.parametrize("left", ["killed", "removed"])
def test_a_red_inspection_without_its_result_is_made_again(planned, left):
    one = planned()["pear"]

    def run(name, argv, log):
        quick_run(one, name, argv, log)
        raise InputError("no markers are seen.")

    def killed(name, argv, log):
        raise KeyboardInterrupt

    do(one, ["inspect"], run)
    if left == "killed":
        with pytest.raises(KeyboardInterrupt):
            do(one, ["inspect"], killed)
    else:
        (one.folder / INSPECTION_NAME).unlink()
    assert forced(planned()) == ["inspect"]


def test_a_pod_copies_the_record_to_where_snakemake_looks_for_it(planned, tmp_path):
    """On Kubernetes: into a folder that is not there yet, or over the record of an earlier attempt."""
    one, copy = planned()["pear"], tmp_path / "pod" / "fs" / "steps" / "inspect.json"
    do(one, ["inspect"])
    for _ in range(2):
        copy_record(one, "inspect", copy)
        assert copy.read_bytes() == one.record("inspect").read_bytes()
        copy.write_text("an earlier attempt")


@pytest.mark.parametrize("same", ["relative", "absolute", "link"])
def test_a_record_that_is_in_its_place_is_left_as_it_is(planned, tmp_path, same):
    """Copied onto itself, it would be an error, or empty."""
    one = planned()["pear"]
    do(one, ["inspect"])
    before = one.record("inspect").read_bytes(), one.record("inspect").stat().st_mtime_ns
    (tmp_path / "mounted").symlink_to(tmp_path, target_is_directory=True)
    own = Path("objects/pear/steps/inspect.json")
    copy_record(
        one, "inspect", {"relative": own, "absolute": tmp_path / own, "link": tmp_path / "mounted" / own}[same]
    )
    assert (one.record("inspect").read_bytes(), one.record("inspect").stat().st_mtime_ns) == before
