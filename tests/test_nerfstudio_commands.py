"""Which commands of nerfstudio are adapted, and what they say to runs that they cannot work with."""

import copy
import errno
import os
import shutil
import signal
import sys
import types
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from nerfstudio.engine.trainer import TrainerConfig

from hsi_sc_nerf import nerfstudio_commands as adapter
from hsi_sc_nerf.cli.trained_runs import ExportCommand, RenderCommand, ReportCommand
from hsi_sc_nerf.config import hsi_sc_nerf
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models import staged_trainer
from hsi_sc_nerf.models.run_settings import read_config
from hsi_sc_nerf.models.trained_run import open_trained_run


def command(kind, path, **options):
    made = type(kind, (), {})()
    made.load_config = path
    vars(made).update(options)
    return made


@pytest.fixture
def ours(tmp_path):
    """The config.yml of a run of this package, with an empty folder of checkpoints."""
    config = copy.deepcopy(hsi_sc_nerf.config)
    config.output_dir, config.experiment_name, config.timestamp = tmp_path, "x", "run"
    config.get_checkpoint_dir().mkdir(parents=True)
    path = config.get_base_dir() / "config.yml"
    path.write_text(yaml.dump(config))
    return path


def with_checkpoint(config_path, **content):
    state = {"step": 1, "pipeline": {}} | content
    torch.save(state, config_path.parent / "nerfstudio_models" / "step-000000001.ckpt")
    return config_path


@pytest.fixture
def other(tmp_path):
    path = tmp_path / "other.yml"
    path.write_text(yaml.dump(TrainerConfig(method_name="nerfacto")))
    return path


def test_runs_of_other_methods_pass(other):
    for kind in ("ComputePSNR", "ExportMarchingCubesMesh"):
        assert adapter.prepare(command(kind, other)) is False


def _empty(config_path):
    config_path.write_text("")


def _without(line):
    def remove(config_path):
        lines = with_checkpoint(config_path).read_text().splitlines(keepends=True)
        config_path.write_text("".join(one for one in lines if not one.startswith(line)))

    return remove


def _of_method(name):
    def rename(config_path):
        text = with_checkpoint(config_path).read_text()
        assert "method_name: hsi-sc-nerf\n" in text
        config_path.write_text(text.replace("method_name: hsi-sc-nerf\n", f"method_name: {name}\n"))

    return rename


def _damaged(config_path):
    with_checkpoint(config_path)
    checkpoint = config_path.parent / "nerfstudio_models" / "step-000000001.ckpt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-100])


def _with_stray_file(config_path):
    (with_checkpoint(config_path).parent / "nerfstudio_models" / "notes.txt").write_text("good")


def _with_other_names(config_path):
    (config_path.parent / "nerfstudio_models" / "step-best.ckpt").write_bytes(b"")


class _Executes:
    """What an unsafe loader of pickles would execute: a folder is made."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def _that_executes(config_path):
    with_checkpoint(config_path, pipeline=_Executes(config_path.parent / "executed"))


NO_RUNS = {
    "no file": (lambda path: path.unlink(), "there is no such file"),
    "empty": (_empty, "cannot be read"),
    "no method": (_without("method_name:"), "names the method None"),
    "list as method": (_of_method("[1]"), r"names the method \[1\]"),
    "unknown method": (_of_method("hsi-sc-nerf-2"), "names the method 'hsi-sc-nerf-2'"),
    "no checkpoint": (lambda path: None, "holds no checkpoint; the run has saved none"),
    "checkpoint of another name": (
        _with_other_names,
        "(holds no checkpoint; the run|step-best.ckpt: is no checkpoint)",
    ),
    "damaged checkpoint": (_damaged, "is not a readable checkpoint"),
    "checkpoint without a step": (lambda path: with_checkpoint(path, step=None), "is no checkpoint of a model"),
    "checkpoint without a model": (lambda path: with_checkpoint(path, pipeline=None), "is no checkpoint of a model"),
    "checkpoint of something else": (
        lambda path: with_checkpoint(path, pipeline={"a": 1}),
        "is no checkpoint of a model",
    ),
    "checkpoint that executes": (_that_executes, "is not a readable checkpoint"),
    "stray file": (_with_stray_file, "notes.txt: is no checkpoint, and nerfstudio takes it for one; move it"),
}


@pytest.mark.parametrize("case", NO_RUNS)
def test_what_is_no_run_is_one_sentence(ours, tmp_path, case):
    """In nerfstudio's commands, and in `open_trained_run`, by which all of ours open a run."""
    spoil, told = NO_RUNS[case]
    spoil(ours)
    before = sorted(tmp_path.rglob("*"))
    sentence = rf"^[^\n]*{told}[^\n]*\.$"
    for kind in ("ComputePSNR", "DatasetRender", "RunViewer"):
        options: dict = {"output_path": Path("scores.json"), "downscale_factor": None, "rendered_output_names": None}
        with pytest.raises(SystemExit, match=sentence):
            adapter._adapted(lambda self: pytest.fail("it was called"))(command(kind, ours, **options))
    if case != "stray file":  # which open_trained_run passes by
        with pytest.raises(InputError, match=sentence):
            open_trained_run(ours)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("case", ["no file", "empty", "no method", "no checkpoint"])
def test_what_is_no_run_is_one_sentence_in_commands_of_ours(ours, tmp_path, case):
    spoil, told = NO_RUNS[case]
    spoil(ours)
    before = sorted(tmp_path.rglob("*"))
    out = tmp_path / "out"
    for made in (ExportCommand(ours, out), RenderCommand(ours, out), ReportCommand(ours.parent)):
        with pytest.raises(InputError, match=rf"^[^\n]*{told}[^\n]*\.$"):
            made.main()
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("case", ["no file", "empty"])
def test_settings_given_to_ns_train_that_are_none_are_one_sentence(ours, case):
    NO_RUNS[case][0](ours)
    with pytest.raises(SystemExit, match=rf"^hsi-sc-nerf: [^\n]*{NO_RUNS[case][1]}[^\n]*\.$"):
        replace(hsi_sc_nerf.config, load_config=ours)


def test_scores_are_written_whole_or_not_at_all(ours, tmp_path, monkeypatch):
    made = command("ComputePSNR", with_checkpoint(ours), output_path=tmp_path / "scores.json")
    assert adapter.prepare(made) is True
    made.output_path.write_text("good", "utf8")
    assert made.output_path.read_text() == "good"
    assert made.output_path.suffix == ".json"

    def cut_short(self, text, *_):
        self.write_bytes(text[:2].encode())
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", cut_short)
    with pytest.raises(InputError, match="free some space"):
        made.output_path.write_text("better", "utf8")
    assert (tmp_path / "scores.json").read_text() == "good"
    assert list(tmp_path.glob(".*")) == []


@pytest.mark.parametrize(
    ("failure", "free_bytes", "refused"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), 10**9, True),
        (RuntimeError("Unexpected EOF"), 1000, True),  # a library that reads what another has not written
        (None, 1000, True),  # a library that does not tell
        (RuntimeError("Unexpected EOF"), 10**9, False),
        (None, 10**9, False),
    ],
)
def test_an_export_on_a_full_disk_is_one_sentence_and_leaves_nothing(
    ours, tmp_path, monkeypatch, failure, free_bytes, refused
):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("tsdf_mesh.ply", "notes.txt"):
        (out / name).write_text("earlier")
        os.utime(out / name, (0, 0))

    def export(self):
        (out / "poisson_mesh.ply").write_text("half")
        os.utime(out / "poisson_mesh.ply", (1, 1))  # by the clock of a network drive, which is behind
        if failure is not None:
            raise failure

    monkeypatch.setattr(shutil, "disk_usage", lambda path: types.SimpleNamespace(free=free_bytes))
    made = command("ExportTSDFMesh", with_checkpoint(ours), output_dir=out)
    if refused:
        with pytest.raises(SystemExit, match=r"^hsi-sc-nerf: [^\n]*out: [^\n]*disk is full[^\n]*\.$"):
            adapter._adapted(export)(made)
    elif failure is not None:
        with pytest.raises(RuntimeError, match="Unexpected EOF"):
            adapter._adapted(export)(made)
    else:
        adapter._adapted(export)(made)
    left = {"tsdf_mesh.ply", "notes.txt"} | (set() if refused else {"poisson_mesh.ply"})
    assert {path.name for path in out.iterdir()} == left


RENDERED = {"DatasetRender": ["views/1.jpg", "views/1.npy.gz"], "RenderInterpolated": ["views.mp4", "views/1.png"]}


@pytest.mark.parametrize("kind", RENDERED)
def test_a_render_on_a_full_disk_is_one_sentence_and_leaves_nothing_of_it(ours, tmp_path, kind):
    options: dict = {"rendered_output_names": ["rgb"], "downscale_factor": None, "pose_source": "train"}
    made = command(kind, with_checkpoint(ours), output_path=tmp_path / RENDERED[kind][0].split("/")[0], **options)
    before = [path for path in tmp_path.rglob("*") if path.is_file()]

    def render(self):
        (tmp_path / "views").mkdir()
        for name in RENDERED[kind]:
            (tmp_path / name).write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(SystemExit, match=r"^hsi-sc-nerf: [^\n]*the disk is full; free some space\.$"):
        adapter._adapted(render)(made)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == before


def test_poisson_estimates_normals_where_the_model_has_none(ours):
    made = command("ExportPoissonMesh", with_checkpoint(ours), normal_method="model_output")
    assert adapter.prepare(made) is True
    assert made.normal_method == "open3d"


def test_a_run_in_the_place_of_a_file_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(staged_trainer, "require_data", lambda data: None)
    config = copy.deepcopy(hsi_sc_nerf.config)
    config.output_dir, config.experiment_name, config.timestamp = tmp_path / "file", "x", "run"
    config.output_dir.write_text("months of work")
    with pytest.raises(SystemExit, match=r"^hsi-sc-nerf: [^\n]*cannot be created as a folder[^\n]*\.$"):
        config.save_config()
    assert config.output_dir.read_text() == "months of work"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("hsi_sc_nerf.models.stages.StageConfig", "hsi_sc_nerf.models.gone.StageConfig"),
        ("hsi_sc_nerf.models.stages.StageConfig", "hsi_sc_nerf.models.stages.Gone"),
        ("learn_after:", "learned_after:"),
        ("!!python/object", "[ !!python/object"),
    ],
)
def test_a_config_of_another_version_is_one_sentence(ours, old, new):
    text = ours.read_text()
    assert old in text
    ours.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=r"^[^\n]*config.yml: cannot be read[^\n]*\.$"):
        adapter.prepare(command("ComputePSNR", ours, output_path=Path("scores.json")))


def test_a_script_under_import_is_adapted_once_complete(ours, other, monkeypatch):
    calls = []
    monkeypatch.setattr(adapter, "_export_spectral_cloud", lambda options: calls.append("spectral"))
    name = "nerfstudio.scripts.exporter"
    module = types.ModuleType(name)
    monkeypatch.setitem(sys.modules, name, module)
    adapter.extend_nerfstudio_commands()
    assert not hasattr(module, "entrypoint")

    class ExportPointCloud:
        __module__ = name

        def main(self):
            calls.append("stock")

    vars(module).update(ExportPointCloud=ExportPointCloud, entrypoint=print)
    assert module.entrypoint is print
    assert type(module) is types.ModuleType
    made = ExportPointCloud()
    for made.load_config in (ours, other):
        made.main()
    assert calls == ["spectral", "stock"]
    made.load_config = ours.with_name("nowhere.yml")
    with pytest.raises(SystemExit, match=r"hsi-sc-nerf: .*there is no such file"):
        made.main()


def test_ctrl_c_is_one_line_for_our_runs_alone(ours, other, capsys, monkeypatch):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(signal, "signal", lambda *_: None)
    stopped = adapter._adapted(interrupted)
    with pytest.raises(SystemExit) as ended:
        stopped(command("ComputePSNR", with_checkpoint(ours), output_path=Path("scores.json")))
    assert ended.value.code == 130
    assert capsys.readouterr().err == "hsi-sc-nerf: stopped.\n"
    with pytest.raises(KeyboardInterrupt):
        stopped(command("ComputePSNR", other))


@pytest.mark.parametrize(
    ("cut_by", "told"),
    [(OSError(errno.ENOSPC, "No space left on device"), "free some space"), (SystemExit("x"), "x")],
)
def test_config_yml_is_written_whole_or_not_at_all(ours, monkeypatch, cut_by, told):
    before = ours.read_text()
    config = read_config(ours)
    config.max_num_iterations += 1

    def cut_short(self, text, **options):
        self.write_bytes(text[: len(text) // 2].encode())
        raise cut_by

    monkeypatch.setattr(staged_trainer, "require_data", lambda data: None)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", cut_short)
        with pytest.raises(SystemExit, match=told):
            config.save_config()
    assert ours.read_text() == before
    assert [path.name for path in ours.parent.iterdir() if path.is_file()] == ["config.yml"]
    config.save_config()
    assert read_config(ours) == config
