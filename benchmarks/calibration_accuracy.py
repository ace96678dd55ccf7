"""How right calibrated reflectance is, on simulated sessions of which everything is known, as a table.

    uv run python benchmarks/calibration_accuracy.py --page docs/calibration.md --pictures docs/images

Each row is a pear with some effects of light and sensor, calibrated with and without what is meant against them.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from page import write_table
from rich.console import Console
from rich.progress import track
from rich.table import Table

from hsi_sc_nerf import paper
from hsi_sc_nerf.calibration.report import draw_calibration
from hsi_sc_nerf.calibration.session_calibration import CalibrationConfig, calibrate_session
from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.processing.frames import pack_frames
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.scores.calibration import CalibrationScore, score_calibration
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth

FALLOFF = "{illumination_falloff: {edge_loss: 0.2}}"
DRIFT = "{lamp_drift: {percent: -6, temperature_change_k: -80}}"
SENSOR = (
    "{bad_pixels: {dead_share: 0.001, hot_share: 0.001, dead_bands: 2}}",
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
    """Measure how right calibrated reflectance is on simulated sessions."""

    page: Path | None = None
    """Markdown page whose table is replaced."""
    pictures: Path | None = None
    """Folder for the pictures of the last session's calibration."""
    scene: str = "pear"
    """Scene to calibrate."""
    size: int = 128
    """Width and height of the frames, pixels."""
    frames: int = 12
    """Frames of a session."""

    def main(self) -> None:
        """Run and print."""
        scores = {name: self._score(*case) for name, case in track(SESSIONS.items(), "calibrating")}
        rows = [[name, *_cells(score)] for name, score in scores.items()]
        table = Table(
            *COLUMNS, title=f"{self.scene}, {self.frames} frames of {self.size} x {self.size} x {paper.BANDS}"
        )
        for row in rows:
            table.add_row(*row)
        Console().print(table)
        print(json.dumps({name: asdict(score) for name, score in scores.items()}))
        if self.page is not None:
            write_table(self.page, "calibration accuracy", COLUMNS, rows)

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
        f"{100.0 * score.flagged_share:.2f}",
    ]


if __name__ == "__main__":
    tyro.cli(CalibrationAccuracy).main()
