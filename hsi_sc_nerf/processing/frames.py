"""Frames of a session, calibrated and packed side by side; a run that stopped goes on where it was.

A frame's cube and pictures are written first and its cache last, so a frame with a cache is finished. An earlier
cache is deleted before the first file is replaced, so that no cache belongs to a cube of other settings. An earlier
run had the same input if the fingerprints of files and settings are equal.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float16, Num, UInt8, UInt16

from hsi_sc_nerf import __version__, paper
from hsi_sc_nerf.calibration.reflectance import FrameCalibration, PictureBands, PixelCounts, pack_counts
from hsi_sc_nerf.calibration.session_calibration import SessionCalibration
from hsi_sc_nerf.capture.envi import Cube, CubeLines, open_cube
from hsi_sc_nerf.capture.session import Capture, Session
from hsi_sc_nerf.capture.session_info import SESSION_INFO_NAME
from hsi_sc_nerf.files import atomic_write, write_png
from hsi_sc_nerf.packed.cube import write_packed_cube
from hsi_sc_nerf.poses.session_pictures import GRAY_NM
from hsi_sc_nerf.processing.foreground_score import smoothed_bins, spectral_bin_width
from hsi_sc_nerf.spectra import bands_within, nearest_bands, to_8_bit
from hsi_sc_nerf.terminal import progress_bar

_DIGEST_BYTES = hashlib.sha256().digest_size
# Settings that change how fast a dataset is made, not what is in it.
_NOT_IN_RESULT = ("workers",)


@dataclass(frozen=True)
class FramePaths:
    """Paths of a frame's files in a packed dataset."""

    image: Path
    cube: Path
    flags: Path
    mask: Path
    bins: Path
    cache: Path

    @staticmethod
    def of(root: Path, capture: str) -> FramePaths:
        """The paths of ``capture`` under ``root``."""
        return FramePaths(
            image=root / "images" / f"{capture}.png",
            cube=root / "cubes" / f"{capture}.hdr",
            flags=root / "flags" / f"{capture}.png",
            mask=root / "masks" / f"{capture}.png",
            bins=root / ".cache" / f"{capture}.bins",
            cache=root / ".cache" / f"{capture}.note",
        )


@dataclass(frozen=True, eq=False)
class FrameCache:
    """What poses, masks and the report need of a frame; images are upright.

    Attributes:
        gray: mean over the marker bands, in which markers are detected.
        bins_path: smoothed spectra (`smoothed_bins`), 16-bit floats.
        bins_shape: bins, lines, samples.
        pixel_counts: numbers of clipped and flagged values by kept band.
    """

    gray: UInt8[np.ndarray, "lines samples"]
    bins_path: Path
    bins_shape: tuple[int, ...]
    pixel_counts: PixelCounts

    @property
    def bins(self) -> Float16[np.ndarray, "bins lines samples"]:
        """The smoothed spectra, mapped anew: in memory while they are used."""
        return np.memmap(self.bins_path, np.float16, "r", shape=self.bins_shape)


class BinsOfFrames(Sequence[Float16[np.ndarray, "bins lines samples"]]):
    """Smoothed spectra of frames. Used one after the other, they take memory for one frame."""

    def __init__(self, caches: Sequence[FrameCache]) -> None:
        self._caches = caches

    def __len__(self) -> int:
        return len(self._caches)

    def __getitem__(self, frame: Any) -> Any:
        return BinsOfFrames(self._caches[frame]) if isinstance(frame, slice) else self._caches[frame].bins


def pack_frames(
    session: Session,
    calibration: SessionCalibration,
    output_dir: Path,
    *,
    pseudo_rgb_nm: tuple[float, float, float] = paper.PSEUDO_RGB_NM,
    workers: int = 2,
    progress: bool = False,
) -> list[FrameCache]:
    """Calibrate and pack all frames of a session; frames that an earlier run finished in the same way are kept.

    Args:
        pseudo_rgb_nm: wavelengths shown as red, green and blue.
        workers: frames that are calibrated at the same time.

    Returns:
        The frames' caches, in the session's order.

    Raises:
        InputError: a raw cube cannot be read, or the operating system refused to write.

    Example:
        >>> session = open_session("apple_01")
        >>> caches = pack_frames(session, calibrate_session(session, CalibrationConfig()), Path("apple_01-data"))
        >>> caches[0].gray.shape
    """
    # A worker packs frame after frame in the same memory.
    own = threading.local()
    num_values = max(cube.shape[0] * cube.shape[1] for cube in calibration.cubes) * len(calibration.bands)

    def pack(index: int) -> FrameCache:
        if not hasattr(own, "buffer"):
            own.buffer = np.empty(num_values, np.uint16)
        capture, frame_calibration = session.frames[index], calibration.frames[index]
        paths = FramePaths.of(output_dir, capture.name)
        cube = calibration.cubes[index]
        # Wavelengths may come from another file than the capture's.
        settings = [pseudo_rgb_nm, cube.wavelengths_nm.tolist(), _digest(frame_calibration)]
        key = fingerprint([capture_files(session, capture), settings])
        return read_cache(paths, key) or process_frame(
            cube,
            frame_calibration,
            paths,
            key,
            pseudo_rgb_nm=pseudo_rgb_nm,
            buffer=own.buffer,
        )

    num_frames = len(session.frames)
    bar = progress_bar("calibrating", "frames", num_frames) if progress else nullcontext(lambda amount: None)
    with bar as update, ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(pack, index) for index in range(num_frames)]
        try:
            for done, future in enumerate(as_completed(futures), start=1):
                future.result()
                update(done)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [future.result() for future in futures]


def process_frame(
    cube: Cube,
    calibration: FrameCalibration,
    paths: FramePaths,
    fingerprint: str,
    *,
    pseudo_rgb_nm: tuple[float, float, float] = paper.PSEUDO_RGB_NM,
    buffer: UInt16[np.ndarray, "values"] | None = None,
) -> FrameCache:
    """Calibrate a frame's raw cube; write its packed cube, flags, pseudo-RGB image and cache, all upright.

    Args:
        cube: raw counts, or finished reflectance.
        fingerprint: fingerprint of what the frame is made from, kept in its cache.
        pseudo_rgb_nm: as in `pack_frames`.
        buffer: memory to pack in (`pack_counts`), which several frames may use in turn.

    Raises:
        InputError: as `pack_frames`.
    """
    wavelengths_nm = cube.wavelengths_nm[calibration.bands]
    widths_nm = None if cube.fwhm_nm is None else cube.fwhm_nm[calibration.bands]
    picture_bands = PictureBands(
        rgb=nearest_bands(wavelengths_nm, pseudo_rgb_nm),
        gray=bands_within(wavelengths_nm, GRAY_NM),
        bin_width=spectral_bin_width(len(wavelengths_nm)),
    )
    with CubeLines(cube) as lines:
        frame = pack_counts(lines, calibration, picture_bands, buffer)

    def upright(image: Num[np.ndarray, "lines samples *channels"]) -> Num[np.ndarray, "h w *channels"]:
        return np.rot90(image, calibration.quarter_turns)

    paths.cache.unlink(missing_ok=True)
    write_packed_cube(paths.cube, upright(frame.packed), wavelengths_nm, widths_nm)
    write_png(paths.flags, upright(frame.flags))
    write_png(paths.image, upright(to_8_bit(np.moveaxis(frame.rgb, 0, -1))))
    bins = np.ascontiguousarray(np.rot90(smoothed_bins(frame.binned), calibration.quarter_turns, axes=(1, 2)))
    with atomic_write(paths.bins) as (temporary,):
        bins.tofile(temporary)
    gray = upright(to_8_bit(frame.gray))
    note = io.BytesIO()
    np.savez(note, fingerprint=fingerprint, gray=gray, shape_of_bins=bins.shape, **vars(frame.pixel_counts))
    with atomic_write(paths.cache) as (temporary,):
        temporary.write_bytes(hashlib.sha256(note.getvalue()).digest() + note.getvalue())
    return FrameCache(gray, paths.bins, bins.shape, frame.pixel_counts)


def read_cache(paths: FramePaths, fingerprint: str) -> FrameCache | None:
    """The cache of a frame that was finished from the same files with the same settings, or None."""
    try:
        content = paths.cache.read_bytes()
        digest, note = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
        # What is damaged by chance is never parsed.
        if hashlib.sha256(note).digest() != digest:
            return None
        with np.load(io.BytesIO(note)) as stored:
            if str(stored["fingerprint"]) != fingerprint:
                return None
            pixel_counts = PixelCounts(**{f.name: stored[f.name] for f in fields(PixelCounts)})
            shape = tuple(map(int, stored["shape_of_bins"]))
            cache = FrameCache(stored["gray"], paths.bins, shape, pixel_counts)
        open_cube(paths.cube)
        whole = paths.bins.stat().st_size == np.dtype(np.float16).itemsize * math.prod(shape)
    except Exception:  # what readers of archives raise has no common class, and the digest may be forged
        return None
    return cache if whole and paths.image.is_file() and paths.flags.is_file() else None


def _digest(calibration: FrameCalibration) -> str:
    """Hash of all numbers that a frame's reflectance is computed with."""
    digest = hashlib.sha256()
    for field in fields(calibration):
        value = getattr(calibration, field.name)
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()


def session_fingerprint(session: Session, config: Any, files: Iterable[Path] = ()) -> str:
    """Fingerprint of a whole session and of the settings that it is processed with.

    Args:
        session: its files count by name, size and time of last change.
        config: settings, a dataclass; the number of workers does not count.
        files: further files that the settings name; those that do not exist are left out.
    """
    named = _stamps(session.path, [path for path in files if path.is_file()])
    settings = {name: value for name, value in asdict(config).items() if name not in _NOT_IN_RESULT}
    # What is left out takes a place in the turn, unless it is a copy.
    places = [session.places] if session.damaged or session.excluded else []
    return fingerprint([session_files(session), settings, named, *places])


def fingerprint(content: Any) -> str:
    """Hash of JSON content and of this package's version."""
    text = json.dumps([__version__, content], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def session_files(session: Session) -> list[list[tuple[str, int, int]]]:
    """Name, size and time of last change of all files of a session, those that all frames share first.

    These are ``session.json``, the files it names, and the tarp.
    """
    names = (SESSION_INFO_NAME, session.info.band_centres, session.info.panel_reflectance)
    paths = [session.path / name for name in names if name is not None]
    shared = _stamps(session.path, [path for path in paths if path.is_file()])
    if session.white is not None:
        shared += capture_files(session, session.white)
    return [shared, *(capture_files(session, frame) for frame in session.frames)]


def capture_files(session: Session, capture: Capture) -> list[tuple[str, int, int]]:
    """Name, size and time of last change of the files that belong to one capture."""
    paths = [path for cube in capture.cubes for path in (cube.header_path, cube.data_path)]
    if capture.metadata is not None:
        paths.append(capture.metadata.path)
    return _stamps(session.path, paths)


def _stamps(root: Path, paths: Iterable[Path]) -> list[tuple[str, int, int]]:
    return [(os.path.relpath(p, root), p.stat().st_size, p.stat().st_mtime_ns) for p in paths]
