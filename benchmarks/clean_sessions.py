"""What `inspect` and `process` find in sessions without a mistake: nothing red, nothing that a mistake would give.

    uv run python benchmarks/clean_sessions.py --output-dir OUT

Objects, lights, lenses, detectors and turntables of the simulator, and a real cube of a maize kernel with its white
and its dark, which is inspected only. Thresholds of the checks were chosen on other sessions.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import tyro
from results_table import Benchmark, write_results
from session_mistakes import findings_of_level, run_command

from hsi_sc_nerf.capture.envi import open_cube, write_cube

COLUMNS = ["session", "effects", "inspect: status", "process: status", "red", "amber"]
SIZE_PX, FRAMES = 112, 24
NOISE = ("photon_noise", "read_noise", "dark_pattern")
SESSIONS: dict[str, tuple[str, ...]] = {
    "pear 21": ("chamber_shading", "lamp_drift"),
    "apple 22": ("chamber_shading", "{lamp: {fraction: 0.5}}", "gloss"),
    "maize 23": ("chamber_shading", "inter_reflection"),
    "tomato 24": ("{lamp: {fraction: 0.6}}", "{gloss: {roughness: 0.1}}", "optical_blur"),
    "pepper 25": ("chamber_shading", "{lamp_drift: {percent: -15.0}}", "illumination_falloff"),
    "pear 26": ("textured_background", "lens_distortion", "tarp_exposure"),
    "apple 27": ("{saturation: {exposure_factor: 1.2}}", "bad_pixels", "spectral_smile"),
    "cylinder 28": ("wobble", "angle_jitter"),
    "sphere 29": ("{optical_blur: {sigma_px: 1.2}}", "axis_tilt"),
    "maize 30": ("image_rotation", "clockwise", "chamber_shading"),
    "tomato 31": ("{partial_turn: {span_deg: 180}}", "missing_frames"),
    "pepper 32": ("chamber_shading", "off_centre", "{drying: {water_loss: 0.2}}"),
}
"""Effects beside noise, by scene and seed."""
KERNEL = "4-22-22_right_same_B73_top_00"
REFERENCES = ("white_reference_crop", "dark_reference_crop")
REAL = Path(__file__).parents[1] / "tests" / "real_cubes" / "maize_kernel"


@dataclass(frozen=True)
class CleanSessions(Benchmark):
    """Simulate and check them, and write the table."""

    output_dir: Path
    """Folder for the sessions and datasets; sessions that are there are used again."""
    only: tuple[str, ...] = ()
    """Only these sessions, by name."""

    def main(self) -> None:
        """Do what is missing, print the table, write it."""
        self.output_dir.mkdir(parents=True, exist_ok=True)
        for name, effects in SESSIONS.items():
            if not self.only or name in self.only:
                self._check(name, effects)
        if not self.only:
            self._write("real maize kernel", "", _kernel(self.output_dir / "kernel"), process=False)

    def _check(self, name: str, effects: tuple[str, ...]) -> None:
        scene, seed = name.split()
        session = self.output_dir / f"{scene}-{seed}"
        if not session.is_dir():
            words = ["simulate", scene, str(session), "--frames", str(FRAMES), "--size", str(SIZE_PX), "--seed", seed]
            run_command([*words, "--effects", *NOISE, *effects])
        self._write(name, ", ".join(one.strip("{}").replace("{", "").replace(":", "") for one in effects), session)

    def _write(self, name: str, effects: str, session: Path, process: bool = True) -> None:
        data, found = self.output_dir / "data", Path("inspection.json")
        shutil.rmtree(data, ignore_errors=True)
        inspected, _, _ = run_command(["inspect", str(session), "--output-dir", str(data)])
        processed = "-"
        if process:
            shutil.rmtree(data)
            processed, _, _ = run_command(["process", str(session), "--output-dir", str(data)])
            found = Path("report") / found
        told = [findings_of_level(data / found, level) for level in ("red", "amber")]
        row = [name, effects, str(inspected), str(processed), *told]
        write_results("clean_sessions", COLUMNS, [row], keys=1, folder=self.results)


def _kernel(session: Path) -> Path:
    """A session of the real cubes: the kernel, and as a second frame the same upside down."""
    kernel, white, dark = (open_cube(REAL / f"{name}.hdr") for name in (KERNEL, *REFERENCES))
    frames = {"kernel_1": kernel.read(), "kernel_2": kernel.read()[::-1], "white_reference": white.read()}
    for name, counts in frames.items():
        write_cube(session / f"{name}.hdr", counts, wavelengths_nm=kernel.wavelengths_nm)
        write_cube(session / f"DARKREF_{name}.hdr", dark.read(), wavelengths_nm=kernel.wavelengths_nm)
    return session


if __name__ == "__main__":
    tyro.cli(CleanSessions).main()
