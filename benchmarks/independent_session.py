"""A turntable session that shares no code with our simulator: path-traced by Mitsuba 3, written as a SPECIM IQ does.

    uv run python benchmarks/independent_session.py SESSION

A glossy lumpy fruit on a white container turns clockwise before a wooden wall, under two lamps in a white room.
Markers lie on the disc only. The lamps lose 5 % of their light (10 % in the blue). The path tracer's noise stays in:
about 5 % a pixel, common to all bands of a pixel and independent from frame to frame. The pictures are upright.

Three renderings of three wavelengths each use the same paths. The 204 bands are mixed from these nine: spectra of
materials and their products (one bounce) are linear combinations of their values there, by least squares.

``truth/`` holds truth.json (camera, poses, angles, markers, spectra, drift), masks.npz (fraction of each pixel that
the fruit covers) and mesh.ply.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float
from path_traced_scene import (
    CONTAINER_HEIGHT_M,
    CONTAINER_RADIUS_M,
    DICTIONARY,
    MARKER_SIDE_M,
    MATERIALS,
    Fruit,
    PathTracedScene,
    camera_pose,
    marker_poses,
    stop_angles_deg,
)
from rich.progress import track

BANDS = np.linspace(397.66, 1003.81, 204)
NODES_NM = np.array([[420.0, 680.0, 860.0], [470.0, 645.0, 965.0], [520.0, 570.0, 720.0]])
"""Rendered wavelengths; a row is one rendering."""
NAME, WHITE = "quince", "tarp"
DRIFT, DRIFT_BLUE = 0.05, 0.10
"""Loss of light over the session above 550 nm, and at 400 nm."""
DARK, DARK_PATTERN, LARGEST, WHITE_LEVEL = 96.0, 4.0, 4095, 0.8
ELECTRONS_PER_COUNT, READ_NOISE_COUNTS = 8.0, 4.0
TINT_MS = 98.0
DATE = "14-10-2026"
DARK_LINES = 32
HEADER = """ENVI
description = {{Data recorded with Specim IQ}}
samples = {samples}
lines = {lines}
bands = 204
header offset = 0
file type = ENVI Standard
data type = 12
interleave = BIL
sensor type = SPECIM IQ
byte order = 0
default bands = {{70,53,19}}
latitude = 0
longitude = 0
acquisition date = {date}
errors = none
binning = {{1,1}}
tint = {tint:g}
fps = 10.2041
wavelength = {{{wavelengths}}}
"""
METADATA = """<?xml version="1.0" encoding="UTF-8"?>
<properties xmlns="http://www.specim.fi/iq">
  <dataset>
    <key field="name">{name}</key>
    <key field="camera">Specim IQ</key>
    <key field="date">{date}</key>
    <key field="integration_time">{tint:g}</key>
    <key field="WR_mode">custom</key>
  </dataset>
</properties>
"""


@dataclass(frozen=True)
class IndependentSession:
    """Render and write the session."""

    session: tyro.conf.Positional[Path]
    """Folder of the session; an earlier one is replaced."""
    frames: int = 30
    """Frames of one turn."""
    size: int = 128
    """Width and height of the images, pixels."""
    rays: int = 64
    """Rays in each pixel; fewer make more noise."""
    fruit: Fruit = "quince"
    """Shape of the fruit."""
    seed: int = 0
    """Seed of paths, angles and noise."""

    def main(self) -> None:
        """Render, mix, expose and write."""
        shutil.rmtree(self.session, ignore_errors=True)
        rng = np.random.default_rng(self.seed)
        scene = PathTracedScene(NODES_NM, self.size, self.rays, self.fruit, seed=self.seed)
        angles_deg = stop_angles_deg(self.frames, rng)
        mixing, pattern = mixing_matrix(), rng.normal(0.0, DARK_PATTERN, (self.size, len(BANDS)))
        names = [f"{NAME}_{number:03d}" for number in range(self.frames)]
        drift = lamp_drift(self.frames)

        self._write(WHITE, scene.tarp(1000) @ mixing, pattern, rng)
        masks = []
        for number, angle_deg in track(list(enumerate(angles_deg)), "rendering"):
            radiance = scene.radiance(angle_deg, number) @ mixing
            self._write(names[number], radiance * drift[number], pattern, rng)
            masks.append(scene.coverage(angle_deg))
        self._write_truth(names, angles_deg, masks, drift, scene)

    def _write(
        self, name: str, radiance: Float[np.ndarray, "h w bands"], pattern: np.ndarray, rng: np.random.Generator
    ) -> None:
        """One capture's folder: counts and dark with the sensor's noise, headers, XML."""
        signal = radiance * white_signal()
        electrons = rng.poisson(np.maximum(signal, 0.0) * ELECTRONS_PER_COUNT)
        folder = self.session / name
        (folder / "capture").mkdir(parents=True)
        (folder / "metadata").mkdir()
        lightless = np.zeros((DARK_LINES, self.size, len(BANDS)))
        for prefix, light in (("", electrons / ELECTRONS_PER_COUNT), ("DARKREF_", lightless)):
            counts = light + DARK + pattern + rng.normal(0.0, READ_NOISE_COUNTS, light.shape)
            cube = np.clip(np.rint(counts), 0, LARGEST).astype("<u2")
            # BIL: for each line, band by band.
            (folder / "capture" / f"{prefix}{name}.raw").write_bytes(np.moveaxis(cube, -1, 1).tobytes())
            wavelengths = ", ".join(f"{nm:.2f}" for nm in BANDS)
            header = HEADER.format(
                samples=self.size, lines=len(cube), date=DATE, tint=TINT_MS, wavelengths=wavelengths
            )
            (folder / "capture" / f"{prefix}{name}.hdr").write_text(header, encoding="utf-8")
        metadata = METADATA.format(name=name, date=DATE, tint=TINT_MS)
        (folder / "metadata" / f"{name}.xml").write_text(metadata, encoding="utf-8")

    def _write_truth(
        self,
        names: list[str],
        angles_deg: np.ndarray,
        masks: list[np.ndarray],
        drift: np.ndarray,
        scene: PathTracedScene,
    ) -> None:
        stated = {
            "object": NAME,
            "white_reference": WHITE,
            "nominal_step_deg": 360.0 / self.frames,
            "direction": "cw",
            "marker_dictionary": DICTIONARY,
            "marker_side_m": MARKER_SIDE_M,
            "container_diameter_m": 2 * CONTAINER_RADIUS_M,
            "container_height_m": CONTAINER_HEIGHT_M,
            "image_rotation_deg": 0,
        }
        (self.session / "session.json").write_text(json.dumps(stated, indent=1), encoding="utf-8")
        folder = self.session / "truth"
        folder.mkdir()
        centre = self.size / 2.0
        truth = {
            "intrinsics": {
                "w": self.size,
                "h": self.size,
                "fl_x": scene.focal_px,
                "fl_y": scene.focal_px,
                "cx": centre,
                "cy": centre,
            },
            "frames": [
                {
                    "capture": name,
                    "angle_deg": angle_deg,
                    "camera_to_world": camera_pose(angle_deg).tolist(),
                    "drift": of_frame.tolist(),
                }
                for name, angle_deg, of_frame in zip(names, angles_deg.tolist(), drift, strict=True)
            ],
            "marker_layout": {number: corners.tolist() for number, (_, corners) in marker_poses().items()},
            "wavelengths_nm": BANDS.tolist(),
            "reflectance": {name: spectrum(BANDS).tolist() for name, spectrum in MATERIALS.items()},
            "mesh": {"area_m2": scene.mesh.area, "volume_m3": scene.mesh.volume},
        }
        (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8")
        np.savez_compressed(folder / "masks.npz", **dict(zip(names, np.array(masks, np.float16), strict=True)))
        scene.mesh.export(folder / "mesh.ply")


def mixing_matrix() -> Float[np.ndarray, "9 bands"]:
    """Weights of the nine rendered wavelengths in each band: exact for materials and products of two, nearly."""
    nodes_nm = NODES_NM.ravel()

    def table(nm: np.ndarray) -> np.ndarray:
        spectra = np.array([np.ones_like(nm), *(spectrum(nm) for spectrum in MATERIALS.values())])
        # Light that has met two materials counts less than that of one.
        products = [0.2 * a * b for i, a in enumerate(spectra[1:9]) for b in spectra[1 : i + 2]]
        return np.concatenate([spectra, products])

    return np.linalg.lstsq(table(nodes_nm), table(BANDS), rcond=1e-3)[0]


def white_signal() -> Float[np.ndarray, "bands"]:
    """Counts above dark of reflectance 1: tungsten light on a silicon detector."""
    light = (BANDS / 1000.0) ** -4 / np.expm1(1.438776877e7 / (BANDS * 2900.0))
    electrons = light * (0.1 + 0.55 * np.exp(-(((BANDS - 620.0) / 210.0) ** 2)))
    return electrons / electrons.max() * (WHITE_LEVEL * LARGEST - DARK)


def lamp_drift(frames: int) -> Float[np.ndarray, "frames bands"]:
    """Ratio of the lamps' light to that on the tarp, which was taken before the first frame."""
    progress = 1.0 - np.exp(-np.arange(1, frames + 1) / (0.4 * frames))
    loss = DRIFT + (DRIFT_BLUE - DRIFT) * np.clip((550.0 - BANDS) / 150.0, 0.0, 1.0)
    return 1.0 - progress[:, None] / progress[-1] * loss


if __name__ == "__main__":
    tyro.cli(IndependentSession).main()
