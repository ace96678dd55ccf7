"""The whole job through the real commands: a small demo, then a look at everything that it left behind."""

import json
from importlib import resources

import cv2
import numpy as np
import pytest
from steps_here import steps_here

from hsi_sc_nerf.cli import workflows
from hsi_sc_nerf.export.cloud import read_spectral_ply
from hsi_sc_nerf.packed.cube import REFLECTANCE_SCALE
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.simulate.scores import score_processing
from hsi_sc_nerf.simulate.truth import load_truth

pytestmark = pytest.mark.slow

ITERATIONS = 150
# The shipped pear with fewer pixels, bands and frames.
SMALLER = {"size_px: 128": "size_px: 112", "bands: 204": "bands: 12", "frames: 36": "frames: 24"}


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    text = resources.files("hsi_sc_nerf.simulate").joinpath("scenes", "pear.yaml").read_text(encoding="utf-8")
    for shipped, smaller in SMALLER.items():
        assert shipped in text
        text = text.replace(shipped, smaller)
    (folder / "pear.yaml").write_text(text)
    out = folder / "out"
    with steps_here() as run_step, pytest.MonkeyPatch.context() as patch:
        patch.setattr(workflows, "run_step", run_step)
        workflows.DemoCommand(out, str(folder / "pear.yaml"), ITERATIONS, points=20_000).main()
    return out


def test_processing_recovers_poses_and_reflectance(demo):
    dataset, truth = open_packed(demo / "data"), load_truth(demo / "session")
    assert [frame.capture for frame in dataset.frames] == list(truth.captures)
    score = score_processing(dataset, truth)
    assert score.rotation_deg < 0.5
    assert score.position_m < 0.001
    assert score.focal_length_percent < 0.5
    assert score.reflectance_rmse < 0.02
    assert score.mask_iou > 0.95


def test_training_explains_held_out_views_far_better_than_the_mean_spectrum(demo):
    """A model that learned nothing of place, or shows its views the wrong way round, cannot pass."""
    dataset = open_packed(demo / "data")
    pixels = np.concatenate([frame.cube()[frame.mask()] / REFLECTANCE_SCALE for frame in dataset.frames])
    constant_rmse = np.sqrt(np.mean((pixels - pixels.mean(axis=0)) ** 2))
    metrics = json.loads((demo / "summary.json").read_text())["metrics"]
    assert metrics["rmse"] < 0.6 * constant_rmse
    assert metrics["psnr"] > 24
    assert metrics["f_score"] > 40


def test_cloud_spectra_are_the_objects(demo):
    """The mean spectrum of the cloud is the object's, within a tenth: no background mixed in, no band swapped."""
    dataset = open_packed(demo / "data")
    cloud = read_spectral_ply(demo / "point_cloud.ply")
    measured = np.mean([(f.cube()[f.mask()] / REFLECTANCE_SCALE).mean(axis=0) for f in dataset.frames], axis=0)
    assert np.linalg.norm(cloud.spectra.mean(axis=0) - measured) < 0.1 * np.linalg.norm(measured)


def test_summary_and_pictures(demo):
    summary = json.loads((demo / "summary.json").read_text())
    names = {"f_score", *(f"{name}{end}" for name in ("sam", "rmse", "ssim", "psnr") for end in ("", "_std"))}
    assert names <= set(summary["metrics"])
    steps = {step["name"]: step for step in summary["steps"]}
    assert list(steps) == ["simulate", "process", "train", "evaluate", "export", "compare"]
    assert all(step["seconds"] > 0 and step["peak_memory_mib"] > 10 for step in steps.values())
    for name in ("views", "spectra", "poses", "cloud"):
        assert cv2.imread(str(demo / f"{name}.png")).std() > 5
