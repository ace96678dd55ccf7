"""The names of the package: all there, imported when they are used."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import hsi_sc_nerf
from hsi_sc_nerf.cli.main import COMMANDS


@pytest.mark.slow
def test_every_name_is_documented_and_found():
    for name in hsi_sc_nerf._API:
        assert name in dir(hsi_sc_nerf)
        assert inspect.getdoc(getattr(hsi_sc_nerf, name))
    with pytest.raises(AttributeError, match="no attribute 'open_pear'"):
        _ = hsi_sc_nerf.open_pear


@pytest.mark.slow
def test_the_package_is_imported_without_what_it_names():
    program = "import sys, hsi_sc_nerf; print([name for name in sys.modules if name.startswith('hsi') or name in "
    program += "('numpy', 'torch')])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['hsi_sc_nerf']"


def test_the_page_has_a_function_for_each_command_that_is_more_than_a_sequence_of_others():
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "python.md").read_text(encoding="utf-8")
    rows = [line.split("|") for line in page.splitlines() if line.startswith("| `")]
    for _, function, _, command, _ in rows:
        if command.strip():
            names = re.findall(r"hsn\.(\w+)", function)
            assert set(names) <= set(hsi_sc_nerf._API)
    named = {word for row in rows for word in re.findall(r"`(\w+)", row[3])}
    assert set(COMMANDS) - {"run", "batch", "demo", "benchmark", "markers"} <= named
