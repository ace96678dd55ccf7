"""Writes a simulated session in the layout of a SPECIM IQ, with the truth beside the captures."""

from __future__ import annotations

import json
import os
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from rich.console import Console
from rich.progress import track

from hsi_sc_nerf.capture.envi import write_cube
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.simulate import truth
from hsi_sc_nerf.simulate.effect import find_effect
from hsi_sc_nerf.simulate.effects.image import ImageRotation
from hsi_sc_nerf.simulate.frames import SimulatedCapture, Simulation
from hsi_sc_nerf.simulate.scene import Scene

WHITE_REFERENCE = "white_reference"
WORKERS = min(8, os.cpu_count() or 2)
"""Number of frames that are simulated at the same time; each takes some hundred MiB at 512 x 512 pixels."""
SENSOR = "simulated SPECIM IQ"
METADATA_XML = """<?xml version="1.0" encoding="UTF-8"?>
<properties xmlns="http://www.specim.fi/iq">
  <dataset>
    <key field="name">{name}</key>
    <key field="sensor">{sensor}</key>
    <key field="integration_time" unit="ms">{integration_time_ms}</key>
  </dataset>
</properties>
"""


def simulate_session(scene: Scene, session_dir: str | Path, progress: bool = True) -> Path:
    """Simulate a turntable session.

    The session is written to a hidden sibling folder and moved into place at the end.

    Args:
        session_dir: folder to write; an earlier simulated session there is replaced.

    Returns:
        ``session_dir``.

    Raises:
        InputError: ``session_dir`` holds something else; the markers do not fit; the disk is full.

    Example:
        >>> session = simulate_session(load_scene("pear"), "pear-session")
        >>> load_truth(session).captures[0]
        'pear_000'
    """
    session_dir = Path(session_dir)
    _check_free(session_dir)
    with Console(stderr=True, quiet=not progress).status(f"preparing {scene.name} and its light"):
        simulation = Simulation(scene)
    with atomic_write(session_dir.absolute()) as (building,):
        building.mkdir()
        _write(simulation, building, progress)
    return session_dir


def _check_free(session_dir: Path) -> None:
    """Check that the folder is new, empty, or an earlier simulated session."""
    if not session_dir.exists() and not session_dir.is_symlink():
        return
    if not session_dir.is_dir() or session_dir.is_symlink():
        raise InputError(f"{session_dir}: is not a folder; choose another place for the session.")
    if any(session_dir.iterdir()) and not (session_dir / "truth" / "truth.json").is_file():
        raise InputError(
            f"{session_dir}: holds something that is not a simulated session; choose a new or an empty folder."
        )


def _write(simulation: Simulation, session_dir: Path, progress: bool) -> None:
    scene = simulation.scene
    truth.write_truth(session_dir, simulation)
    values = _session_values(simulation)
    (session_dir / "session.json").write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    _write_capture(session_dir, WHITE_REFERENCE, simulation.white(), simulation)

    def write_frame(number: int) -> None:
        capture, frame = simulation.captures[number], simulation.frame(number)
        _write_capture(session_dir, capture, frame, simulation)
        truth.write_pixels(session_dir, capture, frame, simulation.endmembers)

    with ThreadPoolExecutor(WORKERS) as pool:
        frames = [pool.submit(write_frame, number) for number in range(len(simulation.captures))]
        try:
            doing = f"simulating {scene.name}"
            for frame in track(as_completed(frames), doing, total=len(frames), disable=not progress):
                frame.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _session_values(simulation: Simulation) -> dict[str, object]:
    """Content of ``session.json``: what a user knows and the instrument does not."""
    scene, plan = simulation.scene, simulation.plan
    rotation = find_effect(scene.effects, ImageRotation)
    return {
        "object": scene.name,
        "nominal_step_deg": plan.nominal_step_deg,
        "direction": plan.direction,
        "marker_dictionary": scene.markers.dictionary,
        "marker_side_m": scene.markers.side_m,
        "container_diameter_m": scene.container.diameter_m,
        "container_height_m": scene.container.height_m,
        "white_reference": WHITE_REFERENCE,
        "image_rotation_deg": 90 * rotation.quarter_turns if rotation else 0,
    }


def _write_capture(session_dir: Path, name: str, capture: SimulatedCapture, simulation: Simulation) -> None:
    folder = session_dir / name / "capture"
    for prefix, cube in (("", capture.counts), ("DARKREF_", capture.dark)):
        write_cube(
            folder / f"{prefix}{name}.hdr",
            cube,
            wavelengths_nm=simulation.wavelengths_nm,
            interleave="bil",
            extra_header={"sensor type": SENSOR, "tint": capture.integration_time_ms},
        )
    metadata = session_dir / name / "metadata"
    metadata.mkdir(exist_ok=True)
    (metadata / f"{name}.xml").write_text(
        METADATA_XML.format(name=name, sensor=SENSOR, integration_time_ms=capture.integration_time_ms),
        encoding="utf-8",
    )
