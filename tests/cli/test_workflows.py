"""`hsi-sc-nerf run` through the real commands: nothing is done twice, and what was stopped or removed is made.

The demo has tests of its own (test_end_to_end.py); here is what it does to folders that are not its own.
"""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import redirect_stdout

import pytest
from rich.console import Console
from steps_here import steps_here

from hsi_sc_nerf.batch.session_steps import STEPS_NAME, Step
from hsi_sc_nerf.benchmark.steps import alone_in, own_cost
from hsi_sc_nerf.cli.workflows import DemoCommand, RunCommand, _show_results
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json

ALL = ["process", "train", "evaluate", "export", "material", "traits", "report"]
SIZE = {"size": {"volume_l": 0.226, "height_m": 0.0666, "area_m2": 0.0186}, "watertight": True}
SCORES = {"results": {"sam": 0.03, "rmse": 0.02, "ssim": 0.9, "psnr": 34.0}}
LIGHT = {
    "shaded": True,
    "corrected": True,
    "relative_std": 0.12,
    "evidence": {"profile": 0.9, "profile_std": 0.1},
}
TRAIN = " ".join(
    (
        "--pipeline.datamanager.train-num-rays-per-batch 256 --pipeline.model.match-resolution False",
        "--pipeline.model.num-levels 8 --pipeline.model.log2-hashmap-size 14 --pipeline.model.max-res 128",
        "--pipeline.model.proposal-warmup 100 --steps-per-save 10 --evaluate-stages False",
    )
)


OPTIONS = {"max_num_iterations": 40, "num_points": 1000, "train": TRAIN, "traits": "--mesh.octree-depth 5"}


@pytest.fixture(scope="module")
def run():
    """The rest of a run in this process; gives what it prints."""
    with steps_here() as run_step:

        def run(session, out):
            printed = io.StringIO()
            with redirect_stdout(printed):
                RunCommand(session, out, **OPTIONS).main(run_step)
            return printed.getvalue()

        yield run


def done(printed):
    """Steps whose command was run."""
    return [name for name in ALL if f"{name}: up to date" not in printed]


@pytest.fixture(scope="module")
def killed(tiny_dataset, tmp_path_factory):
    """A run that was killed in its training, after the first checkpoint."""
    out = tmp_path_factory.mktemp("run") / "out"
    write_json(out / STEPS_NAME, {})
    shutil.copytree(tiny_dataset[0], out / "data")  # which `process` finds up to date
    words = [sys.executable, "-m", "hsi_sc_nerf.cli.main", "run", tiny_dataset[1], "--output-dir", out]
    words += [f"--{name.replace('_', '-')}={value}" for name, value in OPTIONS.items()]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    weights = out / "training" / "hsi-sc-nerf" / "run" / "nerfstudio_models"
    started = time.monotonic()
    while not any(weights.glob("*.ckpt")):
        assert process.poll() is None
        assert time.monotonic() - started < 600
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not json.loads((out / STEPS_NAME).read_text())["train"]["finished"]
    return out


@pytest.fixture(scope="module")
def whole(tiny_dataset, killed, run):
    """The run brought to its end by a second call."""
    return tiny_dataset[1], killed, run(tiny_dataset[1], killed)


@pytest.mark.slow
def test_a_killed_run_goes_on_and_shows_its_commands(whole):
    _, out, printed = whole
    assert done(printed) == ALL[1:]
    assert f"--load-dir {out / 'training' / 'hsi-sc-nerf' / 'run' / 'nerfstudio_models'}" in printed
    assert "Going on from" in (out / "logs" / "train.log").read_text()
    for command in ("ns-train hsi-sc-nerf --data", "ns-eval --load-config", "ns-export pointcloud", "report.html"):
        assert command in printed
    assert "SAM 0." in printed
    assert "height" in printed
    assert (out / "report.html").stat().st_size > 10_000
    assert json.loads((out / STEPS_NAME).read_text()).keys() == set(ALL)


@pytest.mark.slow
def test_a_second_call_does_nothing_and_a_removed_result_is_made_again(whole, run):
    session, out, _ = whole
    files = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert done(run(session, out)) == []
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()} == files
    (out / "traits" / "traits.json").unlink()
    assert done(run(session, out)) == ["traits", "report"]


@pytest.mark.parametrize("pieces", [[SIZE], [{"piece": 1} | SIZE, {"piece": 2} | SIZE]])
def test_sizes_of_a_session_without_a_scale_are_said_to_be_wrong(tmp_path, capsys, pieces):
    write_json(tmp_path / "eval.json", SCORES)
    wrong = [one | {"settings": {"metric": False}} for one in pieces]
    write_json(tmp_path / "traits" / "traits.json", {"pieces": wrong} if len(pieces) > 1 else wrong[0])
    _show_results(tmp_path, Console(highlight=False, soft_wrap=True))
    told = [line[:4] for line in capsys.readouterr().out.splitlines()]
    assert told == ["Held", "Size", *["Size"] * len(pieces), "Open"]


def test_at_the_end_stand_results_warnings_and_the_file_to_open(tmp_path, capsys):
    write_json(tmp_path / "eval.json", SCORES)
    write_json(tmp_path / "traits" / "traits.json", SIZE)
    findings = [
        {"name": "frames", "level": "green", "sentence": "12 frames."},
        {"name": "focus", "level": "amber", "sentence": "Frame [7] is blurred."},
    ]
    write_json(tmp_path / "data" / "report" / "inspection.json", {"findings": findings})
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "traits.log").write_text("Mesh made.\nWarning: it has holes.\n")
    _show_results(tmp_path, Console(highlight=False, soft_wrap=True))
    assert capsys.readouterr().out.splitlines() == [
        "Held-out views, inside the mask: SAM 0.0300 rad, RMSE 0.0200, SSIM 0.900, PSNR 34.0 dB",
        "Size: height 66.6 mm, area 186.0 cm², volume 226.0 mL",
        "focus: Frame [7] is blurred.",
        "traits: Warning: it has holes.",
        f"Open {tmp_path / 'report.html'} in a browser.",
    ]


@pytest.mark.parametrize("found", [True, False])
def test_a_run_says_what_it_decided_of_the_light_and_does_without(tmp_path, capsys, found):
    session, out = tmp_path / "session", tmp_path / "out"
    (session / "a" / "capture").mkdir(parents=True)  # by its names a session; nothing is read
    results = {
        "process": ["data/transforms.json"],
        "train": ["training/hsi-sc-nerf/run/config.yml"],
        "evaluate": ["eval.json"],
        "export": ["point_cloud.ply"],
        "material": ["point_cloud-material.ply", "point_cloud-material.json"],
        "traits": ["traits/traits.json"],
        "report": ["report.html"],
    }

    def run_step(name, argv, log):
        for path in results[name]:
            content = SCORES if name == "evaluate" else SIZE if name == "traits" else LIGHT
            write_json(out / path, content)
        if name == "material" and not found:
            raise InputError("it failed.")
        return own_cost(name, time.perf_counter())

    RunCommand(session, out, material="--white-azimuth-deg -35").main(run_step)
    printed = capsys.readouterr().out
    assert "--white-azimuth-deg -35" in printed
    assert ("\nLight: " in printed) == found
    assert ("it failed." in printed) == (not found)
    # What failed left half of its results.
    assert (out / "point_cloud-material.ply").is_file() == found
    assert done_steps(out) == (set(ALL) if found else set(ALL) - {"material"})


@pytest.mark.parametrize("kind", ["run", "demo"])
def test_where_another_one_works_nothing_is_done(tmp_path, kind):
    """Both would train into one folder, and evaluate what the other one has left there."""
    session, out = tmp_path / "session", tmp_path / "out"
    for folder in (session / "a" / "capture", out):
        folder.mkdir(parents=True)
    command = RunCommand(session, out) if kind == "run" else DemoCommand(out)
    with alone_in(out), pytest.raises(InputError, match="out: another command works there"):
        command.main()
    with alone_in(out):  # which is free again
        assert list(out.iterdir()) == []


def done_steps(out):
    steps = json.loads((out / STEPS_NAME).read_text())
    return {name for name, entry in steps.items() if entry["finished"]}


def test_results_that_lie_in_the_session_are_no_input(tmp_path):
    session, out = tmp_path / "session", tmp_path / "session" / "out"
    out.mkdir(parents=True)
    (session / "a.raw").write_bytes(b"1")
    step = Step("process", ("hsi-sc-nerf", "process"), (session,), ())
    first = step.fingerprint(out)
    (out / "b.raw").write_bytes(b"1")
    assert step.fingerprint(out) == first


def test_ctrl_c_is_one_line_that_says_what_goes_on(monkeypatch, capsys, command):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(RunCommand, "main", interrupted)
    assert command("run", "s", "--output-dir", "o") == 130
    assert capsys.readouterr().err == "Stopped; the same command goes on where it stopped.\n"


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("x")
    (tmp_path / "session").mkdir()
    nowhere = tmp_path / "nowhere"
    for session, told in ((tmp_path / "session", "something other"), (out, "session itself"), (nowhere, "no folder")):
        with pytest.raises(InputError, match=told):
            RunCommand(session, out, max_num_iterations=5).main()
    assert [path.name for path in out.iterdir()] == ["thesis.txt"]


def test_the_demo_leaves_somebody_elses_runs_alone(tmp_path):
    """A folder of nerfstudio's looks like a demo's, but for the mark."""
    for name in ("logs", "runs", "renders"):
        (tmp_path / name).mkdir()
    kept = tmp_path / "runs" / "config.yml"
    kept.write_text("months of work")
    with pytest.raises(InputError, match="other than a demo"):
        DemoCommand(output_dir=tmp_path).main()
    assert kept.read_text() == "months of work"


def test_a_file_is_no_folder_for_the_demo(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(InputError, match="out: cannot be created as a folder"):
        DemoCommand(output_dir=tmp_path / "out").main()


def test_run_on_a_folder_without_captures_is_one_sentence_and_leaves_nothing(tmp_path):
    session = tmp_path / "session"
    session.mkdir()
    with pytest.raises(InputError, match="holds no captures"):
        RunCommand(session, tmp_path / "out").main()
    assert list(tmp_path.iterdir()) == [session]
