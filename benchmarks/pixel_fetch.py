"""Time to read a training batch, random pixels of a whole session, from several kinds of files, as a table.

    uv run python benchmarks/pixel_fetch.py --frames 60

Every reader returns the same spectra as float32. "Cold" batches are read from the disk, after the system dropped the
files from its cache; "warm" ones from the cache. Each time is the median over batches of different pixels. Files of
random numbers are made and deleted at the end.
"""

from __future__ import annotations

import mmap
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, Int
from results_table import RESULTS, write_results
from rich.progress import track
from spectral.io import envi

from hsi_sc_nerf import paper
from hsi_sc_nerf.capture.envi import open_cube, write_cube
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, unpack_unflagged, write_packed_cube
from hsi_sc_nerf.packed.pixels import PixelReader

COLUMNS = ["read from", "cold, ms", "warm, ms", "warm, of float32 in RAM", "memory taken, MiB"]
MAX_RAM_FRACTION = 0.7
"""Fraction of the free memory that the frames in RAM may take."""

Indices = Int[np.ndarray, "count 3"]
Fetch = Callable[[Indices], Float[np.ndarray, "count bands"]]


@dataclass(frozen=True)
class PixelFetch:
    """Measure the time to read the pixels of a training batch."""

    frames: int = paper.FRAMES_PER_OBJECT
    """Frames of the session."""
    size: int = 512
    """Width and height of a frame, pixels."""
    bands: int = paper.BANDS
    """Bands of a frame."""
    pixels: int = 4096
    """Pixels of a batch."""
    repeats: int = 7
    """Batches whose median is taken."""
    folder: Path | None = None
    """Folder for the files; the system's temporary folder if not given. A full session takes 13 GB."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Measure, print the table, write it."""
        with tempfile.TemporaryDirectory(prefix="pixel-fetch-", dir=self.folder) as folder:
            raw, packed = self._make_files(Path(folder))
            readers: dict[str, tuple[Sequence[Path], Callable[[], Fetch]]] = {
                "raw BIL, SPy's read_pixel": (raw, lambda: _spy_pixels(raw)),
                "raw BIL, SPy's memory map": (raw, lambda: _spy_maps(raw)),
                "packed BIP, memory map": (packed, lambda: _maps(packed, release=False)),
                "packed BIP, memory map released": (packed, lambda: _maps(packed, release=True)),
                "packed BIP, by position (this package)": (packed, lambda: _by_position(packed)),
            }
            rows: dict[str, tuple[float | None, float, float]] = {
                name: (self._cold(*reader), *self._warm(*reader))
                for name, reader in track(readers.items(), "reading")
            }
            in_ram = min(self.frames, int(MAX_RAM_FRACTION * _free_memory() / (4 * self.size**2 * self.bands)))
            name = "float32 in RAM" + ("" if in_ram == self.frames else f" ({in_ram} frames: no memory for more)")
            ram_ms, taken = self._timed(_ram(packed[:in_ram]), in_ram)
            rows[name] = (None, ram_ms, taken)
        cells = [_cells(name, cold, warm, taken, ram_ms) for name, (cold, warm, taken) in rows.items()]
        write_results("pixel_fetch", COLUMNS, cells, seed="0, 1, 2", folder=self.results)

    def _make_files(self, folder: Path) -> tuple[list[Path], list[Path]]:
        """Headers of a raw and a packed session, made of copies of one frame."""
        shape = (self.size, self.size, self.bands)
        counts = np.random.default_rng(0).integers(0, FLAGGED, shape, dtype=np.uint16)
        wavelengths_nm = np.linspace(*paper.WAVELENGTH_RANGE_NM, self.bands)
        raw = [folder / f"raw_{i:03d}.hdr" for i in range(self.frames)]
        packed = [folder / f"packed_{i:03d}.hdr" for i in range(self.frames)]
        write_cube(raw[0], counts, wavelengths_nm=wavelengths_nm, interleave="bil")
        write_packed_cube(packed[0], counts, wavelengths_nm)
        for first, *others in track((raw, packed), "making files"):
            for other in others:
                shutil.copyfile(first, other)
                shutil.copyfile(_data(first), _data(other))
        return raw, packed

    def _random_pixels(self, rng: np.random.Generator, frames: int) -> Indices:
        return rng.integers(0, (frames, self.size, self.size), (self.pixels, 3))

    def _cold(self, headers: Sequence[Path], opened: Callable[[], Fetch]) -> float | None:
        """Median milliseconds a batch from the disk, or None where the system cannot drop files from its cache."""
        if not hasattr(os, "posix_fadvise"):
            return None
        rng = np.random.default_rng(1)
        seconds = []
        for _ in range(self.repeats):
            for header in headers:
                _drop_from_cache(_data(header))
            fetch, indices = opened(), self._random_pixels(rng, self.frames)
            started = time.perf_counter()
            fetch(indices)
            seconds.append(time.perf_counter() - started)
            del fetch  # mapped files are not dropped
        return 1000 * float(np.median(seconds))

    def _warm(self, headers: Sequence[Path], opened: Callable[[], Fetch]) -> tuple[float, float]:
        for header in headers:
            with _data(header).open("rb") as file:
                while file.read(1 << 24):
                    pass
        return self._timed(opened(), self.frames)

    def _timed(self, fetch: Fetch, frames: int) -> tuple[float, float]:
        """Median milliseconds a batch, and the MiB by which the process grew."""
        rng = np.random.default_rng(2)
        fetch(self._random_pixels(rng, frames))
        seconds, before = [], _resident_mib()
        for _ in range(self.repeats):
            indices = self._random_pixels(rng, frames)
            started = time.perf_counter()
            fetch(indices)
            seconds.append(time.perf_counter() - started)
        return 1000 * float(np.median(seconds)), _resident_mib() - before


def _spy_pixels(headers: Sequence[Path]) -> Fetch:
    """Pixel by pixel, as SPy's manual shows it."""
    images = [envi.open(str(header)) for header in headers]
    return lambda indices: np.array(
        [images[frame].read_pixel(line, sample) for frame, line, sample in indices.tolist()], np.float32
    )


def _spy_maps(headers: Sequence[Path]) -> Fetch:
    """Through SPy's memory maps, a fancy index a frame."""
    return _indexed([envi.open(str(header)).open_memmap(interleave="bip") for header in headers])


def _maps(headers: Sequence[Path], release: bool) -> Fetch:
    """Through memory maps of the packed cubes, whose pages are released after each batch or not."""
    maps, cubes = [], []
    for header in headers:
        cube = open_cube(header)
        with cube.data_path.open("rb") as file:
            maps.append(mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ))
        maps[-1].madvise(mmap.MADV_RANDOM)
        cubes.append(np.frombuffer(maps[-1], cube.dtype).reshape(cube.shape))
    indexed = _indexed(cubes)

    def fetch(indices: Indices) -> np.ndarray:
        spectra = indexed(indices)
        if release:
            for pages in maps:
                pages.madvise(mmap.MADV_DONTNEED)
        return spectra

    return fetch


def _by_position(headers: Sequence[Path]) -> Fetch:
    """As training reads them."""
    reader = PixelReader([np.memmap(_data(h), np.uint16, "r", shape=open_cube(h).shape) for h in headers])
    return lambda indices: unpack_unflagged(reader.read(indices))


def _ram(headers: Sequence[Path]) -> Fetch:
    """From arrays in memory."""
    return _indexed([open_cube(header).read().astype(np.float32) / REFLECTANCE_SCALE for header in headers])


def _indexed(cubes: Sequence[np.ndarray]) -> Fetch:
    def fetch(indices: Indices) -> np.ndarray:
        spectra = np.empty((len(indices), cubes[0].shape[2]), np.float32)
        order = np.argsort(indices[:, 0], kind="stable")
        frames, starts = np.unique(indices[order, 0], return_index=True)
        for frame, rows in zip(frames, np.split(order, starts[1:]), strict=True):
            spectra[rows] = cubes[frame][indices[rows, 1], indices[rows, 2]]
        return spectra

    return fetch


def _data(header: Path) -> Path:
    return header.with_suffix(".raw" if header.name.startswith("raw") else ".bip")


def _drop_from_cache(path: Path) -> None:
    """Drop a file from the system's cache."""
    with path.open("rb") as file:
        os.fsync(file.fileno())  # only what is on the disk can be dropped
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _memory_kib(file: str, field: str) -> int:
    """A field of one of Linux's memory statistics; 0 on other systems."""
    path = Path(file)
    lines = path.read_text(encoding="ascii").splitlines() if path.is_file() else []
    return next((int(line.split()[1]) for line in lines if line.startswith(field)), 0)


def _resident_mib() -> float:
    return _memory_kib("/proc/self/status", "VmRSS:") / 1024


def _free_memory() -> float:
    """Free memory in bytes; half of the machine's memory where the system does not tell."""
    available = 1024 * _memory_kib("/proc/meminfo", "MemAvailable:")
    return available or 0.5 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _cells(name: str, cold_ms: float | None, warm_ms: float, taken_mib: float, ram_ms: float) -> list[str]:
    cold = "-" if cold_ms is None else f"{cold_ms:.0f}"
    return [name, cold, f"{warm_ms:.1f}", f"{warm_ms / ram_ms:.1f}", f"{max(0.0, taken_mib):.0f}"]


if __name__ == "__main__":
    tyro.cli(PixelFetch).main()
