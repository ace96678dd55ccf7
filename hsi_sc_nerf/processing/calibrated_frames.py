"""All frames of a session, calibrated and packed side by side; a run that stopped goes on where it was."""

from __future__ import annotations

import hashlib
import threading
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import fields
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from hsi_sc_nerf.calibration.reflectance import FrameCalibration
from hsi_sc_nerf.calibration.session_calibration import SessionCalibration
from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.processing.fingerprint import capture_files, fingerprint
from hsi_sc_nerf.processing.frames import FrameNotes, FramePaths, finished_notes, process_frame
from hsi_sc_nerf.processing.masks import MaskConfig


def pack_frames(
    session: Session,
    calibration: SessionCalibration,
    output_dir: Path,
    masks: MaskConfig,
    *,
    pseudo_rgb_nm: tuple[float, float, float],
    marker_range_nm: tuple[float, float],
    workers: int,
    progress: bool,
) -> list[FrameNotes]:
    """Notes of all frames, in order; frames that an earlier run finished in the same way are not touched.

    Raises:
        InputError: a raw cube cannot be read or the disk is full.
    """
    settings = [masks.spectral_bins, masks.smoothing_px, pseudo_rgb_nm, marker_range_nm]

    # A worker packs frame after frame in the same memory.
    own = threading.local()
    values = max(cube.shape[0] * cube.shape[1] for cube in calibration.cubes) * len(calibration.bands)

    def work(index: int) -> FrameNotes:
        if not hasattr(own, "buffer"):
            own.buffer = np.empty(values, np.uint16)
        capture, of_frame = session.frames[index], calibration.frames[index]
        paths = FramePaths.of(output_dir, capture.name)
        stamp = fingerprint([settings, capture_files(session, capture), _digest(of_frame)])
        return finished_notes(paths, stamp) or process_frame(
            calibration.cubes[index],
            of_frame,
            paths,
            stamp,
            masks,
            pseudo_rgb_nm=pseudo_rgb_nm,
            marker_range_nm=marker_range_nm,
            buffer=own.buffer,
        )

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        Progress(*columns, console=Console(stderr=True), disable=not progress) as bar,
        ThreadPoolExecutor(workers) as pool,
    ):
        task = bar.add_task("Calibrating frames", total=len(session.frames))
        futures = [pool.submit(work, index) for index in range(len(session.frames))]
        try:
            for future in as_completed(futures):
                future.result()
                bar.advance(task)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [future.result() for future in futures]


def _digest(calibration: FrameCalibration) -> str:
    """Hash of all numbers that a frame's reflectance is made with."""
    digest = hashlib.sha256()
    for field in fields(calibration):
        value = getattr(calibration, field.name)
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()
