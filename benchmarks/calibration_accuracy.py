"""Accuracy of calibrated reflectance on simulated sessions, as a table.

    uv run python benchmarks/calibration_accuracy.py --pictures docs/images
    uv run python benchmarks/calibration_accuracy.py --tables drift --path-traced SESSION_0 SESSION_1 SESSION_2

Each row is a pear under some effects of light and sensor, calibrated with and without the corrections for them. A
second table has the error of the lamps' drift, and its ratio to the stated error, if the light of each pixel
scatters from frame to frame. Its path-traced sessions are made by benchmarks/independent_session.py, each with a
--seed of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import tyro
from calibration_score import CalibrationScore, lamp_output, score_calibration
from jaxtyping import Float, UInt16
from results_table import RESULTS, write_results
from rich.progress import track
from session_truth import SessionTruth

from hsi_sc_nerf import paper
from hsi_sc_nerf.calibration.lamp_drift import LampDriftEstimate, NotMeasurable
from hsi_sc_nerf.calibration.report import draw_calibration
from hsi_sc_nerf.calibration.session_calibration import CalibrationConfig, calibrate_session
from hsi_sc_nerf.capture.envi import write_cube
from hsi_sc_nerf.capture.session import Capture, open_session
from hsi_sc_nerf.processing.frames import pack_frames
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth

FALLOFF = "{illumination_falloff: {edge_loss: 0.2}}"
DRIFT = "{lamp_drift: {percent: -6, temperature_change_k: -80}}"
SENSOR = (
    "{bad_pixels: {dead_fraction: 0.001, hot_fraction: 0.001, dead_bands: 2}}",
    "gloss",
    "{saturation: {exposure_factor: 1.6}}",
    "{tarp_exposure: {exposure_factor: 0.6}}",
    "image_rotation",
)
NOISE = ("photon_noise", "read_noise", "dark_pattern")
PLAIN = CalibrationConfig(lamp_drift="never")
CORRECTED = CalibrationConfig(flat_field=True)
SESSIONS: dict[str, tuple[tuple[str, ...], CalibrationConfig]] = {
    "none": ((), PLAIN),
    "gradient over image and tarp": ((FALLOFF,), PLAIN),
    "the same, flat field": ((FALLOFF,), CORRECTED),
    "lamps drift and redden": ((DRIFT,), PLAIN),
    "the same, corrected": ((DRIFT,), CORRECTED),
    "both, dead bands, saturated highlights": ((FALLOFF, DRIFT, *SENSOR), CORRECTED),
    "all these and noise": ((FALLOFF, DRIFT, *SENSOR, *NOISE), CORRECTED),
}
WARM_UP = "{lamp_drift: {percent: -5, temperature_change_k: -30}}"
SCATTERS: dict[str, tuple[float, float]] = {
    "none": (0.0, 0.0),
    "5 %": (0.05, 0.0),
    "10 %": (0.10, 0.0),
    "5 %, and a tenfold value in 2 % of the pixels": (0.05, 0.02),
}
"""Scatter of a pixel's light (standard deviation), and fraction of the pixels that are fireflies."""
DRIFT_COLUMNS = [
    "session",
    "scatter of a pixel",
    "static pixels",
    "drift, RMS %",
    "worst band, RMS %",
    "largest error, %",
    "error / stated error",
    "within one, %",
    "within two, %",
]
COLUMNS = [
    "session",
    "reflectance, RMS",
    "noise in it",
    "error / uncertainty",
    "lamps' drift, RMS %",
    "flagged, %",
]


Drift = tuple[LampDriftEstimate | NotMeasurable, Float[np.ndarray, "frames bands"]]
"""Measured and true light relative to the first frame."""


@dataclass(frozen=True)
class CalibrationAccuracy:
    """Measure the accuracy of calibrated reflectance on simulated sessions."""

    pictures: Path | None = None
    """Folder for the pictures of the last session's calibration."""
    scene: str = "pear"
    """Scene to calibrate."""
    size: int = 128
    """Width and height of the frames, pixels."""
    frames: int = 12
    """Frames of a session."""
    tables: tuple[Literal["accuracy", "drift"], ...] = ("accuracy", "drift")
    """Which tables."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the second table's simulated sessions."""
    path_traced: tuple[Path, ...] = ()
    """Path-traced sessions for a row of the second table, in the order of their seeds."""
    results: Path = RESULTS
    """Folder of the CSV files."""

    def main(self) -> None:
        """Measure, print the tables, write them."""
        if "accuracy" in self.tables:
            rows = [[name, *_cells(self._score(*case))] for name, case in track(SESSIONS.items(), "calibrating")]
            write_results("calibration_accuracy", COLUMNS, rows, folder=self.results)
        if "drift" in self.tables:
            self.measure_drift()

    def measure_drift(self) -> None:
        """Measure drift on noisy sessions whose light scatters more and more, and on path-traced ones."""
        measured: dict[tuple[str, str], list[Drift]] = {}
        for seed in track(self.seeds, "scattering"):
            for name, drift in self._scattered(seed).items():
                measured.setdefault((self.scene, name), []).append(drift)
        for session in track(self.path_traced, "path-traced"):
            truth = SessionTruth.of(session)
            opened = open_session(session)
            light = np.stack([truth.drift[capture.name] for capture in opened.frames])
            drift = calibrate_session(opened, PLAIN).drift
            measured.setdefault(("path-traced", "5 %"), []).append((drift, light / light[0]))
        for names, drifts in measured.items():
            seeds = ", ".join(map(str, self.seeds if names[0] == self.scene else range(len(drifts))))
            row = [*names, *_drift_cells(drifts)]
            write_results("drift_accuracy", DRIFT_COLUMNS, [row], keys=2, seed=seeds, folder=self.results)

    def _scattered(self, seed: int) -> dict[str, Drift]:
        """Measured and true drift of one session, by the scatter that is added to it."""
        effects = (WARM_UP, *NOISE)
        scene = override(load_scene(self.scene), size_px=self.size, frames=self.frames, effects=effects, seed=seed)
        with TemporaryDirectory() as folder:
            session = open_session(simulate_session(scene, Path(folder, "session"), progress=False))
            truth = load_truth(session.path)
            light = np.stack([lamp_output(truth, capture.name) for capture in session.frames])
            original = [capture.cube.read() for capture in session.frames]
            drifts = {}
            for name, strength in SCATTERS.items():
                for number, capture in enumerate(session.frames):
                    _scatter(capture, original[number], *strength, seed=1000 * seed + number)
                drifts[name] = calibrate_session(session, PLAIN).drift, light / light[0]
        return drifts

    def _score(self, effects: tuple[str, ...], config: CalibrationConfig) -> CalibrationScore:
        scene = override(load_scene(self.scene), size_px=self.size, frames=self.frames, effects=effects)
        with TemporaryDirectory() as temporary:
            session = open_session(simulate_session(scene, Path(temporary, "session"), progress=False))
            calibration, packed = calibrate_session(session, config), Path(temporary, "packed")
            pack_frames(session, calibration, packed)
            if self.pictures is not None and effects:
                draw_calibration(self.pictures, session, calibration, paper.PSEUDO_RGB_NM)
            return score_calibration(session, calibration, packed, load_truth(session.path))


def _cells(score: CalibrationScore) -> list[str]:
    return [
        f"{score.reflectance_rms:.4f}",
        f"{score.noise_rms:.4f}",
        f"{score.error_over_uncertainty:.2f}",
        f"{100.0 * score.drift_rms:.3f}",
        f"{100.0 * score.flagged_fraction:.2f}",
    ]


def _scatter(
    capture: Capture, counts: UInt16[np.ndarray, "lines samples bands"], scatter: float, fireflies: float, seed: int
) -> None:
    """Write a capture's cube again with the light of its pixels scattered."""
    rng = np.random.default_rng(seed)
    factor = np.exp(scatter * rng.standard_normal(counts.shape[:2]))
    factor[rng.random(factor.shape) < fireflies] *= 10.0
    dark = 0.0 if capture.dark is None else capture.dark.read().mean(axis=0)
    scattered = np.rint((counts - dark) * factor[..., None] + dark).clip(0, np.iinfo(np.uint16).max)
    cube = capture.cube
    write_cube(
        cube.header_path,
        scattered.astype(np.uint16),
        wavelengths_nm=cube.wavelengths_nm,
        interleave=cube.interleave,
        data_suffix=cube.data_path.suffix,
        extra_header={"tint": cube.integration_time_ms},
    )


def _drift_cells(drifts: Sequence[Drift]) -> list[str]:
    """Cells after the names, over all sessions of a row; stated errors are judged in all frames but the first."""
    found = [(drift, true) for drift, true in drifts if isinstance(drift, LampDriftEstimate)]
    if len(found) < len(drifts):
        return ["0", *["not measured"] * (len(DRIFT_COLUMNS) - 3)]
    error = np.stack([drift.factor / true - 1.0 for drift, true in found])
    stated = np.stack([drift.standard_error / true for drift, true in found])
    ratio = np.abs(error[:, 1:] / stated[:, 1:])
    percent = (rms(error), np.sqrt(np.square(error).mean(axis=(0, 1))).max(), np.abs(error).max())
    within = [f"{100.0 * (ratio <= sigmas).mean():.0f}" for sigmas in (1.0, 2.0)]
    pixels = np.mean([drift.static.sum() for drift, _ in found])
    return [f"{pixels:.0f}", *(f"{100.0 * value:.3f}" for value in percent), f"{rms(ratio):.2f}", *within]


def rms(values: Float[np.ndarray, "*shape"]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.square(values).mean()))


if __name__ == "__main__":
    tyro.cli(CalibrationAccuracy).main()
