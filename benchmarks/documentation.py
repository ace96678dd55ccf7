"""What `mkdocs build` makes from the code and from the CSV files of the benchmarks.

A page says ``{{ results("pose_hard_cases") }}`` where the table of ``benchmarks/results/pose_hard_cases.csv`` stands.
The pages on commands and settings are made from the code's own help texts.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import inspect
import io
import json
import os
import posixpath
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import griffe
import tyro
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from results_table import RESULTS, SOURCE_COLUMNS, read_results

from hsi_sc_nerf.cli.main import COMMANDS, command_line, named_commands
from hsi_sc_nerf.indices.catalogue import CATALOGUE
from hsi_sc_nerf.terminal import markdown_table

MADE_FROM = {
    "hsi_sc_nerf/cli/main.py": "reference/commands.md",
    "hsi_sc_nerf/config.py": "reference/settings.md",
    "hsi_sc_nerf/indices/catalogue.py": "reference/indices.md",
}
"""Pages of the site that no file of the repository holds, by the source that they are made from."""
TABLE = re.compile(r'\{\{ results\("([a-z_]+)"\) \}\}')


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Put the results' tables into a page, and let its links lead to the pages that are made from the code."""
    return site_links(TABLE.sub(lambda match: results_table(match.group(1)), markdown), page.file.src_uri)


class ExamplesAsCode(griffe.Extension):
    """Let mkdocstrings show the examples of docstrings as code: it knows their section as ``Examples`` alone."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rename the section of one object's docstring."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"^( *)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)


def site_links(markdown: str, uri: str) -> str:
    """Links of a page to sources and notebooks, which work where only the repository is, as links of the site.

    Example:
        >>> site_links("[catalogue](../../hsi_sc_nerf/indices/catalogue.py)", "how-to/viewer.md")
        '[catalogue](../reference/indices.md)'
    """
    folder = posixpath.dirname(uri)

    def of_site(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join("docs", folder, match.group(1)))
        made = MADE_FROM.get(target) or re.sub(r"^docs/(notebooks/.*)\.ipynb$", r"\1.md", target)
        if made in (target, uri):
            return match.group()
        return f"]({posixpath.relpath(made, folder or '.')})"

    return re.sub(r"\]\(([^)#:]+)\)", of_site, markdown)


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> Files:
    """Add the pages that are made from the code."""
    pages = {"commands": commands_page(), "settings": settings_page(), "indices": indices_page()}
    for name, content in pages.items():
        files.append(File.generated(config, f"reference/{name}.md", content=content))
    for path in sorted((Path(config.docs_dir) / "notebooks").glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=notebook_page(path)))
    return files


def notebook_page(path: Path) -> str:
    """The cells of a notebook, and behind the first one a link to the file."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    texts = [(cell["cell_type"], "".join(cell["source"])) for cell in cells]
    parts = [text if kind == "markdown" else f"```python\n{text}\n```" for kind, text in texts]
    parts.insert(1, f"Download [{path.name}]({path.name}) to open it as a notebook.")
    return "\n\n".join(parts) + "\n"


def results_table(name: str, folder: Path = RESULTS) -> str:
    """A results file as a Markdown table, and a line that says where its figures come from.

    Raises:
        PluginError: there is no such file, or it does not say where its figures come from.
    """
    path = folder / f"{name}.csv"
    if not path.is_file():
        raise PluginError(f"{path}: a page asks for this table, but there is no such file.")
    columns, *rows = read_results(path)
    if tuple(columns[-len(SOURCE_COLUMNS) :]) != SOURCE_COLUMNS or not rows:
        raise PluginError(f"{path}: needs rows, and {', '.join(SOURCE_COLUMNS)} as its last columns.")
    shown = [[cell.strip() for cell in row[: -len(SOURCE_COLUMNS)]] for row in (columns, *rows)]
    sources = {tuple(row[-len(SOURCE_COLUMNS) :]) for row in rows}
    origin = "; ".join(f"commit {commit}, seed {seed}, {machine}" for commit, seed, machine in sorted(sources))
    return "\n".join([markdown_table(shown[0], shown[1:]), "", f"*`benchmarks/results/{name}.csv`: {origin}.*"])


def readme_table(folder: Path = RESULTS) -> str:
    """The README's table: held-out views by the published method and by ours; the paper's figures."""
    titles = ["object", "method", "SAM, rad", "RMSE", "SSIM", "PSNR, dB", "F-score of what is seen at 2 mm, %"]
    methods = {
        "paper, its own fruit": "printed in the paper, real fruit",
        "paper": "published method, 10 minutes",
        "ours": "ours, 2 minutes",
    }
    rows = read_results(folder / "beyond_the_paper.csv")
    shown = [[row[0], methods[row[1]], *row[3:7], row[11]] for row in rows if row[1] in methods]
    return markdown_table(titles, sorted(shown, key=lambda row: row[0]))


def indices_page() -> str:
    """The catalogue of indices."""
    intro = (
        "R800 is the reflectance at 800 nm. All are numbers without a unit. The range is that of the colours in the "
        "viewer, in videos and in the report. [Map indices](../how-to/indices.md) says how to use them."
    )
    rows = [
        [one.name, f"`{one.expression}`", "{:g} to {:g}".format(*one.drawn_range), one.tells, one.reference]
        for one in CATALOGUE.values()
    ]
    table = markdown_table(["index", "formula", "range drawn", "follows", "source"], rows)
    return "\n\n".join(["# Indices", intro, table]) + "\n"


def commands_page() -> str:
    """The help texts of all commands."""
    parts = [
        "# Commands",
        "Each text is what the command's `--help` prints. The commands `ns-...` are nerfstudio's.",
    ]
    for command in ("", *command_names()):
        title = f"hsi-sc-nerf {command}".strip()
        parts.append(f"## `{title}`\n\n```text\n{help_text(command)}\n```")
    return "\n\n".join(parts) + "\n"


def command_names() -> list[str]:
    """The commands, in the order in which the help lists them."""
    return list(COMMANDS)


def help_text(command: str) -> str:
    """What ``hsi-sc-nerf COMMAND --help`` prints, 110 characters wide and without colours."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit), _plain_terminal():
        words = [*([command] if command else []), "--help"]
        tyro.cli(command_line(named_commands(words)), prog="hsi-sc-nerf", args=words)
    return re.sub(r"\x1b\[[0-9;]*m", "", printed.getvalue()).rstrip()


@contextlib.contextmanager
def _plain_terminal() -> Iterator[None]:
    before = dict(os.environ)
    os.environ.update(COLUMNS="110", NO_COLOR="1", TERM="dumb")
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def settings_page() -> str:
    """The settings of `ns-train hsi-sc-nerf` that this package adds or whose default it changes."""
    from hsi_sc_nerf.config import hsi_sc_nerf

    config = hsi_sc_nerf.config
    parts = [
        "# Training settings",
        "Settings of `ns-train hsi-sc-nerf` that this package defines; its `--help` lists nerfstudio's as well.",
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
        dotted = f"{prefix}." if prefix else ""
        rows = [
            [f"`--{dotted}{name.replace('_', '-')}`", f"`{_short(getattr(settings, name))}`", text]
            for name, text in documented_fields(type(settings)).items()
        ]
        if rows:
            title = f"`--{prefix}`" if prefix else "The run"
            parts += [f"## {title}", markdown_table(["setting", "default", "meaning"], rows)]
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
