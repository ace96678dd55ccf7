"""What benchmarks/gpu.py puts in the place of Open3D where that cannot be installed gives what Open3D gives."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

STAND_INS = Path(__file__).parents[1] / "benchmarks" / "gpu_stand_ins"
SCRIPT = """
import sys
import numpy as np
import open3d
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import load_scene, override

scene = override(load_scene("pear"), frames=4, size_px=40, bands=5, effects=("chamber_shading",))
frame = Simulation(scene).frame(1)
np.savez(sys.argv[1], where=open3d.__file__, counts=frame.counts, coverage=frame.coverage)
"""


@pytest.mark.slow
def test_frames_equal_open3d(tmp_path, monkeypatch):
    pytest.importorskip("embreex")
    pytest.importorskip("open3d")
    path = str(tmp_path / "stand_in.npz")
    search = os.pathsep.join([str(STAND_INS), os.environ.get("PYTHONPATH", "")])
    subprocess.run([sys.executable, "-c", SCRIPT, path], check=True, env={**os.environ, "PYTHONPATH": search})
    monkeypatch.setattr(sys, "argv", ["", str(tmp_path / "open3d.npz")])
    exec(SCRIPT, {})
    with np.load(path) as found, np.load(tmp_path / "open3d.npz") as expected:
        assert str(STAND_INS) in str(found["where"])
        np.testing.assert_allclose(found["coverage"], expected["coverage"], atol=1e-3)
        difference = np.abs(found["counts"].astype(int) - expected["counts"].astype(int))
    # A ray along the edge of two triangles may go to either.
    assert (difference > 1).mean() < 1e-3
