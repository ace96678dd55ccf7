"""What benchmarks/gpu.py puts in the place of Open3D where that cannot be installed gives what Open3D gives."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

STAND_INS = Path(__file__).parents[1] / "benchmarks" / "gpu_stand_ins"
SCRIPT = """
import sys
import numpy as np
if sys.argv[2]:
    sys.path.insert(0, sys.argv[2])
import open3d
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import load_scene, override

scene = override(load_scene("pear"), frames=4, size_px=40, bands=5, effects=("chamber_shading",))
frame = Simulation(scene).frame(1)
np.savez(sys.argv[1], where=open3d.__file__, counts=frame.counts, coverage=frame.coverage)
"""


@pytest.mark.slow
def test_frames_equal_open3d(tmp_path):
    pytest.importorskip("embreex")
    pytest.importorskip("open3d")
    found = []
    for folder in ("", str(STAND_INS)):
        subprocess.run([sys.executable, "-c", SCRIPT, str(tmp_path / "found.npz"), folder], check=True)
        with np.load(tmp_path / "found.npz") as arrays:
            found.append(dict(arrays))
    assert str(STAND_INS) in str(found[1]["where"])
    np.testing.assert_allclose(found[1]["coverage"], found[0]["coverage"], atol=1e-3)
    difference = np.abs(found[1]["counts"].astype(int) - found[0]["counts"].astype(int))
    # A ray along the edge of two triangles may go to either.
    assert (difference > 1).mean() < 1e-3
