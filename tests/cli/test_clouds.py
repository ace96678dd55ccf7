"""`traits` proposes organs, in a file that it takes again."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_fruit import CAP_CM2, NM, SKIN, fruit_cloud

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig
from hsi_sc_nerf.analysis.drawn_regions import DrawnRegion, write_drawn_regions
from hsi_sc_nerf.analysis.library import SpectralLibrary, write_library
from hsi_sc_nerf.api.clouds import read_cloud
from hsi_sc_nerf.cli.clouds import TraitsCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import INCIDENCE, write_spectral_ply

QUICK = {"splits": 0, "mesh": MeshConfig(octree_depth=6)}
COARSE = {"splits": 0, "mesh": MeshConfig(octree_depth=5)}


@pytest.mark.slow
def test_proposed_organs_are_written_and_measured(tmp_path, capfd):
    cloud = fruit_cloud()
    write_spectral_ply(tmp_path / "fruit.ply", replace(cloud, extra={INCIDENCE: np.zeros(len(cloud))}))
    TraitsCommand(tmp_path / "fruit.ply", tmp_path / "out", propose_regions=True, **QUICK).main()
    told = capfd.readouterr().err
    assert "body, stem, calyx" in told
    assert INCIDENCE not in told
    proposed = tmp_path / "out" / "regions_proposed.json"
    TraitsCommand(tmp_path / "fruit.ply", tmp_path / "again", roi_file=proposed, **QUICK).main()
    regions = json.loads((tmp_path / "again" / "traits.json").read_text())["regions"]
    assert regions["calyx"]["area_m2"] * 1e4 == pytest.approx(CAP_CM2, rel=0.08)
    assert not (tmp_path / "again" / "regions_proposed.json").exists()


@pytest.mark.slow
def test_where_nothing_differs_one_sentence_says_so(tmp_path, capfd):
    cloud = fruit_cloud(stem=SKIN, cap=SKIN, count=8000)
    write_spectral_ply(tmp_path / "ball.ply", replace(cloud.select(np.arange(8000)), metric=False))
    TraitsCommand(tmp_path / "ball.ply", tmp_path, propose_regions=True, **COARSE).main()
    told = capfd.readouterr().err
    assert "body alone" in told
    assert f"no {INCIDENCE}" in told
    assert not read_cloud(tmp_path / "mesh.ply").metric
    assert json.loads((tmp_path / "traits.json").read_text())["settings"]["metric"] is False
    (body,) = json.loads((tmp_path / "regions_proposed.json").read_text())["regions"]
    assert len(body["points"]) == 8000


@pytest.mark.parametrize(
    ("given", "options"),
    [
        ("mesh.ply", {}),
        ("spectra.csv", {}),
        ("piece-2/regions.sli", {}),
        ("endmembers.csv", {"components": 2}),
        ("regions_proposed.json", {"propose_regions": True}),
    ],
)
def test_results_do_not_replace_what_the_command_is_given(tmp_path, given, options):
    path = tmp_path / given
    path.parent.mkdir(exist_ok=True)
    cloud = fruit_cloud(count=50)
    write_spectral_ply(tmp_path / "fruit.ply", cloud)
    inputs = {"cloud": tmp_path / "fruit.ply"}
    if path.suffix == ".ply":
        write_spectral_ply(path, cloud)
        inputs["cloud"] = path
    elif path.suffix == ".json":
        write_drawn_regions(path, [DrawnRegion("top", cloud.points, np.arange(50) < 9)])
        inputs["roi_file"] = path
    else:
        write_library(path, SpectralLibrary(("skin",), NM, SKIN[None]))
        inputs["library"] = path
    before = path.read_bytes()
    with pytest.raises(InputError, match=f"{path.name}: would be replaced"):
        TraitsCommand(**inputs, output_dir=tmp_path, **options, **QUICK).main()
    assert path.read_bytes() == before
    if options:  # without which these files stay
        with pytest.raises(InputError, match="other\\.ply"):
            TraitsCommand(**inputs | {"cloud": tmp_path / "other.ply"}, output_dir=tmp_path, **QUICK).main()


@pytest.mark.slow
def test_an_onnx_classifier_gives_a_map_and_the_area_of_each_class_in_each_region(tmp_path):
    pytest.importorskip("onnxruntime")
    write_spectral_ply(tmp_path / "fruit.ply", fruit_cloud(count=8000))
    shutil.copy(Path(__file__).parents[1] / "analysis" / "calibrations_onnx" / "classes.onnx", tmp_path)
    rows = "".join(f"{nm}\n" for nm in (450, 500, 550, 600, 650, 700))
    (tmp_path / "tissue.csv").write_text(f"# model: classes.onnx\n# classes: dark, bright\nwavelength_nm\n{rows}")
    top = ("top", 0.0, 0.0, 0.03, 0.01)
    TraitsCommand(
        tmp_path / "fruit.ply", tmp_path, calibration=(tmp_path / "tissue.csv",), roi=(top,), **COARSE
    ).main()
    content = json.loads((tmp_path / "traits.json").read_text())
    for name in ("whole surface", "top"):
        found = content["regions"][name]["classifiers"]["tissue"]
        assert set(found["areas_m2"]) == {"dark", "bright"}
        assert sum(found["areas_m2"].values()) == pytest.approx(content["regions"][name]["area_m2"])
    whole = content["regions"]["whole surface"]["classifiers"]["tissue"]["areas_m2"]
    cloud = read_cloud(tmp_path / "mesh.ply")
    labels = cloud.extra["calibration_tissue"][cloud.extra["seen"] > 0.0]
    assert set(labels) == {label for label, name in enumerate(("dark", "bright")) if whole[name]}
    assert (tmp_path / "calibration_tissue.png").stat().st_size > 10_000
    page = (tmp_path / "traits.md").read_text()
    assert "## Classifiers" in page
    assert "calibration_tissue.png" in page
    assert set(read_cloud(tmp_path / "fruit.ply").calibration(tmp_path / "tissue.csv")) <= {0.0, 1.0}
