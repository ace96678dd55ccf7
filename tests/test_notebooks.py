"""The notebooks of the documentation run from the first cell to the last."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from random_cloud import random_cloud
from six_sessions import TRAIN
from steps_here import steps_here

from hsi_sc_nerf.analysis.library import read_library
from hsi_sc_nerf.benchmark.steps import typed_command
from hsi_sc_nerf.export.cloud import read_spectral_ply, write_spectral_ply
from hsi_sc_nerf.simulate.mesh import cylinder

pytestmark = pytest.mark.slow
SMALLER = {
    "frames=16, size_px=96": "frames=8, size_px=64",
    '"--max-num-iterations", "150"': f'"--max-num-iterations", "10", *"{TRAIN}".split()',
    "num_points=5000": "num_points=1000",
}
"""What takes long in the notebook of a session."""
NOTEBOOKS = {path.stem: path for path in (Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb")}


@pytest.fixture
def run_notebook(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")

    def run(name: str, smaller: dict[str, str]) -> dict:
        names: dict = {}
        left = dict(smaller)
        for cell in json.loads(NOTEBOOKS[name].read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                assert not cell["outputs"], "a notebook is committed without its output"
                source = "".join(cell["source"])
                for shipped in [shipped for shipped in left if shipped in source]:
                    source = source.replace(shipped, left.pop(shipped))
                exec(compile(source, f"{name}.ipynb", "exec"), names)
        assert not left
        return names

    return run


def test_every_notebook_is_run_here():
    assert set(NOTEBOOKS) == {"session", "cloud"}


def test_a_session_becomes_spectra(run_notebook, tmp_path, monkeypatch):
    """Its training is called in this process."""
    with steps_here() as run_step:
        monkeypatch.setattr(
            subprocess, "run", lambda words, **_: run_step("train", typed_command(words), tmp_path / "log")
        )
        names = run_notebook("session", SMALLER)
    cloud = read_spectral_ply(tmp_path / "point_cloud.ply")
    assert len(cloud) == len(names["cloud"])
    assert len(cloud.wavelengths_nm) == 12
    assert np.isfinite(names["found"].spectra).all(axis=1).any()
    assert (tmp_path / "views" / f"{names['view'].name}.raw").exists()
    assert (tmp_path / "view.png").exists()


def test_a_cloud_becomes_figures(run_notebook, tmp_path):
    pytest.importorskip("h5netcdf")
    wavelengths_nm = np.linspace(400.0, 1000.0, 61)
    mesh = cylinder(0.03, 0.05, segments=64, spacing_m=0.0015)
    drawn = random_cloud(
        len(mesh.vertices),
        wavelengths_nm,
        points=mesh.vertices.astype(np.float32),
        normals=mesh.vertex_normals().astype(np.float32),
    )
    write_spectral_ply(tmp_path / "point_cloud.ply", drawn)
    names = run_notebook("cloud", {})
    assert names["measured"].size.volume_l == pytest.approx(1000 * np.pi * 0.015**2 * 0.05, rel=0.1)
    assert read_library(tmp_path / "regions.sli").names == ("whole surface", "top")
    assert (tmp_path / "point_cloud.nc").exists()
    assert (tmp_path / "ndvi.png").exists()
