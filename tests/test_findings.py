"""What users are told: messages of errors, findings, tables, and none of the libraries' warnings."""

import os
import shlex
import subprocess
import sys

import pytest

from hsi_sc_nerf.errors import LONGEST_MESSAGE, InputError, shown
from hsi_sc_nerf.findings import Finding, leave_out, refuse_red
from hsi_sc_nerf.terminal import markdown_table


def test_a_message_stays_one_line_of_bounded_length():
    told = str(InputError(f"/data/a\n\x1b[31mb\u2028.hdr: is {'x' * 10_000}; export it \ud800again."))
    assert len(told) <= LONGEST_MESSAGE
    assert told.isprintable()
    assert told.startswith("/data/a ?[31mb .hdr: is xxx")
    assert told.endswith("xxx; export it ?again.")


def test_values_of_damaged_files_are_shown_in_short():
    # As a parameter, the number would be written by pytest, which Python refuses.
    for value in ("a" * 10_000, [[["a"] * 1000] * 1000] * 1000, 1 << 20_000, {"a": {"b": {"c": 1}}}):
        assert len(shown(value)) < 300


FINDINGS = [Finding("white", "red", "No white."), Finding("turn", "amber", "A gap."), Finding("dates", "red", "Old.")]


def test_all_red_findings_are_named_at_once() -> None:
    with pytest.raises(InputError, match=r"No white\. Old\..*--accept white --accept dates"):
        refuse_red(FINDINGS)


def test_accepted_findings_stop_nothing() -> None:
    refuse_red(FINDINGS, accepted=["white", "dates"])
    with pytest.raises(InputError, match=r"^No white"):
        refuse_red(FINDINGS, accepted=["dates"])


def test_options_that_leave_captures_out_can_be_copied_to_a_shell() -> None:
    assert leave_out(["apple_01", "apple_02"]) == "--exclude apple_01 --exclude apple_02"
    names = ["apple 1", "o'clock", "a;b"]
    assert shlex.split(leave_out(names))[1::2] == names


DOCUMENTED = "ignore::FutureWarning:torch.jit._script"
"""PYTHONWARNINGS of docs/how-to/nerfstudio_commands.md."""


@pytest.mark.slow
@pytest.mark.parametrize(("script", "hidden"), [("train", ""), ("exporter", DOCUMENTED)])
def test_libraries_do_not_warn_before_our_first_line(script, hidden):
    """All but one warning, which comes before nerfstudio looks for its plugins."""
    starting = [sys.executable, "-c", f"from nerfstudio.scripts.{script} import entrypoint"]
    started = subprocess.run(
        starting, env=os.environ | {"PYTHONWARNINGS": hidden}, capture_output=True, text=True, check=True
    )
    warnings = [line for line in started.stderr.splitlines() if "Warning: " in line]
    assert len(warnings) == (not hidden)
    assert all("torch.jit.script" in line for line in warnings)


def test_names_from_files_make_no_cells_links_or_html():
    table = markdown_table(["name"], [["a|b"], ["<img src=x>"], ["[x](http://y)"], ["two\nlines"]])
    assert table.splitlines()[2:] == ["| a\\|b |", "| &lt;img src=x> |", "| \\[x](http://y) |", "| two lines |"]
