"""The names of the package: all there, imported when they are used."""

import inspect
import subprocess
import sys

import pytest

import hsi_sc_nerf


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
