"""What pages and docstrings show works: Python blocks and examples run, command lines are parsed."""

import ast
import builtins
import doctest
import re
import shlex
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from random_cloud import random_cloud

import hsi_sc_nerf as hsn
from hsi_sc_nerf.analysis.drawn_regions import DrawnRegion
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.cli.main import command_line
from hsi_sc_nerf.export.cloud import read_spectral_ply, stream
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
    try:
        parse(shlex.split(line, comments=True)[1:])
    except SystemExit as stop:
        if stop.code != 0:  # not --help
            pytest.fail(f"{page}: {line}\n{capsys.readouterr().err}")


def test_our_command_lines_parse(capsys: pytest.CaptureFixture) -> None:
    parse = partial(tyro.cli, command_line())
    ours = [(page, line) for page, line in command_lines() if line.startswith("hsi-sc-nerf")]
    assert len(ours) > 20
    for page, line in ours:
        # The words that `batch` does not know are Snakemake's.
        batch = line.split()[1] == "batch"
        assert_parses(page, line, partial(lambda b, words: parse(args=words, return_unknown_args=b), batch), capsys)
    with pytest.raises(pytest.fail.Exception, match="no-such-option"):
        assert_parses("page", "hsi-sc-nerf demo --no-such-option", lambda words: parse(args=words), capsys)


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


# Calls of the page's table that need a trained run, or take long.
NOT_CALLED = re.compile(
    r"\.\.\.|simulate_session|process_session|open_run|^run\.|view\.|traits\(|propose|light=|calibration"
)


@pytest.mark.slow
def test_calls_in_the_table_of_the_python_page_run(folder: Path, tiny_dataset: tuple[Path, Path]) -> None:
    pytest.importorskip("laspy")
    data, session = tiny_dataset
    (folder / "DATA").symlink_to(data)
    (folder / "SESSION").symlink_to(session)
    cloud, regions = (
        hsn.read_cloud("point_cloud.ply"),
        [DrawnRegion("top", np.zeros((2, 3)), np.array([True, False]))],
    )
    library = SpectralLibrary(("ripe",), cloud.wavelengths_nm, cloud.spectra[:1])
    known = {"np": np, "hsn": hsn, "Path": Path, "cloud": cloud, "table": cloud.to_xarray()}
    known |= {"library": library, "regions": regions}
    hsn.write_library("skin.sli", library)
    hsn.write_drawn_regions("regions.json", regions)
    rows = [line.split("|") for line in PAGES["docs/how-to/python.md"].read_text("utf-8").splitlines()]
    calls = [call for row in rows if len(row) == 5 for call in re.findall(r"`([\w.]+\(.*?\))`", row[1])]
    called = [call for call in calls if not NOT_CALLED.search(call)]
    assert len(called) > 10
    for call in called:
        assert eval(call, dict(known)) is not None or ".write_" in call, call


@pytest.mark.parametrize(
    "name",
    [
        "analysis.calibrations.read_calibration",
        "analysis.change_regions.grown_regions",
        "analysis.change_regions.limit_of_blank_m2",
        "analysis.change_significance.significance",
        "analysis.drawn_regions.write_drawn_regions",
        "analysis.library.read_library",
        "analysis.library.write_library",
        "analysis.maps.propagated_std",
        "analysis.preprocessing.preprocessed",
        "api.clouds.read_cloud",
        "evaluation.comparison.read_reference",
        "evaluation.spectral_metrics.spectral_metrics",
        "evaluation.spatial.precision_recall_f_score",
        "export.cloud.comment_lines",
        "export.cloud.read_spectral_ply",
        "export.cloud.write_spectral_ply",
        "export.formats.write_cloud",
        "export.options.select_bands",
        "export.table.from_xarray",
        "export.table.to_xarray",
        "fields.hash_grid.grid_for_resolution",
        "findings.refuse_red",
        "geometry.mesh.Mesh",
        "indices.catalogue.find_indices",
        "indices.formula.index_values",
        "models.losses.hsi_loss",
        "models.schedule.Schedule",
        "numerics.spectral_angle",
        "robust_scatter.robust_std",
        "robust_scatter.tukey_weights",
        "spectra.composite",
        "surface.surface_depth.opacity_crossing_depth",
    ],
)
def test_examples_of_docstrings_hold(name: str, folder: Path) -> None:
    module, _, attribute = name.rpartition(".")
    namespace = vars(import_module(f"hsi_sc_nerf.{module}"))
    context = {"np": np, "torch": torch, "Path": Path, "stream": stream, "read_spectral_ply": read_spectral_ply}
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(namespace[attribute], name, globs=context | namespace)
    results = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example)
    assert results.attempted > 0
    assert results.failed == 0


@pytest.mark.slow
def test_every_function_that_an_example_calls_exists() -> None:
    """Examples that need a trained run or a session are not run; what they call must be there all the same."""
    texts = {path: path.read_text(encoding="utf-8") for path in (ROOT / "hsi_sc_nerf").rglob("*.py")}
    modules = {path: ast.parse(text) for path, text in texts.items()}
    known = {name for module in modules.values() for node in module.body for name in defined_names(node)}
    known |= {*vars(builtins), "Path"}
    found = 0
    shown = {path: module for path, module in modules.items() if ">>>" in texts[path]}
    for path, node in ((path, node) for path, module in shown.items() for node in ast.walk(module)):
        is_documented = isinstance(node, (ast.FunctionDef, ast.ClassDef, ast.Module))
        if is_documented and ">>>" in (docstring := ast.get_docstring(node, clean=False) or ""):
            steps = doctest.DocTestParser().get_examples(docstring)
            example = list(ast.walk(ast.parse("".join(step.source for step in steps))))
            called = {
                node.func.id for node in example if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
            }
            own = {node.id for node in example if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
            unknown = called - own - known
            assert not unknown, f"{path.relative_to(ROOT)}: an example calls {unknown}"
            found += bool(steps)
    assert found > 30


def defined_names(node: ast.stmt) -> list[str]:
    """Names that a statement at the top of a module defines; those from other packages too."""
    if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
        return [node.name]
    if isinstance(node, (ast.Import, ast.ImportFrom)):
        ours = isinstance(node, ast.ImportFrom) and (node.module or "").startswith("hsi_sc_nerf")
        return [] if ours else [alias.asname or alias.name for alias in node.names]
    return [name.id for name in ast.walk(node) if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)]
