"""What the pages and docstrings show runs: Python blocks and examples in a small folder, command lines up to parsing."""

from __future__ import annotations

import doctest
import re
import shlex
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import tyro
from random_cloud import random_cloud

from hsi_sc_nerf.cli.main import Commands
from hsi_sc_nerf.export.cloud import stream
from hsi_sc_nerf.export.formats import write_cloud

ROOT = Path(__file__).parents[1]
PAGES = {page.relative_to(ROOT).as_posix(): page for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]}
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?:uv run )?((?:hsi-sc-nerf|ns-[a-z]+)\b.*)")


def blocks(language: str) -> list[tuple[str, str]]:
    """Page and text of each fenced block of a language."""
    return [
        (name, text)
        for name, page in sorted(PAGES.items())
        for found, text in BLOCK.findall(page.read_text(encoding="utf-8"))
        if found == language
    ]


def command_lines() -> list[tuple[str, str]]:
    """Page and text of each command line of ours or of nerfstudio's, continued lines joined."""
    lines = [(name, line) for name, text in blocks("") for line in text.replace("\\\n", " ").splitlines()]
    return [(name, match.group(1)) for name, line in lines if (match := COMMAND.match(line.strip()))]


def nerfstudio_parsers() -> dict[str, Callable[[list[str]], object]]:
    """What each of nerfstudio's commands parses its words with; training knows our methods only."""
    from nerfstudio.scripts import eval as ns_eval
    from nerfstudio.scripts import exporter, render
    from nerfstudio.scripts.viewer.run_viewer import RunViewer

    from hsi_sc_nerf import config

    methods = {"hsi-sc-nerf": config.hsi_sc_nerf.config, "hsi-sc-nerf-paper": config.hsi_sc_nerf_paper.config}
    kinds = {
        "ns-train": tyro.conf.FlagConversionOff[tyro.extras.subcommand_type_from_defaults(methods)],
        "ns-eval": ns_eval.ComputePSNR,
        "ns-export": exporter.Commands,
        "ns-render": render.Commands,
        "ns-viewer": tyro.conf.FlagConversionOff[RunViewer],
    }
    return {name: lambda words, kind=kind: tyro.cli(kind, args=words) for name, kind in kinds.items()}


def assert_parses(page: str, line: str, parse: Callable[[list[str]], object], capsys: pytest.CaptureFixture) -> None:
    words = shlex.split(line, comments=True)[1:]
    try:
        parse(words)
    except SystemExit as stop:
        assert stop.code == 0, f"{page}: {line}\n{capsys.readouterr().err}"  # --help


def test_our_command_lines_parse(capsys: pytest.CaptureFixture) -> None:
    ours = [(page, line) for page, line in command_lines() if line.startswith("hsi-sc-nerf")]
    assert len(ours) > 20
    for page, line in ours:
        assert_parses(page, line, lambda words: tyro.cli(Commands, args=words), capsys)
    with pytest.raises(AssertionError, match="--no-such-option"):
        assert_parses(
            "page", "hsi-sc-nerf demo --no-such-option", lambda words: tyro.cli(Commands, args=words), capsys
        )


@pytest.mark.slow
def test_nerfstudios_command_lines_parse(capsys: pytest.CaptureFixture) -> None:
    parsers = nerfstudio_parsers()
    theirs = [(page, line) for page, line in command_lines() if line.startswith("ns-")]
    assert len(theirs) > 8
    for page, line in theirs:
        assert_parses(page, line, parsers[line.split()[0]], capsys)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with the files that snippets name."""
    pytest.importorskip("h5netcdf")
    cloud = random_cloud(30, np.linspace(397.32, 1003.58, 204))
    for file_format in ("ply", "netcdf"):
        write_cloud(tmp_path / "point_cloud", stream(cloud), file_format)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("page", "text"), blocks("python"), ids=lambda value: value.splitlines()[0])
def test_python_blocks_run(page: str, text: str, folder: Path) -> None:
    exec(compile(text, page, "exec"), {})


EXAMPLES = []


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_of_docstrings_hold(name: str, folder: Path) -> None:
    module, _, attribute = name.rpartition(".")
    namespace = import_module(f"hsi_sc_nerf.{module}").__dict__ | {"np": np, "Path": Path}
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(namespace[attribute], name, globs=namespace)
    results = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE).run(example)
    assert results.attempted > 0
    assert results.failed == 0
