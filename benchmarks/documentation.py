"""What `mkdocs build` makes from the code and from the CSV files of the benchmarks.

A page says ``{{ results("pose_hard_cases") }}`` where the table of ``benchmarks/results/pose_hard_cases.csv`` stands.
The pages on commands and settings are made from the code's own help texts.
"""

from __future__ import annotations

import ast
import csv
import dataclasses
import inspect
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

RESULTS = Path(__file__).parent / "results"
SOURCE_COLUMNS = ("commit", "seed", "machine")
_TABLE = re.compile(r'\{\{ results\("([a-z_]+)"\) \}\}')


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Put the results' tables into a page."""
    return _TABLE.sub(lambda match: results_table(match.group(1)), markdown)


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> Files:
    """Add the pages that are made from the code."""
    for name, content in (("commands", commands_page()), ("settings", settings_page())):
        files.append(File.generated(config, f"reference/{name}.md", content=content))
    return files


def results_table(name: str, folder: Path = RESULTS) -> str:
    """A results file as a Markdown table, and a line that says where its figures come from.

    Raises:
        PluginError: there is no such file, or it does not say where its figures come from.
    """
    path = folder / f"{name}.csv"
    if not path.is_file():
        raise PluginError(f"{path}: a page asks for this table, but there is no such file.")
    with path.open(encoding="utf-8", newline="") as file:
        columns, *rows = list(csv.reader(file))
    if tuple(columns[-len(SOURCE_COLUMNS) :]) != SOURCE_COLUMNS or not rows:
        raise PluginError(f"{path}: needs rows, and {', '.join(SOURCE_COLUMNS)} as its last columns.")
    shown = [columns, ["---"] * len(columns), *rows]
    lines = [f"| {' | '.join(cell.strip() for cell in row[: -len(SOURCE_COLUMNS)])} |" for row in shown]
    sources = {tuple(row[-len(SOURCE_COLUMNS) :]) for row in rows}
    told = "; ".join(f"commit {commit}, seed {seed}, {machine}" for commit, seed, machine in sorted(sources))
    return "\n".join([*lines, "", f"*`benchmarks/results/{name}.csv`: {told}.*"])


def commands_page() -> str:
    """The help texts of all commands."""
    parts = [
        "# Commands",
        "Each text is what the command's `--help` prints. `ns-train`, `ns-eval`, `ns-export` and `ns-viewer` are nerfstudio's.",
    ]
    for command in ("", *_command_names()):
        title = f"hsi-sc-nerf {command}".strip()
        words = [sys.executable, "-m", "hsi_sc_nerf.cli.main", *([command] if command else []), "--help"]
        text = _printed(words)
        parts.append(f"## `{title}`\n\n```text\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def _command_names() -> list[str]:
    """The commands, in the order in which the help lists them."""
    text = _printed([sys.executable, "-m", "hsi_sc_nerf.cli.main", "--help"])
    match = re.search(r"\{([a-z,]+)\}", text)
    if match is None:
        raise PluginError("hsi-sc-nerf --help lists no commands")
    return match.group(1).split(",")


def _printed(words: list[str]) -> str:
    result = subprocess.run(words, capture_output=True, text=True, env=_plain_terminal())
    if result.returncode != 0:
        raise PluginError(f"{' '.join(words)} failed: {result.stderr[-500:]}")
    return re.sub(r"\x1b\[[0-9;]*m", "", result.stdout).rstrip()


def _plain_terminal() -> dict[str, str]:
    return os.environ | {"COLUMNS": "110", "NO_COLOR": "1", "TERM": "dumb", "PYTHONWARNINGS": "ignore"}


def settings_page() -> str:
    """The settings of `ns-train hsi-sc-nerf` that this package adds or whose default it changes."""
    from hsi_sc_nerf.config import hsi_sc_nerf

    config = hsi_sc_nerf.config
    parts = [
        "# Training settings",
        "Settings of `ns-train hsi-sc-nerf` that this package defines. nerfstudio's own stand in `ns-train hsi-sc-nerf --help`.",
    ]
    groups = {
        "": config,
        "full-frame": config.full_frame,
        "masked": config.masked,
        "pipeline.datamanager": config.pipeline.datamanager,
        "pipeline.datamanager.dataparser": config.pipeline.datamanager.dataparser,
        "pipeline.model": config.pipeline.model,
        "pipeline.model.camera-optimizer": config.pipeline.model.camera_optimizer,
    }
    for prefix, settings in groups.items():
        rows = [
            f"| `--{f'{prefix}.' if prefix else ''}{name.replace('_', '-')}` | `{_short(getattr(settings, name))}` | {text} |"
            for name, text in documented_fields(type(settings)).items()
        ]
        if rows:
            title = f"`--{prefix}`" if prefix else "The run"
            parts += [f"## {title}", "\n".join(["| setting | default | meaning |", "| --- | --- | --- |", *rows])]
    return "\n\n".join(parts) + "\n"


def documented_fields(settings: type) -> dict[str, str]:
    """Fields that a dataclass itself defines, with the text below each."""
    body = ast.parse(textwrap.dedent(inspect.getsource(settings))).body[0]
    assert isinstance(body, ast.ClassDef)
    names = {field.name for field in dataclasses.fields(settings)}
    texts: dict[str, str] = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and field.target.id in names
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
        ):
            texts[field.target.id] = " ".join(str(text.value.value).split()).replace("|", "\\|")
    return texts


def _short(value: object) -> str:
    text = str(value).replace("|", "\\|")
    return text if len(text) < 60 else f"{text[:57]}..."
