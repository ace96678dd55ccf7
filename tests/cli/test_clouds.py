"""`traits` proposes organs, in a file that it takes again."""

import json

import numpy as np
import pytest
from known_fruit import CAP_CM2, SKIN, fruit_cloud

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig
from hsi_sc_nerf.cli.clouds import TraitsCommand
from hsi_sc_nerf.export.cloud import write_spectral_ply

QUICK = {"splits": 0, "mesh": MeshConfig(octree_depth=6)}


@pytest.mark.slow
def test_proposed_organs_are_written_and_measured(tmp_path, capfd):
    write_spectral_ply(tmp_path / "fruit.ply", fruit_cloud())
    TraitsCommand(tmp_path / "fruit.ply", tmp_path / "out", propose_regions=True, **QUICK).main()
    assert "body, stem, calyx" in capfd.readouterr().err
    proposed = tmp_path / "out" / "regions_proposed.json"
    TraitsCommand(tmp_path / "fruit.ply", tmp_path / "again", roi_file=proposed, **QUICK).main()
    regions = json.loads((tmp_path / "again" / "traits.json").read_text())["regions"]
    assert regions["calyx"]["area_m2"] * 1e4 == pytest.approx(CAP_CM2, rel=0.08)
    assert not (tmp_path / "again" / "regions_proposed.json").exists()


@pytest.mark.slow
def test_where_nothing_differs_one_sentence_says_so(tmp_path, capfd):
    cloud = fruit_cloud(stem=SKIN, cap=SKIN, count=8000)
    write_spectral_ply(tmp_path / "ball.ply", cloud.select(np.arange(8000)))
    TraitsCommand(tmp_path / "ball.ply", tmp_path, propose_regions=True, **QUICK).main()
    assert "body alone, for neither end of the object differs" in capfd.readouterr().err
    (body,) = json.loads((tmp_path / "regions_proposed.json").read_text())["regions"]
    assert len(body["points"]) == 8000
