"""`hsi-sc-nerf batch` on six small sessions, one of them broken and one without markers, through the real commands.

The first call's steps are forked from one process (tests/forked_steps.py), and those after it started as the shipped
workflow starts them.
"""

import csv
import json
import re
import shutil
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO

import pytest
from forked_steps import forked_workflow

from hsi_sc_nerf.batch.plan import STEPS
from hsi_sc_nerf.cli import batch
from hsi_sc_nerf.cli.main import main
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import WHITE_REFERENCE, simulate_session

pytestmark = pytest.mark.slow

SKIPPED = ["skipped"] * 6
WHOLE = ["apple", "pear_1", "pear_2", "tomato"]
ROWS = [
    # A pear of 20 steps; the others have fewer.
    ("pear_1", "pear", "A", "--max-num-iterations 20"),
    ("pear_2", "pear", "B", ""),
    ("apple", "apple", "A", ""),
    ("tomato", "tomato", "B", ""),
    ("broken", "pear", "A", ""),
    ("unmarked", "apple", "B", ""),
]
TRAIN = " ".join(
    (
        "--pipeline.datamanager.train-num-rays-per-batch 64 --pipeline.model.match-resolution False",
        "--pipeline.model.num-levels 8 --pipeline.model.log2-hashmap-size 12 --pipeline.model.max-res 64",
        "--pipeline.model.proposal-warmup 100 --evaluate-stages False",
    )
)


def simulate(folder, name, kind, seed):
    """Eight frames in which the markers are just large enough."""
    scene = override(load_scene(kind), frames=8, size_px=64, bands=8, seed=seed)
    if kind == "apple":
        # Its own camera sees the markers at less favourable pixels.
        scene = replace(scene, camera=override(load_scene("pear"), size_px=64).camera)
    if name == "unmarked":
        scene = replace(scene, markers=replace(scene.markers, on_container=0, on_disc=0))
    simulate_session(scene, folder / name, progress=False)


def call(folder, *more):
    """One call of the command; what it prints."""
    words = ["batch", folder / "season.csv", "--output-dir", folder / "out", "--max-num-iterations", 10]
    words += ["--num-points", 1000, f"--train={TRAIN}", "--traits=--mesh.octree-depth 5", "--no-gpu", *more]
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
    for seed, (name, kind, *_) in enumerate(ROWS, start=1):
        if name != "broken":
            simulate(folder / "captures", name, kind, seed)
    shutil.copytree(folder / "captures" / "pear_1", folder / "captures" / "broken")
    cut = folder / "captures" / "broken" / WHITE_REFERENCE / "capture" / f"{WHITE_REFERENCE}.raw"
    cut.write_bytes(cut.read_bytes()[:-1000])
    with (folder / "season.csv").open("w", newline="") as file:
        rows = [(name, f"captures/{name}", genotype, train) for name, _, genotype, train in ROWS]
        csv.writer(file).writerows([("object", "session", "genotype", "train"), *rows])
    with forked_workflow(folder) as snakefile, pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "SNAKEFILE", snakefile)
        printed = call(folder)
    return folder, printed


def test_whole_sessions_have_results_and_the_others_a_sentence(season):
    folder, printed = season
    statuses = {name: [status for status, _ in steps] for name, steps in states(folder).items()}
    assert statuses == {
        **dict.fromkeys(WHOLE, ["done"] * 8),
        "broken": ["failed", "failed", *SKIPPED],
        "unmarked": ["done", "failed", *SKIPPED],
    }
    assert "4 of 6 objects are done." in printed
    rows = table(folder)
    assert list(rows) == [name for name, *_ in ROWS]
    for name, row in rows.items():
        assert row["genotype"] == {name: genotype for name, _, genotype, _ in ROWS}[name]
        whole = name in WHOLE
        assert (row["status"], row["step"]) == (("done", "") if whole else ("failed", "process"))
        for trait in ("area_cm2", "reflectance", "sam_rad", "train_s"):
            assert bool(row[trait]) == whole, (name, trait)
        assert (folder / "out" / "objects" / name / "report.html").is_file() == whole
    assert f"{WHITE_REFERENCE}.raw" in rows["broken"]["sentence"]
    assert "no marker was found" in rows["unmarked"]["sentence"]
    for name in ("broken", "unmarked"):
        assert not re.search(r"\w\. [A-Z]", rows[name]["sentence"])
        assert f"{name}, process: {rows[name]['sentence']}" in printed
    page = (folder / "out" / "index.html").read_text(encoding="utf-8")
    assert all(f'"{name}"' in page for name in rows)


def test_a_second_call_does_nothing_and_a_deleted_result_alone_is_made_again(season):
    """By the steps of the shipped workflow."""
    folder, _ = season
    before, listed = states(folder), (folder / "out" / "traits.csv").stat().st_mtime_ns
    assert "4 of 6 objects are done." in call(folder)
    assert states(folder) == before
    assert (folder / "out" / "traits.csv").stat().st_mtime_ns == listed

    (folder / "out" / "objects" / "tomato" / "traits" / "traits.json").unlink()
    call(folder)
    after = states(folder)
    again = {
        (name, step)
        for name in before
        for step, old, new in zip(STEPS, before[name], after[name], strict=True)
        if old != new
    }
    assert again == {("tomato", "traits"), ("tomato", "report")}
    assert [status for status, _ in after["tomato"]] == ["done"] * 8
    assert (folder / "out" / "traits.csv").stat().st_mtime_ns > listed
    assert table(folder)["tomato"]["area_cm2"]
