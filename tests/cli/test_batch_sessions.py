"""`hsi-sc-nerf batch` on three small sessions, a whole, a broken and an unmarked one, through the real commands.

The first call's steps are forked from one process (tests/forked_steps.py), and those after it started as the shipped
workflow starts them.
"""

import csv
import json
import re
import sys
from contextlib import redirect_stdout
from io import StringIO

import pytest
from forked_steps import forked_workflow
from six_sessions import BROKEN, OBJECTS, TRAIN, TRAITS, UNMARKED, write_six_sessions

from hsi_sc_nerf.batch.plan import STEPS
from hsi_sc_nerf.cli import batch
from hsi_sc_nerf.cli.main import main
from hsi_sc_nerf.simulate.session import WHITE_REFERENCE

pytestmark = pytest.mark.slow

WHOLE = "pear_1"
NAMES = (WHOLE, BROKEN, UNMARKED)
SKIPPED = ["skipped"] * 6


def call(folder, *more):
    """One call of the command; what it prints."""
    words = ["batch", folder / "season.csv", "--output-dir", folder / "out", "--max-num-iterations", 10]
    words += ["--num-points", 1000, f"--train={TRAIN}", f"--traits={TRAITS}", "--no-gpu", *more]
    printed = StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed):
        patch.setattr(sys, "argv", ["hsi-sc-nerf", *map(str, words), "--cores", "2"])
        main()
    return printed.getvalue()


def states(folder):
    """Of each object the status of each step, and when its record was written."""
    found = {}
    for one in sorted((folder / "out" / "objects").iterdir()):
        paths = [one / "steps" / f"{step}.json" for step in STEPS]
        found[one.name] = [(json.loads(path.read_text())["status"], path.stat().st_mtime_ns) for path in paths]
    return found


def table(folder):
    with (folder / "out" / "traits.csv").open(newline="", encoding="utf-8") as file:
        return {row["object"]: row for row in csv.DictReader(file)}


@pytest.fixture(scope="module")
def season(tmp_path_factory):
    """The folder after the first call, and what that printed."""
    pytest.importorskip("snakemake")
    folder = tmp_path_factory.mktemp("season")
    write_six_sessions(folder, NAMES)
    with forked_workflow(folder) as snakefile, pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "SNAKEFILE", snakefile)
        printed = call(folder)
    return folder, printed


def test_whole_sessions_have_results_and_the_others_a_sentence(season):
    folder, printed = season
    statuses = {name: [status for status, _ in steps] for name, steps in states(folder).items()}
    assert statuses == {
        WHOLE: ["done"] * 8,
        BROKEN: ["failed", "failed", *SKIPPED],
        UNMARKED: ["done", "failed", *SKIPPED],
    }
    assert "1 of 3 objects are done." in printed
    rows = table(folder)
    assert list(rows) == list(NAMES)
    for name, row in rows.items():
        assert row["genotype"] == OBJECTS[name][1]
        whole = name == WHOLE
        assert (row["status"], row["step"]) == (("done", "") if whole else ("failed", "process"))
        for trait in ("area_cm2", "reflectance", "sam_rad", "train_s"):
            assert bool(row[trait]) == whole, (name, trait)
        assert (folder / "out" / "objects" / name / "report.html").is_file() == whole
    assert f"{WHITE_REFERENCE}.raw" in rows[BROKEN]["sentence"]
    assert "no marker was found" in rows[UNMARKED]["sentence"]
    for name in (BROKEN, UNMARKED):
        assert not re.search(r"\w\. [A-Z]", rows[name]["sentence"])
        assert f"{name}, process: {rows[name]['sentence']}" in printed
    page = (folder / "out" / "index.html").read_text(encoding="utf-8")
    assert all(f'"{name}"' in page for name in rows)


def test_a_second_call_does_nothing_and_a_deleted_result_alone_is_made_again(season):
    """By the steps of the shipped workflow."""
    folder, _ = season
    before, listed = states(folder), (folder / "out" / "traits.csv").stat().st_mtime_ns
    assert "1 of 3 objects are done." in call(folder)
    assert states(folder) == before
    assert (folder / "out" / "traits.csv").stat().st_mtime_ns == listed

    (folder / "out" / "objects" / WHOLE / "traits" / "traits.json").unlink()
    call(folder)
    after = states(folder)
    again = {
        (name, step)
        for name in before
        for step, old, new in zip(STEPS, before[name], after[name], strict=True)
        if old != new
    }
    assert again == {(WHOLE, "traits"), (WHOLE, "report")}
    assert [status for status, _ in after[WHOLE]] == ["done"] * 8
    assert (folder / "out" / "traits.csv").stat().st_mtime_ns > listed
    assert table(folder)[WHOLE]["area_cm2"]
