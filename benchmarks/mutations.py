"""Functions of training, evaluation and calibration broken on purpose, one at a time: some test must fail each time.

    uv run python benchmarks/mutations.py

A mutation is a sign that is flipped, or a bound, guard or small constant that is dropped, in a copy of the package.
The tests named beside it are run on the copy; they have passed on it before. "Missed" is a mutation that none noticed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import tyro
from results_table import RESULTS, write_results

COLUMNS = ["function", "broken by", "noticed"]
ROOT = Path(__file__).resolve().parents[1]
STEP = "test_training_functions.py"
NUMERICS, LOSSES = "test_numerics.py test_numerical_properties.py", "models/test_losses.py"
METRICS = "evaluation/test_spectral_metrics.py"
RAYS, WHITE, COUNTS = (
    "fields/test_ray_marching.py",
    "calibration/test_white_reference.py",
    "calibration/test_reflectance.py",
)
# Function, what is done to it, its file, what stands there, what is put in its place, tests.
MUTATIONS = [
    ("safe_sqrt", "guard dropped", "numerics", "torch.where(positive, values, 1.0).sqrt()", "values.sqrt()", NUMERICS),
    ("safe_ratio", "guard dropped", "numerics", "torch.where(usable, wide, 1.0)", "wide", NUMERICS),
    ("safe_log10", "guard dropped", "numerics", "torch.where(below, 1.0, wide).log10()", "wide.log10()", NUMERICS),
    ("narrow", "bound dropped", "numerics", "values.clamp(-largest, largest), values)", "values, values)", NUMERICS),
    ("masked_mean", "bound dropped", "numerics", "mask.sum().clamp_min(1)", "mask.sum()", NUMERICS),
    ("spectral_angle", "sign", "numerics", "_root((u + v)", "_root((u - v)", NUMERICS),
    ("spectral_angle", "guard dropped", "numerics", "torch.where(zero, 1.0, squared).sqrt()", "squared.sqrt()", NUMERICS),
    ("spectral_angle, compiled", "guard dropped", "spectral_angle_cpu", "if norm_a == 0.0 or norm_b == 0.0:\n            # A NaN", "if False:\n            # A NaN", NUMERICS),
    ("spectral_angle, compiled", "sign", "spectral_angle_cpu", "(v - u) + past * u", "(v - u) - past * u", NUMERICS),
    ("one_minus_cosine", "floor dropped", "numerics", "0.5 * ((u - v).square().sum(-1) + (u_short + v_short).squeeze(-1))", "0.5 * (u - v).square().sum(-1)", NUMERICS),
    ("hsi_loss", "flags ignored", "models/losses", "if valid is not None:\n        predicted, target", "if False:\n        predicted, target", LOSSES),
    ("hsi_loss", "sign", "models/losses", "widen(predicted) - widen(target)", "widen(predicted) + widen(target)", LOSSES),
    ("angular_loss", "floor dropped", "models/losses", "norm_floor=norm_floor", "norm_floor=0.0", LOSSES),
    ("angle_loss", "flags ignored", "models/losses", "return p, t, has_angle(valid)", "return predicted, target, has_angle(valid)", LOSSES),
    ("separate_distortion", "sign", "models/losses", "middles * before - moment_before", "middles * before + moment_before", STEP),
    ("separate_distortion", "factor", "models/losses", "* (ends - starts)).sum(dim=-1) / 3.0", "* (ends - starts)).sum(dim=-1) / 2.0", STEP),
    ("PSNR", "constant dropped", "evaluation/spectral_metrics", "mse + PSNR_DELTA", "mse", METRICS),
    ("SAM of flagged pixels", "bound", "evaluation/spectral_metrics", "MIN_BANDS_OF_AN_ANGLE = 2", "MIN_BANDS_OF_AN_ANGLE = 1", METRICS),
    ("means over bands", "guard dropped", "evaluation/spectral_metrics", "scores.mean() if len(scores) else np.nan", "scores.sum() / max(len(scores), 1)", METRICS),
    ("SSIM", "sign", "evaluation/band_moments", "luminance * (2.0 * covariance + c2)", "luminance * (2.0 * covariance - c2)", METRICS),
    ("SpectralRenderer", "sign", "models/compositing", "(1.0 - torch.sum(weights", "(1.0 + torch.sum(weights", STEP),
    ("density_of", "bound dropped", "fields/spectral_field", ".clamp(max=LARGEST_LOG_DENSITY)", "", STEP),
    ("density_of", "outside not empty", "fields/spectral_field", "* inside\n\n\ndef grid_positions", "\n\n\ndef grid_positions", STEP),
    ("CoefficientGain", "gain dropped", "fields/spectral_field", "return raw * self.gains", "return raw", "fields/test_spectral_field.py"),
    ("CameraShading", "bound dropped", "fields/camera_shading", "log_gain.clamp(-LARGEST_LOG_GAIN, LARGEST_LOG_GAIN)", "log_gain", "fields/test_camera_shading.py"),
    ("CameraShading", "corners", "fields/camera_shading", "align_corners=True", "align_corners=False", STEP),
    ("CameraShading", "sign of parallax", "fields/camera_shading", "normals + self.parallax", "normals - self.parallax", STEP),
    ("CameraShading.normals", "sign", "fields/camera_shading", "-torch.stack(torch.gradient", "torch.stack(torch.gradient", "fields/test_camera_shading.py"),
    ("CameraShading.normals", "constant dropped", "fields/camera_shading", "dim=-1, eps=1e-12", "dim=-1, eps=0.0", f"{STEP} fields/test_camera_shading.py"),
    ("CameraShading.across_image", "bound dropped", "fields/camera_shading", "torch.hypot(cos, sin).clamp_min(1e-12)", "torch.hypot(cos, sin)", STEP),
    ("CameraShading.across_image", "sign", "fields/camera_shading", "cos * y - sin * x, z", "cos * y + sin * x, z", "fields/test_camera_shading.py"),
    ("smoothed_grid", "sides", "fields/camera_shading", "weights.sum(dim=0)", "weights.sum(dim=0).max()", STEP),
    ("interpolate_hash_grid", "weight", "fields/hash_grid", "z - xz - yz + xyz", "z - xz - yz - xyz", f"{STEP} fields/test_hash_grid.py"),
    ("interpolate_hash_grid", "gradient", "fields/hash_grid", "at_z[:, 1::2] - at_z[:, 0::2]", "at_z[:, 1::2] + at_z[:, 0::2]", STEP),
    ("interpolate_hash_grid, compiled", "gradient", "fields/hash_grid_cpu", "near_z * (e - a)", "near_z * (e + a)", "fields/test_hash_grid.py"),
    ("sample_occupied, tensors", "bound dropped", "fields/ray_marching", ".clamp(0.0, 1.0)\n", "\n", RAYS),
    ("sample_occupied, tensors", "guard dropped", "fields/ray_marching", "met = total > 0.0", "met = total > -1.0", RAYS),
    ("sample_occupied, compiled", "guard dropped", "fields/ray_marching_cpu", "if total > 0.0:", "if True:", RAYS),
    ("OccupancyGrid", "sign", "fields/occupancy_grid", "torch.exp(-self.cell * density)", "torch.exp(self.cell * density)", STEP),
    ("TurntableRefinement", "sign of angles", "models/pose_refinement", "(-self.angle_corrections())", "(self.angle_corrections())", "models/test_pose_refinement.py"),
    ("TurntableRefinement", "sign of shift", "models/pose_refinement", "positions + rotations @ twist[:, 3]", "positions - rotations @ twist[:, 3]", STEP),
    ("TurntableRefinement", "penalty", "models/pose_refinement", "shift.square().sum() *", "shift.sum() *", "models/test_pose_refinement.py"),
    ("Background", "guard dropped", "geometry/ray_projection", "torch.where(forward, -directions[..., 2], 1.0)", "-directions[..., 2]", STEP),
    ("Background", "backwards", "models/backgrounds", "torch.where(forward[..., None], interpolate_image(self.image, pixels / self.cell_px), self.spectrum)", "interpolate_image(self.image, pixels / self.cell_px)", "models/test_backgrounds.py"),
    ("Muon", "constant dropped", "models/optimizers", "flat.norm() + eps", "flat.norm()", STEP),
    ("GuardedOptimizers", "guard dropped", "models/optimizers", "if not self.skipped_groups:", "if True:", "models/test_optimizers.py"),
    ("rotation_angle_deg", "bound dropped", "geometry/camera", "np.minimum(1.0, chord)", "chord", "geometry/test_camera.py"),
    ("white_reference", "check dropped", "calibration/white_reference", "if 2 * np.count_nonzero(bad) > len(bad):", "if False:", WHITE),
    ("pack_counts", "check dropped", "calibration/reflectance", "if not (np.isfinite(scale).all() and np.isfinite(offset).all()):", "if False:", COUNTS),
    ("pack_counts", "saturation", "calibration/reflectance", "lambda values: values >= level", "lambda values: values > level", COUNTS),
]  # fmt: skip


def failed(package: Path, tests: str) -> bool:
    """Whether some of the tests fail with the package in this folder."""
    environment = os.environ | {"PYTHONPATH": str(package), "PYTHONDONTWRITEBYTECODE": "", "OMP_NUM_THREADS": "1"}
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider"]
    paths = [str(package / "tests" / test) for test in tests.split()]
    told = subprocess.run([*words, *paths], cwd=package, env=environment, capture_output=True, text=True)
    if told.returncode not in (0, 1, 2):  # 2: a module that cannot be imported any more
        raise RuntimeError(told.stdout[-2000:] + told.stderr[-2000:])
    return told.returncode != 0


def main(only: str = "", results: Path = RESULTS) -> None:
    """Break every function, run its tests, and write the table.

    Args:
        only: part of the names of the functions to break; the other rows of the table are kept.
        results: folder of the table.

    Raises:
        RuntimeError: the tests fail before anything is broken, or a mutation's text is not found once in its file.
    """
    chosen = [mutation for mutation in MUTATIONS if only in mutation[0]]
    with tempfile.TemporaryDirectory() as temporary:
        package = Path(temporary)
        for name in ("hsi_sc_nerf", "tests", "pyproject.toml"):
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, package / name)  # type: ignore[operator]
        if failed(package, " ".join(sorted({test for *_, tests in chosen for test in tests.split()}))):
            raise RuntimeError("the tests fail before anything is broken")
        for function, broken_by, module, old, new, tests in chosen:
            file = package / "hsi_sc_nerf" / f"{module}.py"
            text = file.read_text()
            if text.count(old) != 1:
                raise RuntimeError(f"{file.name} has {text.count(old)} times {old!r}")
            file.write_text(text.replace(old, new))
            row = [function, broken_by, "yes" if failed(package, tests) else "missed"]
            file.write_text(text)
            write_results("mutations", COLUMNS, [row], keys=2, folder=results)


if __name__ == "__main__":
    tyro.cli(main)
