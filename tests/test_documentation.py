"""The pages agree with the code and with the files that their figures come from."""

import re
import sys
from pathlib import Path

import pytest

from hsi_sc_nerf.inspection.capture_checks import ACCURACY_BY_VIEWS

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))
documentation = pytest.importorskip("documentation", reason="the documentation's packages are not installed")

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMANDS = documentation.command_names()
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")
"""Relative ones."""


def test_every_committed_table_is_shown_on_a_page():
    tables = {name for page in PAGES for name in documentation.TABLE.findall(page.read_text(encoding="utf-8"))}
    assert tables == {path.stem for path in documentation.RESULTS.glob("*.csv")}


def test_a_table_without_sources_is_refused(tmp_path):
    (tmp_path / "table.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    with pytest.raises(documentation.PluginError, match="commit"):
        documentation.results_table("table", tmp_path)
    with pytest.raises(documentation.PluginError, match="no such file"):
        documentation.results_table("missing", tmp_path)


def test_the_readme_shows_the_committed_results():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    between = readme.split("<!-- results -->\n")[1].split("\n<!-- end of results -->")[0]
    assert between == documentation.readme_table()
    assert len(readme.splitlines()) <= 120


def test_links_of_pages_lead_to_files_of_the_repository_and_to_pages_of_the_site():
    """On a forge there is the repository alone; the site has the pages that are made from the code."""
    made = set(documentation.MADE_FROM.values()) | {
        f"notebooks/{path.stem}.md" for path in (ROOT / "docs" / "notebooks").glob("*.ipynb")
    }
    lead_to_made = set()
    for page in PAGES:
        text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        for target in LINK.findall(text):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
        if page.parent != ROOT:
            uri = page.relative_to(ROOT / "docs")
            for target in LINK.findall(documentation.site_links(text, uri.as_posix())):
                found = (page.parent / target).resolve().relative_to(ROOT).as_posix().removeprefix("docs/")
                assert found in made or (ROOT / "docs" / found).exists(), f"{page.name}: {target}"
                lead_to_made |= made & {found}
    assert lead_to_made == made


def test_every_option_in_a_page_exists():
    """Options beside `hsi-sc-nerf COMMAND` are options of that command."""
    found = 0
    helps = {command: documentation.help_text(command) for command in COMMANDS}
    for page in PAGES:
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        for command, words in re.findall(r"hsi-sc-nerf ([a-z]+) ([^\n`#]*)", text):
            if command not in helps:
                continue
            ours = re.split("--common|--sets|--executor", words)[0]
            for option in re.findall(r"(?<!\S)(--[a-z][a-z0-9.-]*)", ours):
                found += 1
                assert option in helps[command], f"{page.name}: {command} has no {option}"
    assert found > 20


def test_every_setting_of_training_in_a_page_exists():
    settings = documentation.settings_page()
    inherited = ("max-res", "train-num-rays-per-batch")
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for option in re.findall(r"--(?:pipeline|full-frame|masked)\.[a-z0-9.-]+[a-z0-9]", text):
            assert f"`{option}`" in settings or option.endswith(inherited), f"{page.name}: {option}"


def test_every_hard_case_says_what_happens_and_names_a_test():
    cases, of_functions = 0, False
    for line in (ROOT / "docs" / "validation" / "hard_cases.md").read_text(encoding="utf-8").splitlines():
        of_functions = line.startswith("|") and (of_functions or line.startswith("| function "))
        if line.startswith("|") and not of_functions and not re.match(r"\| (case|---) ", line):
            cases += 1
            case, happens, tests = (cell.strip() for cell in line.strip("|").split(" | "))
            assert case, line
            assert happens, line
            assert re.fullmatch(r"`[a-z_/]+::test_\w+`(, `[a-z_/]+::test_\w+`)*", tests), line
    assert cases > 60


def test_every_test_that_a_page_names_is_there():
    named = {
        found for page in PAGES for found in re.findall(r"`([a-z_/]+)::(test_\w+)`", page.read_text(encoding="utf-8"))
    }
    assert len(named) > 100
    for module, name in named:
        assert f"def {name}(" in (ROOT / "tests" / f"{module}.py").read_text(encoding="utf-8"), (module, name)


def test_every_function_of_a_training_step_names_a_test_of_each_kind():
    page = (ROOT / "docs" / "validation" / "hard_cases.md").read_text(encoding="utf-8")
    _, rows = page.split("### Every function of a training step")[1].split("| --- | --- | --- | --- | --- |\n")
    letters = set(re.findall(r"^- (\w): `[a-z_/]+::test_\w+`$", rows, re.MULTILINE))
    table = [line.strip("| ").split(" | ") for line in rows.split("\n\n")[0].splitlines()]
    named = {name for _, *cells in table for cell in cells for name in cell.split(", ")}
    assert all(len(cells) == 5 for cells in table)
    assert named - {"none", "float32"} == letters
    assert len(table) > 15


def test_inspect_quotes_the_committed_figures_of_views():
    titles, *rows = documentation.read_results(documentation.RESULTS / "accuracy_and_time.csv")
    columns = [titles.index(title) for title in (" RMSE", "F at 0.5 mm, %", "volume, %", "bruise, %")]
    for part, name, *_ in rows:
        if part == "views":
            (row,) = (row for row in rows if row[:2] == [part, name])
            measured = [float(row[column].split()[0]) for column in columns]
            quoted = ACCURACY_BY_VIEWS[int(name.split()[0])]
            volume, bruise = map(abs, measured[2:])
            assert quoted == (round(100.0 * measured[0], 1), round(measured[1]), round(volume, 1), round(bruise))


@pytest.mark.parametrize("page", ["README.md", "docs/validation/accuracy_and_time.md"])
def test_the_errors_of_the_presets_in_a_page_are_the_committed_ones(page):
    titles, *rows = documentation.read_results(documentation.RESULTS / "accuracy_and_time.csv")
    columns = [titles.index(title) for title in ("without the noise: SAM", " RMSE")]
    texts = (ROOT / page).read_text(encoding="utf-8").split("\n\n")
    words = ("fast`", "`balanced`", "`best`", "SAM")
    (paragraph,) = (text for text in texts if all(word in text for word in words))
    measured = {row[column].split()[0] for row in rows if row[0] == "presets" for column in columns}
    # SAM of a run of minutes is between 0.005 and 0.02 rad; other figures of the paragraph have fewer digits.
    assert {*re.findall(r"0\.0[01]\d\d", paragraph)} == measured


def test_examples_of_docstrings_are_shown_as_code():
    griffe = documentation.griffe
    text = "What it does.\n\nArgs:\n    one: a number.\n\nExample:\n    >>> one(1)\n    1"
    function = griffe.Function("one", docstring=griffe.Docstring(text))
    documentation.ExamplesAsCode().on_object(obj=function)
    kinds = [section.kind.value for section in griffe.parse_google(function.docstring)]
    assert kinds == ["text", "parameters", "examples"]


def test_warnings_of_the_site_end_ci():
    """mkdocs counts only the warnings that it prints."""
    command = re.search(r"mkdocs build.*", (ROOT / ".ci" / "run").read_text(encoding="utf-8"))
    assert command is not None
    assert "quiet" not in command.group()
    assert "\nstrict: true\n" in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
