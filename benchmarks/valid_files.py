"""Small valid files of every kind that this package reads, to be damaged by damaged_files.py."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5netcdf
import numpy as np
import torch
import trimesh
import yaml
from torch.utils.tensorboard import SummaryWriter

from hsi_sc_nerf.analysis.drawn_regions import KIND
from hsi_sc_nerf.batch.plan import OBJECTS_NAME, STEPS, write_plan
from hsi_sc_nerf.batch.session_list import OBJECT, SESSION
from hsi_sc_nerf.batch.session_steps import STEPS_NAME, SessionSettings
from hsi_sc_nerf.calibration.reflectance import FrameCalibration
from hsi_sc_nerf.capture.envi import open_cube, write_cube
from hsi_sc_nerf.config import hsi_sc_nerf
from hsi_sc_nerf.export.cloud import SpectralCloud, stream, write_spectral_ply
from hsi_sc_nerf.export.formats import write_cloud
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.geometry.camera import look_at
from hsi_sc_nerf.light.known_light import KnownLight
from hsi_sc_nerf.light.stationary_light import TERMS, StationaryLight
from hsi_sc_nerf.models.checkpoints import CHECKPOINT_KEYS, write_checkpoint
from hsi_sc_nerf.packed.cube import ReflectanceUncertainty
from hsi_sc_nerf.packed.dataset import Container, PackedDataset, PackedFrame, write_transforms
from hsi_sc_nerf.processing.frames import FramePaths, process_frame
from hsi_sc_nerf.simulate.effects.detector import DarkPattern
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth


def write_valid_files(folder: Path) -> dict[str, Path]:
    """A simulated session, a small dataset and everything else; paths of what lies beside them by short names."""
    folder.mkdir()
    scene = replace(override(load_scene("sphere"), frames=3, size_px=24, bands=8), effects=(DarkPattern(),))
    session = simulate_session(scene, folder / "session", progress=False)
    raw, truth = open_cube(session / "sphere_000" / "capture" / "sphere_000.hdr"), load_truth(session)
    bands, data = raw.shape[2], folder / "data"
    calibration = FrameCalibration(
        np.zeros((1, bands)), np.full((1, bands), 2e-4), np.arange(bands), saturation_counts=4095.0
    )
    frames = []
    for name in ("ball_0", "ball_1"):
        paths = FramePaths.of(data, name)
        process_frame(raw, calibration, paths, "made")
        paths.mask.parent.mkdir(exist_ok=True)
        shutil.copy(paths.flags, paths.mask)
        pose = look_at(np.array([0.4, 0.0, 0.25]), np.array([0.0, 0.0, 0.1]))
        frames.append(PackedFrame(name, paths.image, paths.mask, paths.cube, paths.flags, 0.0, 0.1, pose))
    some, box = np.full(bands, 0.5), np.array([[-0.1, -0.1, 0.0], [0.1, 0.1, 0.2]])
    write_transforms(
        PackedDataset(
            *(data, truth.intrinsics, np.zeros(4), raw.wavelengths_nm, raw.wavelengths_nm[[5, 3, 1]], "ball"),
            *(box, box, some, Container(0.09, 0.07), tuple(frames)),
            fwhm_nm=some,
            uncertainty=ReflectanceUncertainty(some, some, some),
            typical_uncertainty=some,
        )
    )
    write_json(data / "report" / "inspection.json", {"session": "/a/b", "findings": [_FINDING, _FINDING]})
    write_json(data / "calibration.json", _calibration(bands))
    write_json(data / "poses.json", _POSES)
    cloud = SpectralCloud(
        *(rng := np.random.default_rng(0)).normal(size=(2, 20, 3)).astype(np.float32),
        colours=np.zeros((20, 3), np.uint8),
        spectra=rng.random((20, 3), np.float32),
        wavelengths_nm=np.array([400.0, 500.0, 600.0]),
    )
    mesh = trimesh.creation.icosphere(1, 0.05)
    files = {suffix: folder / f"mesh.{suffix}" for suffix in ("ply", "obj", "stl", "glb")}
    for path in files.values():
        mesh.export(path)
    others = {
        "xml": "capture.xml",
        "bands": "bands.csv",
        "panel": "panel.csv",
        "binary": "cloud.ply",
        "ascii": "ascii.ply",
        "old": "old.nc",
        "library": "library.hdr",
        "sli": "library.sli",
        "csv": "table.csv",
        "scene": "scene.yaml",
        "effects": "effects.yaml",
        "checkpoint": "step-000000001.ckpt",
        "path": "path.json",
        "comparison": "comparison.json",
        "traits": "traits.json",
        "season": "season",
        "calibration": "calibration.csv",
        "onnx": "model.onnx",
        "regions": "regions.json",
        "npy": "pixels.npy",
        "spectrum": "spectrum.csv",
        "steps": STEPS_NAME,
        "light": "cloud-material.json",
    }
    files |= {name: folder / file for name, file in others.items()}
    files |= {kind: write_cloud(folder / "cloud", stream(cloud), kind) for kind in ("netcdf", "zarr")}
    _write_without_checksums(files["netcdf"], files["old"])
    write_spectral_ply(files["binary"], cloud, np.array([[0, 1, 2], [2, 3, 4]]))
    names = ("x", "y", "z", "nx", "ny", "nz", "scalar_400.00nm", "scalar_500.00nm")
    properties = [
        *(f"property float {name}" for name in names),
        *(f"property uchar {c}" for c in ("red", "green", "blue")),
    ]
    rows = ["0.1 0.2 0.3 0 0 1 0.5 0.6 1 2 3"] * 4
    faces = ["element face 1", "property list uchar int vertex_indices"]
    header = ["ply", "format ascii 1.0", "comment a", "element vertex 4", *properties, *faces, "end_header"]
    files["ascii"].write_text("\n".join([*header, *rows, "3 0 1 2", ""]))
    files["xml"].write_text(_XML)
    table = [f"{nm},{0.5},{0.25}" for nm in range(390, 1030, 20)]
    files["bands"].write_text("\n".join(["nm", *(f"{nm}" for nm in raw.wavelengths_nm)]))
    files["panel"].write_text("\n".join(["nm,reflectance", *(f"{nm},0.98" for nm in range(390, 1030, 20))]))
    files["csv"].write_text("\n".join(["nm,green,brown", *table]))
    library = {"file type": "ENVI Spectral Library", "spectra names": ["green", "brown"]}
    write_cube(
        files["library"],
        np.full((2, bands, 1), 0.5, np.float32),
        wavelengths_nm=None,
        data_suffix=".sli",
        interleave="bsq",
        extra_header={**library, "wavelength units": "nm", "wavelength": raw.wavelengths_nm.tolist()},
    )
    files["scene"].write_text(_SCENE)
    files["effects"].write_text("photon_noise: {electrons: 40}\nlamp: [1, 2.5, true, text]\n")
    weights = {"a": torch.zeros(3, 4), "b": torch.ones(2)}
    write_checkpoint(files["checkpoint"], {key: {} for key in CHECKPOINT_KEYS} | {"step": 1, "pipeline": weights})
    camera = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50.0, "aspect": 1.0}
    write_json(files["path"], {"render_height": 20, "render_width": 30, "camera_path": [camera, camera], "fps": 24})
    write_json(files["comparison"], _COMPARISON)
    write_json(files["traits"], _TRAITS)
    _write_season(files["season"], session)
    rows = [f"{nm},0.1,0.5,0.2,0.3,0.3,1" for nm in range(400, 1001, 20)]
    files["calibration"].write_text("\n".join([*_CALIBRATION_HEAD, *rows, ""]))
    shutil.copy(Path(__file__).parents[1] / "tests" / "analysis" / "calibrations_onnx" / "pls.onnx", files["onnx"])
    table = ["# name: sugar", "# unit: %", "# model: model.onnx", "wavelength_nm", *map(str, range(500, 560, 10))]
    files["onnx"].with_name("model.csv").write_text("\n".join(table))
    points_m = rng.normal(0.0, 0.02, (30, 3)).tolist()
    region = {"name": "stem", "points": [0, 3, 4]}
    write_json(files["regions"], {"kind": KIND, "points_m": points_m, "regions": [region, region | {"name": "b"}]})
    np.save(files["npy"], truth.material_weights(truth.captures[0]).astype(np.float16))
    files["spectrum"].write_text(
        "\n".join(["wavelength_nm,reflectance", *(f"{nm},0.5" for nm in range(390, 1030, 20))])
    )
    entry = {"command": "hsi-sc-nerf process", "fingerprint": "0", "finished": True, "seconds": 3.5}
    write_json(files["steps"], {name: entry | {"peak_memory_mib": 800.0} for name in STEPS})
    lamp = StationaryLight(np.eye(TERMS)[0], np.array([0.5]), np.array([[0.0, 0.6, 0.8]]), 1.6, *np.ones((2, 2)))
    known = KnownLight(lamp, np.eye(TERMS + 4), np.array([0.0, 0.0, -0.4]), np.array([500.0, 700.0]))
    write_json(files["light"], {"light": known.values()})
    with SummaryWriter(str(folder / "curves")) as writer:
        for step in range(20):
            writer.add_scalar("Train Loss", 1.0 / (1 + step), step)
    (files["events"],) = (folder / "curves").glob("events.out.tfevents.*")
    (folder / "run").mkdir()
    (folder / "run" / "config.yml").write_text(yaml.dump(hsi_sc_nerf.config))
    return files


def _write_without_checksums(source: Path, path: Path) -> None:
    """A copy of a NetCDF file in the older form of HDF5, whose headers have no checksums."""
    with h5netcdf.File(source) as file, h5netcdf.File(path, "w", track_order=False) as copy:
        copy.attrs.update(file.attrs)
        copy.dimensions = {name: dimension.size for name, dimension in file.dimensions.items()}
        for name, values in file.variables.items():
            made = copy.create_variable(name, values.dimensions, values.dtype, data=values[...])
            made.attrs.update(values.attrs)


def _write_season(out: Path, session: Path) -> None:
    """A batch of two objects, one of which is done."""
    out.mkdir()
    rows = [{OBJECT: name, SESSION: str(session), "day": "3"} for name in ("pear", "maize")]
    write_plan(out, rows, SessionSettings())
    pear = out / OBJECTS_NAME / "pear"
    record = {"status": "done", "seconds": 3.5, "peak_memory_mib": 800.0, "sentence": ""}
    for step in STEPS:
        write_json(pear / "steps" / f"{step}.json", {"step": step} | record)
    write_json(pear / "traits" / "traits.json", _TRAITS)
    write_json(pear / "eval.json", {"results": dict.fromkeys(("psnr", "ssim", "sam", "rmse"), 0.5)})
    write_json(pear / "inspection.json", {"session": "/a/b", "findings": [_FINDING, _FINDING]})


_CALIBRATION_HEAD = (
    *("# name: sugar", "# unit: %", "# preprocessing: absorbance, snv, savgol 5 2 1", "# intercept: 12.5"),
    *("# error: 0.4", "# t2_limit: 9.5", "# q_limit: 0.02", "# score_variances: 1.5"),
    "wavelength_nm,coefficient,mean,scale,weight_1,loading_1,reference",
)
_FINDING = {"name": "white", "level": "amber", "sentence": "The white is old; take it again.", "values": {"a": 1.0}}
_POSES = {
    "method": "markers",
    "frames": {"total": 3, "used": 2},
    "reprojection_error_px": {"overall": 0.2, "target": 1.0},
    "direction": {"found": "ccw"},
    "steps_deg": {"median": 10.0},
    "intrinsics": {"fl_x": 90.0},
    "uncertainty": {"focal_percent": 0.1, "distance_percent": 0.2},
    "scale": {"source": "markers", "uncertainty_percent": 0.1},
    "loop_closure_deg": 0.01,
    "camera_looks_down_deg": 30.0,
    "axis_tilt_in_image_deg": 0.1,
    "outliers": [],
    "warnings": ["One frame is blurred."],
}
_DISTANCES = {"mean_m": 1e-3, "median_m": 9e-4, "rms_m": 1.23e-3, "percentile_95_m": 2e-3, "largest_m": 3e-3}
_COMPARISON = {
    "scores": {
        k: {"threshold_m": 2e-3, "precision": 95.0, "recall": 97.0, "f_score": 96.0} for k in ("chosen", "knee")
    },
    "cloud_to_reference": _DISTANCES,
    "reference_to_cloud": _DISTANCES,
    "curves": {"thresholds_m": [0, 0.002], "precision": [0, 95], "recall": [0, 97], "f_score": [0, 96]},
}
_SIZE = {f"{d}_m": 0.07 for d in ("height", "largest_diameter", "smallest_diameter", "equivalent_diameter")}
_SIZE |= {"area_m2": 0.02, "volume_l": 0.2}
_TRAITS = {
    "settings": {"cloud": "a.ply"},
    "size": _SIZE,
    "size_sd": _SIZE,
    "size_sd_by_cause": {"points": _SIZE, "scale": _SIZE},
    "watertight": True,
    "seen_area_m2": 0.018,
    "classes": {
        "threshold_rad": 0.1,
        "areas_m2": {"green": 0.01, "brown": 0.008},
        "unclassified_m2": 0.0,
        "mixture_areas_m2": {"green": 0.01, "brown": 0.008},
        "mixture_unclassified_m2": 0.0,
        "regions": [{"label": "green", "area_m2": 0.01, "centre_m": [0.0, 0.0, 0.1]}],
    },
    "indices": ["NDVI"],
    "calibrations": {"sugar": {"unit": "%", "error": 0.4, "resampling_error": 0.01}},
    "regions": {
        "whole surface": {
            "area_m2": 0.02,
            "reflectance": {"mean": 0.4, "std": 0.01, "measured": 0.3, "irradiance": 0.8, "irradiance_std": 0.02},
            "indices": {"NDVI": {"mean": 0.5, "sd": 0.1, "std": 0.01, "outside": 0.0}},
            "calibrations": {"sugar": {"mean": 12.0, "sd": 1.0, "std": 0.5, "outside": 0.1}},
        }
    },
}
_XML = """<?xml version="1.0" encoding="utf-8"?>
<!DOCTYPE properties [<!ENTITY e "text">]>
<properties><key field="integration_time">10</key><key field="wr_mode">custom</key><name>&e;</name></properties>
"""
_SCENE = """object: {shape: mesh, mesh_file: a.ply, materials: [skin, core], height_m: 0.07}
camera: {elevation_deg: 30, distance_m: 0.5, aim_height_m: 0.1, size_px: 32}
turntable: {disc_diameter_m: 0.3, frames: 12}
markers: {side_m: 0.02}
materials:
  skin: {plant: {plateau: 0.6, water: 1}}
  core: {plain: {level: 0.2}}
effects: [photon_noise, {lamp: {fraction: 0.3}}]
seed: 3
"""


def _calibration(bands: int) -> dict[str, Any]:
    noise = {"read_noise_counts": [2.0] * bands, "counts_per_electron": 0.1}
    drift = {"measured": True, "factor": {"a": [1.0, 1.1], "b": [1.0, 0.9]}, "corrected": True, "p_value": 0.01}
    counts = {name: [1] * bands for name in ("clipped_low", "clipped_high", "saturated", "dead", "no_data")}
    found = {"white_source": "tarp", "white": {"pixels": 100, "roi": [0, 0, 1, 1]}, "dead_elements": 3}
    return {**found, "noise": noise, "lamp_drift": drift, **counts}
