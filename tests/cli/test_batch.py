"""`hsi-sc-nerf batch`: the plan, restarts, kills and the lock, through Snakemake, with commands that take no time.

The real commands are those of `run` (test_workflows.py); benchmarks/batch_slurm.py runs both together.
"""

import ast
import json
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from quick_steps import quick_snakefile

from hsi_sc_nerf.batch.plan import STEPS, read_plan
from hsi_sc_nerf.cli import batch
from hsi_sc_nerf.cli.batch import SNAKEFILE, BatchCommand
from hsi_sc_nerf.cli.workflows import RunCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "batch.md"
START = "from hsi_sc_nerf.cli import batch, main; batch.SNAKEFILE = batch.Path({!r}); main.main()"
"""A process with the quick commands."""


def make_sessions(folder, names):
    for name in names:
        (folder / name / "one" / "capture").mkdir(parents=True)
    return folder


def words(folder, *more):
    """Everything but the table and the page, whose command has tests of its own."""
    return ["batch", str(folder / "sessions"), "--output-dir", str(folder / "out"), "objects", "--cores", "1", *more]


def start(folder, *more):
    code = START.format(str(quick_snakefile(folder)))
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", code, *words(folder, *more)],
        env=os.environ | {"PYTHONPATH": path},
        stderr=subprocess.PIPE,
        text=True,
    )


def ran(folder):
    """What was run since the last call."""
    path = folder / "out" / "ran.txt"
    lines = path.read_text().splitlines() if path.is_file() else []
    path.unlink(missing_ok=True)
    return lines


def files(folder):
    """Contents of the files but Snakemake's own."""
    return {one: one.read_bytes() for one in folder.rglob("*") if one.is_file() and ".snakemake" not in one.parts}


def statuses(folder):
    """Of each object the status of each step."""
    folders = sorted((folder / "out" / "objects").iterdir())
    return {
        one.name: [json.loads((one / "steps" / f"{s}.json").read_text())["status"] for s in STEPS] for one in folders
    }


def test_the_workflow_is_shipped(capsys):
    assert SNAKEFILE.is_file()
    BatchCommand(snakefile=True).main()
    assert capsys.readouterr().out == f"{SNAKEFILE}\n"


@pytest.mark.parametrize("missing", ["sessions", "output_dir"])
def test_what_is_missing_is_one_sentence(tmp_path, missing):
    given = {"sessions": tmp_path, "output_dir": tmp_path / "out"} | {missing: None}
    with pytest.raises(InputError, match="--output-dir are missing"):
        BatchCommand(**given).main()


def test_without_snakemake_one_sentence_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"hsi-sc-nerf\[batch\]"):
        BatchCommand(sessions=tmp_path, output_dir=tmp_path / "out").main()


def test_each_step_states_what_the_page_says_that_it_needs():
    """Threads, memory and GPU of the rules, as a table of docs/how-to/batch.md."""
    (needs,) = re.findall(r"^NEEDS = (\{.*?^\})", SNAKEFILE.read_text(), re.DOTALL | re.MULTILINE)
    told = {}
    for row in re.findall(r"^\| ([a-z, ]+) \| (\d) \| (\d+) \| (1?) ?\|$", PAGE.read_text(), re.MULTILINE):
        told |= dict.fromkeys(row[0].split(", "), (int(row[1]), int(row[2]), bool(row[3])))
    assert ast.literal_eval(needs) == told
    assert list(told) == list(STEPS)


def test_words_of_snakemake_reach_it_unchanged_after_ours(tmp_path, monkeypatch, command):
    found = []
    monkeypatch.setattr(batch, "_snakemake", lambda given: found.append(given) or 0)
    make_sessions(tmp_path / "sessions", ["a"])
    for more in (["--retries", "2"], ["--executor", "slurm", "--jobs", "50"], ["--profile=kubernetes"]):
        assert command(*words(tmp_path, *more), "--gpu") == 0
        assert found[-1][-3 - len(more) :] == ["objects", "--cores", "1", *more]
        assert "gpu=True" in found[-1]
    # How much may run at once is this machine's affair only where the jobs run there.
    assert ["all" in one for one in found] == [True, False, False]


@pytest.mark.parametrize(
    ("own", "kept"),
    [([], {"gpu": 1}), (["--resources", "mem_mb=5", "x=2"], {"mem_mb": 5}), (["--res=gpu=3"], {"gpu": 3})],
)
def test_resources_of_the_user_leave_the_others_as_they_are(tmp_path, monkeypatch, command, own, kept):
    """Else two steps would be on one GPU."""
    parser = pytest.importorskip("snakemake.cli").get_argument_parser()
    found = []
    monkeypatch.setattr(batch, "_snakemake", lambda given: found.append(parser.parse_args(given).resources) or 0)
    make_sessions(tmp_path / "sessions", ["a"])
    assert command(*words(tmp_path, *own)) == 0
    given = {name: getattr(one, "value", one) for name, one in found[0].items()}
    assert given.keys() == {"gpu", "mem_mb", *(["x"] if "x=2" in own else [])}
    assert given == given | {"gpu": 1} | kept


def test_where_steps_cannot_be_measured_the_system_is_named(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "wait4")
    with pytest.raises(InputError, match="Linux and macOS"):
        BatchCommand(sessions=tmp_path, output_dir=tmp_path / "out").main()


def test_two_started_at_once_do_not_harm_each_other(tmp_path, monkeypatch, command):
    """The second comes before Snakemake of the first has its lock: it is refused, and the list stays the first's."""
    out = tmp_path / "out"
    for name in ("first", "second"):
        make_sessions(tmp_path / name / "sessions", [name])
    refused = []

    def snakemake(given):
        before = files(out)
        for more in ([], ["--preset", "best"], ["--dry-run"]):
            assert command(*words(tmp_path / "second", *more), "--output-dir", out) == 2
            refused.append(files(out) == before)
        return 0

    monkeypatch.setattr(batch, "_snakemake", snakemake)
    assert command(*words(tmp_path / "first"), "--output-dir", out) == 0
    assert refused == [True, True, True]
    assert "first" in (out / "sessions.csv").read_text()
    assert not list(out.rglob("*.lock"))


def test_at_the_end_stands_what_failed_and_an_optional_step_where_nothing_else_did(
    tmp_path, monkeypatch, command, capsys
):
    make_sessions(tmp_path / "sessions", ["apple", "pear"])
    failed = {"apple": ["material"], "pear": ["inspect", "process"]}

    def snakemake(given):
        for name, one in read_plan(tmp_path / "out").items():
            for step in STEPS:
                status = "failed" if step in failed[name] else "done"
                write_json(one.record(step), {"status": status, "sentence": f"the {step} of the {name} failed."})
        return 0

    monkeypatch.setattr(batch, "_snakemake", snakemake)
    assert command(*words(tmp_path)) == 0
    told = capsys.readouterr().out
    assert [line.split(":")[0] for line in told.splitlines()[:-1]] == ["apple, material", "pear, process"]
    assert "the material of the apple failed." in told


def test_a_full_disk_leaves_no_lock(tmp_path, limit_of_files):
    sessions = make_sessions(tmp_path / "sessions", ["a"])
    with limit_of_files(1), pytest.raises(InputError, match=r"plan\.lock: cannot be written"):
        BatchCommand(sessions=sessions, output_dir=tmp_path / "out").main()
    assert not (tmp_path / "out").exists()


def test_what_is_refused_leaves_no_lock_and_no_folder(tmp_path, monkeypatch):
    sessions = make_sessions(tmp_path / "sessions", ["a"])
    inside = sessions / "a" / "out"
    with pytest.raises(InputError, match="lies in the session"):
        BatchCommand(sessions=sessions, output_dir=inside).main()
    assert not inside.exists()
    monkeypatch.setattr(batch, "_snakemake", lambda given: 1)
    for _ in range(2):  # the second time it is no longer said that another batch works there
        with pytest.raises(InputError, match="Snakemake ended early"):
            BatchCommand(sessions=sessions, output_dir=tmp_path / "out").main()


@pytest.mark.slow
def test_words_that_name_a_result_of_one_of_the_objects_are_refused_before_the_first_step(tmp_path):
    """The step that writes it would fail after hours of training."""
    sessions, out = make_sessions(tmp_path / "sessions", ["a", "b"]), tmp_path / "out"
    own = out / "objects" / "b"
    path = own / "traits" / "spectra.csv"
    path.parent.mkdir(parents=True)
    path.write_text("wavelength_nm,skin\n500,0.1\n600,0.2\n")
    before = files(tmp_path)
    for made in (BatchCommand(sessions=sessions, output_dir=out), RunCommand(sessions / "b", own)):
        with pytest.raises(InputError, match=r"spectra\.csv: .*copy it to another folder"):
            replace(made, traits=f"--library {path}").main()
    assert files(tmp_path) == before


@pytest.mark.slow
@pytest.mark.parametrize("row", ["a,s/a,--masks.pieces 0,", "a,s/a,,--timestamp mine"])
def test_words_of_one_object_are_checked_before_the_first_step(tmp_path, row):
    make_sessions(tmp_path / "s", ["a", "b"])
    listed = tmp_path / "list.csv"
    listed.write_text(f"object,session,process,train\nb,s/b,,\n{row}\n")
    with pytest.raises(InputError, match=r"^the object a: --(process: --masks|train: --timestamp)"):
        BatchCommand(sessions=listed, output_dir=tmp_path / "out").main()
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_six_sessions_of_which_two_fail(tmp_path, monkeypatch, command, capfd):
    """First the plan; then all; then nothing; then what was mended; then what was asked for."""
    pytest.importorskip("snakemake")
    names = ["apple", "broken", "maize", "pear", "pepper", "unmarked"]
    make_sessions(tmp_path / "sessions", names)
    for name in ("broken", "unmarked"):
        (tmp_path / "sessions" / name / "broken").write_text("")
    monkeypatch.setattr(batch, "SNAKEFILE", quick_snakefile(tmp_path))

    def do(*more):
        assert command(*words(tmp_path, *more)) == 0
        return capfd.readouterr()

    told = do("--dry-run")
    assert "train: pepper" in told.err + told.out
    assert "total          49" in told.err + told.out
    assert not (tmp_path / "out").exists()

    # Each step of each takes a second; one that is whole is enough.
    kept = tmp_path / "kept"
    kept.mkdir()
    for name in names[2:5]:
        (tmp_path / "sessions" / name).rename(kept / name)
    told = do()
    assert "broken, process: the white reference is missing; capture it." in told.out
    assert "1 of 3 objects are done." in told.out
    assert statuses(tmp_path) == {
        "apple": ["done"] * 8,
        "broken": ["done", "failed", *["skipped"] * 6],
        "unmarked": ["done", "failed", *["skipped"] * 6],
    }
    assert len(ran(tmp_path)) == 12

    do()
    assert ran(tmp_path) == []
    (tmp_path / "sessions" / "broken" / "broken").unlink()
    before = files(tmp_path / "out")
    told = do("--dry-run", "--preset", "best")
    assert "train: apple" in told.err + told.out
    assert "process: apple" not in told.err + told.out
    assert files(tmp_path / "out") == before
    do("--retry")
    assert sorted(ran(tmp_path)) == sorted([f"broken {step}" for step in STEPS] + ["unmarked process"])


@pytest.mark.slow
def test_killed_and_started_again_it_loses_the_running_step_only(tmp_path, monkeypatch):
    """Another one does not disturb it, nor take its place before somebody says that none runs."""
    pytest.importorskip("snakemake")
    make_sessions(tmp_path / "sessions", ["pear"])
    out = tmp_path / "out"
    out.mkdir()
    (out / "wait").write_text("")
    first = start(tmp_path)
    checkpoint = out / "objects/pear/training/hsi-sc-nerf/run/nerfstudio_models/step-10.ckpt"
    while not checkpoint.exists():
        assert first.poll() is None, first.stderr.read()
        time.sleep(0.05)
    before = (out / "sessions.csv").stat().st_mtime_ns
    second = start(tmp_path)
    told = second.communicate()[1]
    assert second.returncode == 2
    assert told.startswith(f"Error: {out}: another batch works there")
    assert told.count("\n") == 1
    assert (out / "sessions.csv").stat().st_mtime_ns == before

    first.kill()
    first.communicate()
    (out / "wait").unlink()
    time.sleep(1.0)  # an orphan of the workflow would come to its end
    assert not (out / "objects/pear/steps/train.json").exists()
    assert ran(tmp_path) == ["pear inspect", "pear process", "pear train"]
    unlocking = start(tmp_path, "--unlock")
    told = unlocking.communicate()[1]
    assert unlocking.returncode == 0, told
    third = start(tmp_path)
    told = third.communicate()[1]
    assert third.returncode == 0, told
    assert ran(tmp_path) == [f"pear {step}" for step in STEPS[2:]]
    assert statuses(tmp_path) == {"pear": ["done"] * 8}


@pytest.mark.slow
def test_columns_of_the_user_that_changed_stand_in_the_table(tmp_path, monkeypatch, command):
    pytest.importorskip("snakemake")
    make_sessions(tmp_path / "sessions", ["pear"])
    monkeypatch.setattr(batch, "SNAKEFILE", quick_snakefile(tmp_path))
    listed = tmp_path / "list.csv"
    for genotype in ("A12", "B77"):
        listed.write_text(f"object,session,genotype\npear,sessions/pear,{genotype}\n")
        assert command("batch", listed, "--output-dir", tmp_path / "out", "--cores", "1") == 0
        assert f",{genotype}," in (tmp_path / "out" / "traits.csv").read_text()
