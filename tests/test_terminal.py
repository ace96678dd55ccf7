import os
import subprocess
import sys

import pytest

from hsi_sc_nerf.terminal import markdown_table

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
