"""The R code of the documentation reads what this package writes, and R's figures are those of Python."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from batch_folder import write_season
from random_cloud import random_cloud

from hsi_sc_nerf.analysis.library import SpectralLibrary, write_library
from hsi_sc_nerf.batch.tables import read_table, write_tables
from hsi_sc_nerf.export.cloud import write_spectral_ply

PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "r.md"
TOLD = """
cat("\\nTOLD", nrow(done), done$volume_ml[6], known$spectra[2, "top; left"], known$nm[2], nrow(cloud), cloud$ndvi[7],
    cloud$red[7], cloud$z[7], cloud$views[7])
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("Rscript") is None, reason="R is not installed")
def test_r_reads_tables_libraries_and_clouds(tmp_path):
    write_season(tmp_path, 7)
    table = read_table(tmp_path)
    write_tables(table, tmp_path)
    nm = np.linspace(400.0, 1000.0, 61)
    library = SpectralLibrary(("whole surface", "top; left"), nm, np.random.default_rng(0).random((2, 61)))
    write_library(tmp_path / "regions.sli", library)
    cloud = random_cloud(40, nm)
    write_spectral_ply(tmp_path / "point_cloud.ply", cloud)
    blocks = re.findall(r"^```r\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 3
    (tmp_path / "page.R").write_text("\n".join(blocks) + TOLD, encoding="utf-8")
    done = subprocess.run(["Rscript", "page.R"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    red, infrared = (cloud.spectra[6, np.abs(nm - wanted).argmin()] for wanted in (670.0, 800.0))
    expected = [6, 400.0, library.spectra[1, 1], nm[1], 40, (infrared - red) / (infrared + red)]
    expected += [cloud.colours[6, 0], cloud.points[6, 2], cloud.extra["views"][6]]
    told = done.stdout.split("TOLD")[1].split()
    np.testing.assert_allclose([float(word) for word in told], expected, rtol=1e-4)
