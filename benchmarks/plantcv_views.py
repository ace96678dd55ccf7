"""PlantCV reads rendered views: cube, wavelengths and NDVI are compared with ours.

    uv venv PLANTCV && VIRTUAL_ENV=PLANTCV uv pip install plantcv
    uv run python benchmarks/plantcv_views.py RUN --plantcv PLANTCV/bin/python

PlantCV needs an environment of its own, because it asks for other versions of packages than ours.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path
from typing import get_args

import numpy as np
import tyro
from results_table import write_results

import hsi_sc_nerf as hsn
from hsi_sc_nerf.rendering.views import CubeType

READ = """
import sys
from importlib.metadata import version
import numpy as np
from plantcv import plantcv as pcv
found = pcv.readimage(sys.argv[1], mode="envi")
wavelengths_nm = sorted(found.wavelength_dict)
ndvi = pcv.spectral_index.ndvi(found, distance=30).array_data
np.savez(sys.argv[2], cube=found.array_data, nm=wavelengths_nm, ndvi=ndvi, version=version("plantcv"))
"""
"""What PlantCV's interpreter runs."""


def main(run: tyro.conf.Positional[Path], plantcv: Path) -> None:
    """Render a view of a run, let PlantCV read it, and write the table of differences.

    Args:
        run: a trained run.
        plantcv: Python interpreter of an environment with PlantCV.
    """
    opened, rows = hsn.open_run(run), []
    view = opened.render(angle_deg=30.0)
    for kind in get_args(CubeType):
        with tempfile.TemporaryDirectory() as folder:
            data, found = view.save(folder, kind).with_suffix(".raw"), Path(folder) / "found.npz"
            subprocess.run([plantcv, "-c", READ, data, found], check=True)
            with np.load(found) as read:
                cube, nm, ndvi, version = (read[name] for name in ("cube", "nm", "ndvi", "version"))
        ratio = float(np.median(cube[view.valid] / view.reflectance[view.valid]))
        cube_error = np.abs(cube / ratio - view.reflectance)[view.valid].max()
        ndvi_error = np.abs(ndvi - view.index("NDVI"))[view.valid].max()
        nm_error = np.abs(nm - opened.wavelengths_nm).max()
        rows.append([str(version), kind, f"{ratio:.5g}", f"{cube_error:.1e}", f"{nm_error:.1e}", f"{ndvi_error:.1e}"])
    titles = ["PlantCV", "--cubes", "number of reflectance 1", "largest error", "of wavelengths, nm", "of NDVI"]
    write_results("plantcv_views", titles, rows)


if __name__ == "__main__":
    tyro.cli(main)
