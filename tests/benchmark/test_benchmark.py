"""The benchmark: when it evaluates, what its clock counts, which runs it repeats, and what it writes."""

import csv
import json
import math
import os
import shutil
import sys
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest
import torch

from hsi_sc_nerf.benchmark import results, run
from hsi_sc_nerf.benchmark.configurations import (
    CONFIGURATIONS,
    named_configuration,
    own_configuration,
    training_config,
)
from hsi_sc_nerf.benchmark.results import table, write_csv
from hsi_sc_nerf.benchmark.run import BenchmarkRun, Checkpoint, HeldOutViews
from hsi_sc_nerf.benchmark.steps import SPINS, alone_in, run_step
from hsi_sc_nerf.cli import benchmark
from hsi_sc_nerf.cli.benchmark import BenchmarkCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_png

pytestmark = pytest.mark.usefixtures("quick_start")

TINY = " ".join(
    (
        "--pipeline.datamanager.train-num-rays-per-batch 64",
        "--pipeline.model.match-resolution False --pipeline.model.num-levels 4",
        "--pipeline.model.log2-hashmap-size 10 --pipeline.model.max-res 32",
        "--pipeline.model.num-proposal-samples-per-ray 16 8 --pipeline.model.num-nerf-samples-per-ray 8",
        "--machine.device-type {device}",
    )
)


def test_chosen_views_are_spread_evenly_and_counted():
    class Loader:
        def __len__(self):
            return 6

        def get_camera(self, index):
            return index

    assert list(HeldOutViews(Loader(), 3)) == [0, 2, 4]
    assert list(HeldOutViews(Loader(), None)) == list(range(6))
    assert len(HeldOutViews(Loader(), 1)) == 1
    assert len(HeldOutViews(Loader(), 99)) == 6


def test_configurations_of_the_users_own():
    fine = own_configuration("fine=paper --pipeline.model.max-res 1024")
    assert (fine.name, fine.method) == ("fine", named_configuration("paper").method)
    assert fine.words == ("--pipeline.model.max-res", "1024")
    assert own_configuration("x=--vis 'a b'").words == ("--vis", "a b")
    assert own_configuration("same=ours").words == named_configuration("ours").words


@pytest.mark.parametrize("text", ["no-equals", "=--x 1", "../up=--x 1", "a=nowhere --x 1", "a=--x 'open"])
def test_bad_configurations_are_refused_in_one_sentence(text):
    with pytest.raises(InputError, match=r"^[^\n]+\.$"):
        own_configuration(text)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_every_known_configuration_is_one_that_its_method_takes(name):
    known = named_configuration(name)
    assert training_config(known.method, known.words).method_name == known.method


def test_words_change_the_method_and_nothing_else():
    config = training_config("hsi-sc-nerf", ("--pipeline.model.predict-normals", "False", "--masked.lr-end", "0.5"))
    assert config.pipeline.model.predict_normals is False
    assert config.masked.lr_end == 0.5
    assert training_config("hsi-sc-nerf", ()).masked.lr_end != 0.5


@pytest.mark.parametrize(
    ("method", "words", "reason"),
    [
        ("nerfacto", (), "no method is named 'nerfacto'"),
        ("hsi-sc-nerf", ("--pipeline.model.max-ress", "3"), "nrecognized options: --pipeline.model.max-ress"),
        ("hsi-sc-nerf", ("--pipeline.model.max-res", "x"), "(Error parsing"),
        ("hsi-sc-nerf", ("--pipeline.model.background-color", "black"), "options: --pipeline.model.background-color"),
        (  # tyro tells this in two lines
            "hsi-sc-nerf",
            ("--pipeline.model.number-of-samples", "32", "--pipeline.model.learning-rate-of-grid", "0.1"),
            "--pipeline.model.number-of-samples, 32, --pipeline.model.learning-rate-of-grid, 0.1)",
        ),
        ("hsi-sc-nerf", ("--help",), "only ask for help"),
    ],
)
def test_bad_words_are_refused_in_one_sentence(method, words, reason, capsys):
    with pytest.raises(InputError, match=r"^[^\n]+\.$") as error:
        training_config(method, words)
    assert reason in str(error.value)
    assert capsys.readouterr() == ("", "")


def made_up_run(name, gpu_memory_mib=0.0):
    checkpoints = [
        Checkpoint(
            iteration=10 * i,
            stage="full-frame" if i == 1 else "masked",
            ends_stage=i != 2,
            train_seconds=float(i),
            cpu_seconds=2.0 * i,
            evaluation_seconds=1.0,
            peak_memory_mib=100.0,
            gpu_memory_mib=gpu_memory_mib,
            metrics={
                f"{region}{metric}{end}": 0.5 / i
                for region in ("", "full_")
                for metric in ("sam", "rmse", "ssim", "psnr")
                for end in ("", "_std")
            },
        )
        for i in (1, 2, 3)
    ]
    return BenchmarkRun(name, "hsi-sc-nerf", ("--vis", "viewer"), 0.1, tuple(checkpoints))


@pytest.fixture
def in_this_process(monkeypatch):
    """Runs in this process, which has nerfstudio imported."""

    def run_step(name, argv, log):
        run.main(Path(argv[-2]), Path(argv[-1]))

    monkeypatch.setattr(benchmark, "run_step", run_step)


@pytest.fixture
def made_up(monkeypatch):
    """No run is trained; gives the names of those that were asked for. What is in ``fails`` fails."""
    ran = SimpleNamespace(names=[], fails=())

    def run_step(name, argv, log):
        ran.names.append(name)
        if name in ran.fails:
            raise InputError(f"the step '{name}' failed with status 1; what it said is above and in {log}.")
        found = {"setup_seconds": 0.1, "checkpoints": [asdict(c) for c in made_up_run("a").checkpoints]}
        Path(argv[-1]).write_text(json.dumps(found))

    monkeypatch.setattr(benchmark, "run_step", run_step)
    monkeypatch.setattr(results, "draw_accuracy_and_time", lambda path, runs, clock: None)
    return ran


def command(tiny_dataset, folder, device="cpu", **changes):
    made = BenchmarkCommand(
        data=tiny_dataset[0],
        output_dir=folder,
        configurations=("ours",),
        sets=("no-normals=--pipeline.model.predict-normals False",),
        common=TINY.format(device=device),
        iterations=6,
        checkpoints=(0.34, 1.0),
        held_out_views=1,
        threads=torch.get_num_threads(),
    )
    return replace(made, **changes)


@pytest.mark.slow
def test_two_configurations_are_trained_timed_and_compared(tiny_dataset, tmp_path, in_this_process, device):
    command(tiny_dataset, tmp_path, device).main()
    with (tmp_path / "benchmark.csv").open(encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    assert [(line["configuration"], line["iteration"], line["ends_stage"]) for line in lines] == [
        (name, *rest) for name in ("ours", "no-normals") for rest in (("2", "False"), ("3", "True"), ("6", "True"))
    ]
    assert [line["stage"] for line in lines[:3]] == ["full-frame", "full-frame", "masked"]
    for line in lines:
        assert all(math.isfinite(float(line[key])) for key in ("sam", "sam_std", "rmse", "ssim", "psnr", "full_psnr"))
        assert float(line["peak_memory_mib"]) > 10
        assert (float(line["gpu_memory_mib"]) > 0) == (device == "cuda")
    for clock in ("train_seconds", "cpu_seconds"):
        first, second, third = (float(line[clock]) for line in lines[:3])
        assert 0 < first < second < third
    content = json.loads((tmp_path / "benchmark.json").read_text())
    assert content["machine"]["torch"] == version("torch")
    assert "predict-normals" in (tmp_path / "benchmark.md").read_text()
    assert cv2.imread(str(tmp_path / "benchmark.png")).std() > 5


@pytest.mark.slow
def test_evaluations_on_the_way_do_not_change_the_training(tiny_dataset, tmp_path):
    job = benchmark._job(named_configuration("ours"), command(tiny_dataset, tmp_path), tiny_dataset[0])
    ends = []
    for checkpoints in ((1.0,), (0.17, 0.67, 1.0)):
        ends.append(run.train(replace(job, checkpoints=checkpoints))["checkpoints"][-1]["metrics"])
    assert ends[0] == pytest.approx(ends[1], rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["wall", "cpu"])
def test_a_timed_run_ends_by_its_clock(tiny_dataset, tmp_path, in_this_process, clock):
    asked = command(tiny_dataset, tmp_path, sets=(), iterations=None, train_seconds=0.6, clock=clock)
    asked.main()
    (run,) = json.loads((tmp_path / "benchmark.json").read_text())["runs"]
    ends = [checkpoint for checkpoint in run["checkpoints"] if checkpoint["ends_stage"]]
    assert [checkpoint["stage"] for checkpoint in ends] == ["full-frame", "masked"]
    seconds = [checkpoint["train_seconds" if clock == "wall" else "cpu_seconds"] for checkpoint in ends]
    assert all(read >= due for read, due in zip(seconds, (0.3, 0.6), strict=True))


@pytest.mark.slow
def test_finished_runs_are_not_repeated(tiny_dataset, tmp_path, made_up):
    asked = command(tiny_dataset, tmp_path)
    asked.main()
    assert made_up.names == ["training of ours", "training of no-normals"]
    asked.main()
    assert len(made_up.names) == 2
    (tmp_path / "ours" / "result.json").unlink()
    asked.main()
    assert made_up.names[2:] == ["training of ours"]
    assert [r["name"] for r in json.loads((tmp_path / "benchmark.json").read_text())["runs"]] == [
        "ours",
        "no-normals",
    ]
    replace(asked, configurations=(), iterations=4).main()
    assert made_up.names[3:] == ["training of no-normals"]


def test_a_run_on_another_dataset_or_after_masks_were_mended_is_another_run(tiny_dataset, tmp_path, made_up):
    data = shutil.copytree(tiny_dataset[0], tmp_path / "data")
    asked = command((data,), tmp_path / "out", sets=())
    asked.main()
    (data / "transforms.json").write_text((data / "transforms.json").read_text() + "\n")
    asked.main()
    assert made_up.names == ["training of ours"] * 2
    mask = sorted((data / "masks").glob("*.png"))[0]
    write_png(mask, 255 - cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE))
    asked.main()
    os.utime(mask)  # copied or touched, it is the same
    asked.main()
    assert made_up.names == ["training of ours"] * 3


@pytest.mark.parametrize(
    ("code", "told", "cause"),
    [
        ("raise SystemExit(3)", "status 3", False),
        ("import os; os.kill(os.getpid(), 9)", "signal 9", True),
        ("import os; os.kill(os.getpid(), 15)", "signal 15", False),
    ],
)
def test_a_step_that_the_system_ended_says_so(tmp_path, code, told, cause):
    with pytest.raises(InputError, match=told) as error:
        run_step("train", [sys.executable, "-S", "-c", code], tmp_path / "train.log")
    assert str(tmp_path / "train.log") in str(error.value)
    assert ("memory" in str(error.value)) == cause


@pytest.mark.parametrize("own", [None, "7"])
def test_threads_of_a_step_do_not_spin_long_unless_the_user_says_so(tmp_path, monkeypatch, own):
    monkeypatch.delenv("GOMP_SPINCOUNT", raising=False)
    if own is not None:
        monkeypatch.setenv("GOMP_SPINCOUNT", own)
    log = tmp_path / "step.log"
    run_step("step", [sys.executable, "-S", "-c", "import os; print(os.environ['GOMP_SPINCOUNT'])"], log)
    assert log.read_text() == f"{own or SPINS}\n"


def test_where_processes_are_not_measured_the_system_is_named(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "wait4")
    with pytest.raises(InputError, match="Linux and macOS"):
        run_step("train", [sys.executable], tmp_path / "train.log")


def test_a_failed_run_loses_only_itself(tiny_dataset, tmp_path, made_up):
    made_up.fails = ("training of ours",)
    with pytest.raises(InputError, match=r"1 of 2 configurations failed.*training of ours"):
        command(tiny_dataset, tmp_path).main()
    assert list((tmp_path / "ours").iterdir()) == []
    assert [r["name"] for r in json.loads((tmp_path / "benchmark.json").read_text())["runs"]] == ["no-normals"]


def test_where_another_one_works_nothing_is_trained(tiny_dataset, tmp_path, made_up):
    with alone_in(tmp_path), pytest.raises(InputError, match="another command works there"):
        command(tiny_dataset, tmp_path).main()
    assert made_up.names == []


def test_results_of_earlier_calls_are_written_though_all_that_is_left_fails(tiny_dataset, tmp_path, made_up):
    command(tiny_dataset, tmp_path, configurations=()).main()
    (tmp_path / "benchmark.json").unlink()
    made_up.fails = ("training of ours",)
    with pytest.raises(InputError, match="1 of 2 configurations failed"):
        command(tiny_dataset, tmp_path).main()
    assert [r["name"] for r in json.loads((tmp_path / "benchmark.json").read_text())["runs"]] == ["no-normals"]


@pytest.mark.parametrize(
    "changes",
    [
        {"configurations": ("theirs",)},
        {"sets": ("ours=--vis tensorboard",)},
        {"configurations": (), "sets": ()},
        {"common": "--no-such-word 1"},
        {"iterations": 0},
        {"train_seconds": -1.0},
        {"checkpoints": (0.5, 2.0)},
        {"held_out_views": 0},
        {"threads": 0},
        {"data": Path("nowhere")},
    ],
)
def test_bad_settings_are_one_sentence_before_anything_is_trained(tiny_dataset, tmp_path, made_up, changes):
    with pytest.raises(InputError, match=r"^[^\n]+\.$"):
        command(tiny_dataset, tmp_path / "out", **changes).main()
    assert made_up.names == []
    assert not (tmp_path / "out").exists()


def test_table_has_a_row_for_each_stage():
    titles, rows = table([made_up_run("a"), made_up_run("b")])
    assert [row[:5] for row in rows] == [
        [n, *r] for n in "ab" for r in (["full-frame", "10", "0", "1"], ["masked", "30", "0", "3"])
    ]
    assert all(len(row) == len(titles) for row in rows)
    assert "GPU memory, MiB" not in titles
    assert "GPU memory, MiB" in table([made_up_run("a", 5.0)])[0]


@pytest.mark.slow
def test_csv_and_picture_take_more_runs_than_there_are_colours(tmp_path):
    runs = [made_up_run(f"run-{i}") for i in range(9)]
    write_csv(tmp_path / "runs.csv", runs)
    assert len((tmp_path / "runs.csv").read_text().splitlines()) == 1 + 27
    results.draw_accuracy_and_time(tmp_path / "runs.png", runs, "cpu")
    assert cv2.imread(str(tmp_path / "runs.png")).std() > 5
