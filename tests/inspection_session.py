"""A small session of a marker turntable with an object on it, for the checks of sessions."""

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
from turntable_scene import MarkerScene

from hsi_sc_nerf.capture.envi import write_cube

WAVELENGTHS_NM = np.linspace(420.0, 900.0, 9)
INFO = {"object": "fruit", "marker_side_m": 0.03, "marker_dictionary": "DICT_5X5_50"}
LAMP = 1500.0 + 200.0 * np.arange(9)
DARK = 100
READ_NOISE_COUNTS = 4
SIZE_PX = 128


def frame_picture(
    gray: np.ndarray, radius_px: float = 24.0, spot_px: float = 0.0, angle_deg: float = 0.0
) -> np.ndarray:
    """Reflectance: the turntable, and a fruit on it whose dark spot turns with it."""
    y, x = np.mgrid[: gray.shape[0], : gray.shape[1]]
    centre = (gray.shape[1] / 2, 0.3 * gray.shape[0])
    fruit = np.hypot(x - centre[0], y - centre[1]) < radius_px
    place = centre[0] + 0.6 * radius_px * np.sin(np.deg2rad(angle_deg))
    spot = (np.hypot(x - place, y - centre[1]) < spot_px) & (np.cos(np.deg2rad(angle_deg)) > 0.0)
    plant = np.where(WAVELENGTHS_NM < 690.0, 0.15, 0.55)
    image = np.repeat(gray[..., None] / 255.0, len(WAVELENGTHS_NM), axis=-1)
    image[fruit] = plant
    image[fruit & spot] = 0.3 * plant
    return image


def write_one(folder: Path, name: str, reflectance: np.ndarray, *, seed: int = 0, **fields) -> None:
    """A capture with a dark cube, with read noise."""
    rng = np.random.default_rng([seed, sum(name.encode())])
    counts = np.clip(reflectance * LAMP + DARK + rng.normal(0, READ_NOISE_COUNTS, reflectance.shape), 0, 4095)
    dark = rng.normal(DARK, READ_NOISE_COUNTS, (2, *reflectance.shape[1:]))
    for prefix, cube in (("", counts), ("DARKREF_", dark)):
        write_cube(
            folder / name / "capture" / f"{prefix}{name}.hdr",
            np.rint(cube).astype(np.uint16),
            wavelengths_nm=WAVELENGTHS_NM,
            extra_header={"tint": 10, "acquisition date": "03-02-2021", **fields},
        )


def write_white(folder: Path, reflectance: float, **fields) -> None:
    """The tarp, evenly of one reflectance."""
    write_one(folder, "white_reference", np.full((SIZE_PX, SIZE_PX, len(WAVELENGTHS_NM)), reflectance), **fields)


def write_turntable(
    folder: Path, frames: int = 12, *, info: dict | None = None, quarter_turns: int = 0, clockwise: bool = False
) -> Path:
    """Frames ``fruit_00`` ..., turned by ``np.rot90``'s ``quarter_turns`` from upright, and the tarp."""
    pictures = rendered(frames)[:: -1 if clockwise else 1]
    for number, image in enumerate(pictures):
        write_one(folder, f"fruit_{number:02d}", np.rot90(image, quarter_turns))
    write_white(folder, 0.98)
    if info is not None:
        (folder / "session.json").write_text(json.dumps(info))
    return folder


@lru_cache(maxsize=2)
def rendered(frames: int) -> list[np.ndarray]:
    """Reflectance of the frames of a whole turn, counter-clockwise."""
    turntable = MarkerScene(size_px=SIZE_PX, frames=frames, target_height_m=0.08)
    angles_deg = turntable.angles_deg
    return [
        frame_picture(gray, spot_px=7.0, angle_deg=angle)
        for gray, angle in zip(turntable.render(), angles_deg, strict=True)
    ]
