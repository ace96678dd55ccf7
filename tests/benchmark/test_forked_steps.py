"""Steps in forks end as processes of their own would, and leave nothing in the process that runs them."""

import sys
import warnings

import pytest

from hsi_sc_nerf.benchmark.forked_steps import ForkedSteps
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate.truth import load_truth

SMALL = ("--frames", "1", "--size", "16", "--bands", "3")


def test_a_command_leaves_its_files_its_log_and_nothing_else(tmp_path, capfd):
    words = [
        "hsi-sc-nerf",
        "simulate",
        "sphere",
        tmp_path / "session",
        "--frames",
        "1",
        "--size",
        "16",
        "--bands",
        "3",
    ]
    before = list(sys.argv), list(warnings.filters), set(sys.modules)
    cost = ForkedSteps().run("simulate", words, tmp_path / "simulate.log")
    assert load_truth(tmp_path / "session").captures == ("sphere_000",)
    assert "1 frames of 16 x 16" in " ".join((tmp_path / "simulate.log").read_text().split())
    assert capfd.readouterr().out == ""
    assert (list(sys.argv), list(warnings.filters), set(sys.modules)) == before
    assert cost.name == "simulate"
    assert cost.peak_memory_mib > 10.0


def test_what_is_imported_meanwhile_is_there_for_the_next_step(tmp_path):
    words = [
        "hsi-sc-nerf",
        "simulate",
        "sphere",
        tmp_path / "session",
        "--frames",
        "1",
        "--size",
        "16",
        "--bands",
        "3",
    ]
    sys.modules.pop("this", None)
    ForkedSteps().run("simulate", words, tmp_path / "simulate.log", meanwhile=["this"])
    assert "this" in sys.modules


def test_a_command_that_fails_is_named_with_its_log_and_told_on_the_terminal(tmp_path, capfd):
    words = ["hsi-sc-nerf", "simulate", "banana", tmp_path / "session"]
    with pytest.raises(InputError, match=r"'simulate' failed with status 2.*simulate\.log"):
        ForkedSteps().run("simulate", words, tmp_path / "simulate.log")
    assert "banana" in capfd.readouterr().err
    assert not (tmp_path / "session").exists()


@pytest.mark.slow
def test_nerfstudios_commands_are_extended_though_the_plugins_were_there_before(tmp_path, capfd):
    import nerfstudio.scripts.train  # noqa: F401  imports the plugins

    words = ["ns-export", "pointcloud", "--load-config", tmp_path / "no.yml", "--output-dir", tmp_path]
    with pytest.raises(InputError, match="'export' failed with status 1"):
        ForkedSteps().run("export", words, tmp_path / "export.log")
    assert "no.yml: there is no such file" in capfd.readouterr().err
