"""nerfstudio's own commands on a small run and a dataset of this package: the table of its how-to page."""

import contextlib
import inspect
import json
import shutil
import sys
import time
from pathlib import Path
from urllib.error import URLError
from urllib.request import urlopen

import ball_run
import pytest
import small_trainer
import torch
import tyro
from browser_pictures import viewer
from nerfstudio.configs import external_methods

from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.nerfstudio_commands import extend_nerfstudio_commands

pytestmark = pytest.mark.slow

TEXTURE = ("--target-num-faces", "100", "--num-pixels-per-side", "32")
CAMERA = {"camera_to_world": [1, 0, 0, 0, 0, 0, -1, -3, 0, 1, 0, 0.3, 0, 0, 0, 1], "fov": 30, "aspect": 1}


@pytest.fixture(scope="module")
def config_path(tmp_path_factory):
    """A run whose model is a ball."""
    folder = tmp_path_factory.mktemp("ball")
    return ball_run.write_untrained_run(ball_run.write_ball_dataset(folder / "data"), folder / "runs")


@pytest.fixture(scope="module")
def scripts():
    from nerfstudio.scripts import eval, exporter, render

    extend_nerfstudio_commands()  # as at the end of their import by a console script

    def opens_ball(original):
        def eval_setup(*arguments, **options):
            config, pipeline, checkpoint, step = original(*arguments, **options)
            ball_run.fill_with_ball(TrainedRun(pipeline.model, pipeline.datamanager))
            return config, pipeline, checkpoint, step

        return eval_setup

    original = eval.eval_setup
    for module in (eval, exporter, render):
        module.eval_setup = opens_ball(original)
    yield {"ns-eval": (eval, "ComputePSNR"), "ns-export": (exporter, "Commands"), "ns-render": (render, "Commands")}
    for module in (eval, exporter, render):
        module.eval_setup = original


@pytest.fixture
def call(scripts, config_path):
    def called(program, *words, load_config=config_path):
        module, commands = scripts[program]
        split = 1 if commands == "Commands" else 0
        arguments = [*words[:split], "--load-config", load_config, *words[split:]]
        tyro.cli(getattr(module, commands), args=[str(word) for word in arguments]).main()

    return called


@pytest.fixture
def ffmpeg(tmp_path, monkeypatch):
    """nerfstudio looks for the program, and does not need it for pictures."""
    if shutil.which("ffmpeg") is None:
        program = tmp_path / "bin" / "ffmpeg"
        program.parent.mkdir()
        program.write_text("#!/bin/sh\n")
        program.chmod(0o755)
        monkeypatch.setenv("PATH", str(program.parent), prepend=":")


@pytest.mark.parametrize("typed", ["", "{}/apple"])
def test_a_run_is_evaluated_and_rendered_where_it_lies(call, tmp_path, monkeypatch, typed):
    """It was moved; in the working folder, and where it lay, the paths that were typed are another run's."""
    trained, lies, other = tmp_path / "apple", tmp_path / "disk" / "apple", tmp_path / "pear"
    trained.mkdir()
    monkeypatch.chdir(trained)
    typed = Path(typed.format(tmp_path)) / "out"
    data = ball_run.write_ball_dataset(typed / "data")
    written = (trained / ball_run.write_untrained_run(data, typed)).relative_to(trained)
    lies.parent.mkdir()
    trained.rename(lies)
    checkpoints = other / written.parent / "nerfstudio_models"
    checkpoints.mkdir(parents=True)
    for path in (checkpoints / "step-000000001.ckpt", other / "out" / "other.txt"):
        path.write_text("another run's")
    if not typed.is_absolute():  # a dataset that is named absolutely, and is there, is taken
        (other / "out" / "data").mkdir()
        (other / "out" / "data" / "transforms.json").write_text("another run's")
    other.rename(trained) if typed.is_absolute() else monkeypatch.chdir(other)
    call("ns-eval", "--output-path", tmp_path / "eval.json", load_config=lies / written)
    told = json.loads((tmp_path / "eval.json").read_text())
    assert (told["experiment_name"], told["method_name"]) == ("ball", "hsi-sc-nerf")
    assert Path(told["checkpoint"]).parent == lies / written.parent / "nerfstudio_models"
    assert 0 < told["results"]["sam"] < 0.2
    call("ns-render", "dataset", "--output-path", tmp_path, load_config=lies / written)
    assert any((tmp_path / "test").iterdir())


@pytest.mark.parametrize(
    ("words", "written"),
    [
        (("cameras",), "transforms_train.json"),
        (("tsdf", "--resolution", "32", *TEXTURE), "tsdf_mesh.ply"),
        (("poisson", "--num-points", "1000", "--num-rays-per-batch", "1024", *TEXTURE), "poisson_mesh.ply"),
    ],
)
def test_exports(call, tmp_path, words, written):
    call("ns-export", *words, "--output-dir", tmp_path)
    assert (tmp_path / written).stat().st_size > 200


@pytest.mark.parametrize(
    ("program", "words", "told"),
    [
        ("ns-export", ("marching-cubes", "--output-dir", "x"), "signed distance"),
        ("ns-export", ("gaussian-splat", "--output-dir", "x"), "Gaussians"),
        ("ns-render", ("dataset", "--downscale-factor", "8"), "hsi-sc-nerf render"),
        ("ns-render", ("interpolate",), "--pose-source train"),
        ("ns-eval", ("--output-path", "scores.txt"), "ends in .json"),
        ("ns-eval", ("--output-path", "/proc/nowhere/scores.json"), "/proc/nowhere"),
        ("ns-render", ("dataset", "--rendered-output-names", "rgb", "spectral"), "hsi-sc-nerf render"),
        ("ns-render", ("interpolate", "--rendered-output-names", "spectral"), "hsi-sc-nerf render"),
    ],
)
def test_what_cannot_work_is_one_sentence(call, tmp_path, monkeypatch, program, words, told):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=rf"^hsi-sc-nerf: [^\n]*{told}[^\n]*\.$"):
        call(program, *words)
    assert list(tmp_path.iterdir()) == []


def test_renders_of_the_dataset(call, tmp_path):
    call("ns-render", "dataset", "--output-path", tmp_path)
    pictures = list((tmp_path / "test").iterdir())
    assert {path.stem for path in pictures} == {"gt-rgb", "rgb", "accumulation", "depth", "expected_depth"}
    assert all(path.stat().st_size > 200 for path in pictures)


@pytest.mark.parametrize("kind", ["interpolate", "camera-path", "spiral"])
def test_renders_of_paths(call, ffmpeg, tmp_path, kind):
    path = {"camera_type": "perspective", "render_height": 24, "render_width": 24, "camera_path": [CAMERA, CAMERA]}
    (tmp_path / "path.json").write_text(json.dumps(path | {"fps": 2, "seconds": 1, "is_cycle": False}))
    options = {
        "interpolate": ("--interpolation-steps", "2", "--downscale-factor", "4", "--pose-source", "train"),
        "camera-path": ("--camera-path-filename", tmp_path / "path.json"),
        "spiral": ("--seconds", "0.1", "--downscale-factor", "4"),
    }[kind]
    call("ns-render", kind, *options, "--output-format", "images", "--output-path", tmp_path / "video.mp4")
    assert len(list((tmp_path / "video").iterdir())) >= 2


@pytest.fixture
def ns_train(tmp_path, monkeypatch):
    """`ns-train` in this process, its results in the test's folder."""
    from nerfstudio.scripts import train
    from nerfstudio.utils import writer

    def called(words):
        options = f" --output-dir {tmp_path} --vis tensorboard "
        monkeypatch.setattr(sys, "argv", ["ns-train", *words.replace(" ", options, 1).split()])
        train.entrypoint()

    monkeypatch.setattr(writer, "EVENT_WRITERS", [])  # those of other runs in this process
    return called


def page(address, told):
    """What a server says as soon as it says ``told``."""
    text = ""
    for _ in range(240):
        with contextlib.suppress(URLError):
            text = urlopen(address, timeout=60).read().decode()
        if told in text:
            return text
        time.sleep(1)
    pytest.fail(f"{address} does not say {told!r}: {text[:500]!r}")


def test_viewer_opens_a_run(config_path):
    with viewer(config_path) as address:
        page(address, "<title>")


def test_viewer_of_no_run_is_one_sentence(tmp_path):
    from nerfstudio.scripts.viewer import run_viewer

    extend_nerfstudio_commands()
    with pytest.raises(SystemExit, match=r"^hsi-sc-nerf: [^\n]*nowhere[^\n]*\.$"):
        tyro.cli(run_viewer.RunViewer, args=["--load-config", str(tmp_path / "nowhere.yml")]).main()


def test_tensorboard_shows_what_a_run_wrote(tiny_dataset, tmp_path, monkeypatch):
    from tensorboard.program import TensorBoard

    monkeypatch.setattr("nerfstudio.utils.writer.EVENT_WRITERS", [])  # those of other runs in this process
    made = small_trainer.trainer(tiny_dataset, tmp_path)
    made.config.logging.steps_per_log = 1
    made.train()
    board = TensorBoard()
    board.configure(argv=["tensorboard", "--logdir", str(tmp_path), "--port", "0"])
    (tags,) = json.loads(page(f"{board.launch()}data/plugin/scalars/tags", "Train Loss")).values()
    assert {"Train Loss", "Train Metrics Dict/sam", "learning_rate/fields"} <= set(tags)


def test_stock_nerfacto_trains_on_our_dataset(tiny_dataset, tmp_path, ns_train, monkeypatch):
    from torchmetrics.image import lpip

    monkeypatch.setattr(lpip, "LearnedPerceptualImagePatchSimilarity", torch.nn.Identity)  # would fetch a network
    ns_train(
        f"""nerfacto --data {tiny_dataset[0]} --timestamp run --max-num-iterations 3 --machine.device-type cpu
        --pipeline.model.implementation torch --pipeline.model.log2-hashmap-size 10
        --pipeline.datamanager.train-num-rays-per-batch 64 hsi-sc-nerf-data"""
    )
    (checkpoint,) = tmp_path.rglob("*.ckpt")
    assert torch.load(checkpoint, weights_only=False)["step"] == 2


def test_training_on_bad_data_ends_in_one_sentence(tmp_path, ns_train):
    with pytest.raises(SystemExit, match=r"^hsi-sc-nerf: [^\n]*nowhere[^\n]*\.$"):
        ns_train(f"hsi-sc-nerf --data {tmp_path / 'nowhere'}")


def test_external_methods_are_listed_without_a_look_at_sources_and_say_how_they_are_installed(monkeypatch, capsys):
    looked_for = []
    with monkeypatch.context() as patch:
        patch.setattr(inspect, "getmodule", lambda *names: looked_for.append(names))
        methods, _ = external_methods.get_external_methods()
    assert len(methods) > 10
    assert looked_for == []
    with pytest.raises(SystemExit):
        external_methods.ExternalMethodDummyTrainerConfig("x", external_methods.ExternalMethod("Install x.", []))
    assert "Install x." in capsys.readouterr().out
