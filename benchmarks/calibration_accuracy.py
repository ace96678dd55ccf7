"""Accuracy of calibrated reflectance on simulated sessions, as a table.

    uv run python benchmarks/calibration_accuracy.py --pictures docs/images

Each row is a pear under some effects of light and sensor, calibrated with and without the corrections for them.
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro
from results_table import RESULTS, write_results
from rich.progress import track

from hsi_sc_nerf import paper
from hsi_sc_nerf.calibration.report import draw_calibration
from hsi_sc_nerf.calibration.session_calibration import CalibrationConfig, calibrate_session
from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.processing.frames import pack_frames
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.scores.processing import CalibrationScore, score_calibration
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
COLUMNS = [
    "session",
    "reflectance, RMS",
    "noise in it",
    "error / uncertainty",
    "lamps' drift, RMS %",
    "flagged, %",
]


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
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Measure, print the table, write it."""
        rows = [[name, *_cells(self._score(*case))] for name, case in track(SESSIONS.items(), "calibrating")]
        write_results("calibration_accuracy", COLUMNS, rows, folder=self.results)

    def _score(self, effects: tuple[str, ...], config: CalibrationConfig) -> CalibrationScore:
        scene = override(load_scene(self.scene), size_px=self.size, frames=self.frames, effects=effects)
        folder = Path(tempfile.mkdtemp())
        try:
            session = open_session(simulate_session(scene, folder / "session", progress=False))
            calibration = calibrate_session(session, config)
            pack_frames(session, calibration, folder / "packed")
            if self.pictures is not None and effects:
                draw_calibration(self.pictures, session, calibration, paper.PSEUDO_RGB_NM)
            return score_calibration(session, calibration, folder / "packed", load_truth(session.path))
        finally:
            shutil.rmtree(folder)


def _cells(score: CalibrationScore) -> list[str]:
    return [
        f"{score.reflectance_rms:.4f}",
        f"{score.noise_rms:.4f}",
        f"{score.error_over_uncertainty:.2f}",
        f"{100.0 * score.drift_rms:.3f}",
        f"{100.0 * score.flagged_fraction:.2f}",
    ]


if __name__ == "__main__":
    tyro.cli(CalibrationAccuracy).main()
