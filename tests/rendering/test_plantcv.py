"""PlantCV reads a rendered view as its `Spectral_data`; its index is ours.

PlantCV asks for an older SciPy than this package, so that it has an environment of its own: `PLANTCV_PYTHON` names
its interpreter, where this one cannot import it. benchmarks/plantcv_views.py makes the table of the docs.
"""

import os
import subprocess
import sys
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest

from hsi_sc_nerf.indices.catalogue import CATALOGUE
from hsi_sc_nerf.indices.formula import index_values
from hsi_sc_nerf.rendering.views import write_cube_of_view

PYTHON = sys.executable if find_spec("plantcv") else os.environ.get("PLANTCV_PYTHON")
OURS = {
    "ndvi": "NDVI",
    "pri": "PRI",
    "wi": "WI",
    "ari": "ARI1",
    "cri550": "CRI1",
    "cri700": "CRI2",
    "mcari": "MCARI",
    "mtci": "MTCI",
    "ndre": "NDRE",
    "npci": "NPCI",
    "psri": "PSRI",
    "pssr_chla": "PSSRa",
    "pssr_chlb": "PSSRb",
    "pssr_car": "PSSRc",
}
"""Names of PlantCV's indices at our wavelengths."""
READ = """
import sys
import numpy as np
from plantcv import plantcv as pcv
found = pcv.readimage(sys.argv[1], mode="envi")
indices = {name: getattr(pcv.spectral_index, name)(found, distance=20).array_data for name in sys.argv[3:]}
about = {"kind": type(found).__name__, "lines": found.lines, "units": found.wavelength_units}
np.savez(sys.argv[2], cube=found.array_data, nm=sorted(found.wavelength_dict), **about, **indices)
"""


@pytest.mark.slow
@pytest.mark.skipif(
    PYTHON is None, reason="PlantCV needs an environment of its own: set PLANTCV_PYTHON to its interpreter"
)
def test_plantcv_reads_a_view_with_its_wavelengths_and_finds_our_indices(tmp_path):
    nm = np.arange(400.0, 1001.0)
    cube = np.random.default_rng(0).uniform(0.05, 0.9, (6, 8, len(nm))).astype(np.float32)
    dataset = SimpleNamespace(
        object_name="pear", wavelengths_nm=nm, pseudo_rgb_nm=(600.0, 550.0, 450.0), fwhm_nm=None
    )
    write_cube_of_view(tmp_path, "view", cube, dataset, "float32")
    subprocess.run([PYTHON, "-c", READ, tmp_path / "view.raw", tmp_path / "found.npz", *OURS], check=True)
    with np.load(tmp_path / "found.npz") as found:
        assert (str(found["kind"]), int(found["lines"]), str(found["units"])) == ("Spectral_data", 6, "nm")
        np.testing.assert_allclose(found["nm"], nm, atol=0.005)
        np.testing.assert_array_equal(found["cube"], cube)
        for theirs, ours in OURS.items():
            expected = index_values(CATALOGUE[ours], cube.astype(float), nm)
            np.testing.assert_allclose(found[theirs], expected, rtol=1e-4, atol=1e-5)
