"""Writes a simulated turntable session as a SPECIM IQ would leave it, with the truth beside the captures."""

from __future__ import annotations

import json
import os
import shutil
import uuid
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt16
from rich.progress import track

from hsi_sc_nerf.data.envi import write_cube
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate import assemble, truth
from hsi_sc_nerf.simulate.materials import endmembers
from hsi_sc_nerf.simulate.scene import Scene
from hsi_sc_nerf.simulate.sensor import band_centres_nm, expose, white_signal
from hsi_sc_nerf.simulate.target import marker_layout

WHITE_REFERENCE = "white_reference"
WHITE_MATERIALS = ("white_tarp", "tarp_surround")
TARP_MARGIN = 0.08
"""Share of the image's side that the tarp leaves free along each edge."""
DARK_LINES = 1
METADATA_XML = """<?xml version="1.0" encoding="UTF-8"?>
<properties xmlns="http://www.specim.fi/iq">
  <dataset>
    <key field="name">{name}</key>
    <key field="sensor">simulated SPECIM IQ</key>
    <key field="integration time" unit="ms">10</key>
  </dataset>
</properties>
"""


def simulate_session(scene: Scene, session_dir: str | Path, progress: bool = True) -> Path:
    """Render the scene's turntable session into ``session_dir``; returns that path.

    The session is built in a hidden sibling folder and moved into place at the end, so a stopped run leaves no
    half session. An earlier simulated session at the same place is replaced.

    Raises:
        InputError: ``session_dir`` holds something else; the markers do not fit; the disk is full.
    """
    session_dir = Path(session_dir)
    _check_free(session_dir)
    building = session_dir.absolute().parent / f".partial-{uuid.uuid4().hex[:8]}-{session_dir.absolute().name}"
    try:
        building.mkdir(parents=True)
        _write(scene, building, progress)
        _move_into_place(building, session_dir)
    except OSError as error:
        raise InputError(
            f"{session_dir}: cannot be written ({error.strerror or error}); free some space or choose another folder."
        ) from error
    finally:
        shutil.rmtree(building, ignore_errors=True)
    return session_dir


def white_capture_weights(size_px: int) -> Float[np.ndarray, "lines samples 2"]:
    """Shares of tarp and of its dark surround: the tarp fills most of the image."""
    edge = max(1, round(TARP_MARGIN * size_px))
    tarp = np.zeros((size_px, size_px), np.float32)
    tarp[edge:-edge, edge:-edge] = 1.0
    return np.stack([tarp, 1.0 - tarp], axis=-1)


def _check_free(session_dir: Path) -> None:
    """A new or empty folder, or an earlier simulated session; never anything that was measured."""
    if not session_dir.exists() and not session_dir.is_symlink():
        return
    if not session_dir.is_dir() or session_dir.is_symlink():
        raise InputError(f"{session_dir}: is not a folder; choose another place for the session.")
    if any(session_dir.iterdir()) and not (session_dir / "truth" / "truth.json").is_file():
        raise InputError(
            f"{session_dir}: holds something that is not a simulated session; choose a new or an empty folder."
        )


def _move_into_place(building: Path, session_dir: Path) -> None:
    if not session_dir.exists():
        os.rename(building, session_dir)
        return
    earlier = building.with_name(building.name + "-earlier")
    os.rename(session_dir, earlier)
    try:
        os.rename(building, session_dir)
    except OSError:
        os.rename(earlier, session_dir)
        raise
    shutil.rmtree(earlier, ignore_errors=True)


def _write(scene: Scene, session_dir: Path, progress: bool) -> None:
    wavelengths_nm = band_centres_nm(scene.sensor.bands)
    signal = white_signal(scene.sensor, wavelengths_nm)
    intrinsics = assemble.intrinsics(scene.camera)
    poses = assemble.camera_poses(scene)
    captures = [f"{scene.name}_{i:03d}" for i in range(len(poses))]
    thing = assemble.object_part(scene)
    renderer = assemble.build_renderer(scene, thing)
    spectra = endmembers(renderer.materials, wavelengths_nm)

    truth.write_truth(
        session_dir,
        scene,
        intrinsics=intrinsics,
        captures=captures,
        angles_deg=assemble.turntable_angles_deg(scene.turntable),
        camera_to_world=poses,
        marker_layout=marker_layout(scene.markers, scene.container, scene.turntable),
        wavelengths_nm=wavelengths_nm,
        materials=renderer.materials,
        endmembers=spectra,
        mesh=thing.mesh,
    )
    (session_dir / "session.json").write_text(json.dumps(_session_values(scene), indent=1) + "\n", encoding="utf-8")
    dark = np.full((DARK_LINES, scene.camera.size_px, scene.sensor.bands), scene.sensor.dark_level, np.uint16)
    white = expose(
        white_capture_weights(scene.camera.size_px), endmembers(WHITE_MATERIALS, wavelengths_nm), scene.sensor, signal
    )
    _write_capture(session_dir, WHITE_REFERENCE, white, dark, wavelengths_nm)
    frames = zip(captures, poses, strict=True)
    description = f"simulating {scene.name}"
    for capture, pose in track(frames, description, total=len(poses), disable=not progress):
        weights, coverage = renderer.render(intrinsics, pose, scene.camera.supersampling)
        _write_capture(session_dir, capture, expose(weights, spectra, scene.sensor, signal), dark, wavelengths_nm)
        truth.write_pixels(session_dir, capture, weights, coverage)


def _session_values(scene: Scene) -> dict[str, object]:
    """What the instrument can't tell, as a user would write it down."""
    return {
        "object": scene.object.shape,
        "nominal_step_deg": 360.0 / scene.turntable.frames,
        "direction": scene.turntable.direction,
        "marker_dictionary": scene.markers.dictionary,
        "marker_side_m": scene.markers.side_m,
        "container_diameter_m": scene.container.diameter_m,
        "container_height_m": scene.container.height_m,
        "white_reference": WHITE_REFERENCE,
    }


def _write_capture(
    session_dir: Path,
    name: str,
    counts: UInt16[np.ndarray, "lines samples bands"],
    dark: UInt16[np.ndarray, "dark_lines samples bands"],
    wavelengths_nm: Float[np.ndarray, "bands"],
) -> None:
    folder = session_dir / name / "capture"
    write_cube(folder / f"{name}.hdr", counts, wavelengths_nm=wavelengths_nm, interleave="bil")
    write_cube(folder / f"DARKREF_{name}.hdr", dark, wavelengths_nm=wavelengths_nm, interleave="bil")
    metadata = session_dir / name / "metadata"
    metadata.mkdir()
    (metadata / f"{name}.xml").write_text(METADATA_XML.format(name=name), encoding="utf-8")
