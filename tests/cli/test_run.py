"""`hsi-sc-nerf run` through the real commands: nothing is done twice, and what was stopped or removed is made."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from hsi_sc_nerf.cli.run import STEPS_NAME, RunCommand, Step
from hsi_sc_nerf.errors import InputError

ALL = ["process", "train", "evaluate", "export", "traits", "report"]
TRAIN = " ".join(
    (
        "--pipeline.datamanager.train-num-rays-per-batch 256 --pipeline.model.match-resolution False",
        "--pipeline.model.num-levels 8 --pipeline.model.log2-hashmap-size 14 --pipeline.model.max-res 128",
        "--pipeline.model.proposal-warmup 100 --steps-per-save 20 --evaluate-stages False",
    )
)


def words(session, out, iterations):
    options = ["--max-num-iterations", str(iterations), "--num-points", "3000", f"--train={TRAIN}"]
    return [sys.executable, "-m", "hsi_sc_nerf.cli.main", "run", str(session), "--output-dir", str(out), *options]


def run(session, out, iterations=150):
    made = subprocess.run(words(session, out, iterations), capture_output=True, text=True)
    assert made.returncode == 0, made.stdout + made.stderr
    return made.stdout


def done(printed):
    """Steps whose command was run."""
    return [name for name in ALL if f"{name}: up to date" not in printed]


@pytest.fixture(scope="module")
def whole(tiny_dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "out"
    return tiny_dataset[1], out, run(tiny_dataset[1], out)


@pytest.mark.slow
def test_every_step_is_run_and_its_command_shown(whole):
    session, out, printed = whole
    assert done(printed) == ALL
    assert f"hsi-sc-nerf process {session} --output-dir {out / 'data'}" in printed
    for command in ("ns-train hsi-sc-nerf --data", "ns-eval --load-config", "ns-export pointcloud", "report.html"):
        assert command in printed
    assert "SAM 0." in printed
    assert "height" in printed
    assert (out / "report.html").stat().st_size > 10_000
    assert json.loads((out / STEPS_NAME).read_text()).keys() == set(ALL)


@pytest.mark.slow
def test_a_second_call_does_nothing_and_a_removed_cloud_is_made_again(whole):
    session, out, _ = whole
    files = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert done(run(session, out)) == []
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()} == files
    (out / "point_cloud.ply").unlink()
    assert done(run(session, out)) == ["export", "traits", "report"]


@pytest.mark.slow
def test_a_killed_training_goes_on(tiny_dataset, tmp_path):
    out = tmp_path / "out"
    process = subprocess.Popen(words(tiny_dataset[1], out, 400), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    weights = out / "training" / "hsi-sc-nerf" / "run" / "nerfstudio_models"
    started = time.monotonic()
    while not any(weights.glob("*.ckpt")):
        assert process.poll() is None
        assert time.monotonic() - started < 300
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not json.loads((out / STEPS_NAME).read_text())["train"]["finished"]
    printed = run(tiny_dataset[1], out, 400)
    assert done(printed) == ALL[1:]
    assert f"--load-dir {weights}" in printed
    assert "Going on from" in (out / "logs" / "train.log").read_text()


def test_a_step_depends_on_its_words_and_files(tmp_path):
    session, out = tmp_path / "session", tmp_path / "session" / "out"
    out.mkdir(parents=True)
    (session / "a.raw").write_bytes(b"1")
    step = Step("process", ("hsi-sc-nerf", "process"), (session,), ())
    first = step.fingerprint(out)
    (out / "b.raw").write_bytes(b"1")  # its own results are no input
    assert step.fingerprint(out) == first
    assert Step("process", ("hsi-sc-nerf", "process", "--poses"), (session,), ()).fingerprint(out) != first
    (session / "a.raw").write_bytes(b"12")
    assert step.fingerprint(out) != first


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("x")
    for session, told in ((tmp_path / "session", "something other"), (out, "is the session itself")):
        with pytest.raises(InputError, match=told):
            RunCommand(session, out, max_num_iterations=5).main()
    assert [path.name for path in out.iterdir()] == ["thesis.txt"]
