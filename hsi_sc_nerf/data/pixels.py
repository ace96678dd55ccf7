"""Random pixels of packed cubes on disk: a training batch reads those pixels and nothing else."""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import cached_property
from io import FileIO
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, UInt16

from hsi_sc_nerf.data.packed_cube import unpack, unpack_unflagged
from hsi_sc_nerf.data.regions import dilate
from hsi_sc_nerf.errors import InputError

RIM_PX = 3
"""The rim of the foreground is so wide: the pixels just beside it, which decide where the object ends."""


class PixelReader:
    """The spectra of single pixels, read from their places in the files.

    Memory stays what one batch needs. Reading through the memory maps would count every page that was ever touched as
    this process's own (a whole session after some hundred batches), and to give the pages back between batches
    costs three times as much as to read by position. Before a batch is read, the system is told of all its places:
    a disk then serves many at once (benchmarks/pixel_fetch.py).

    Args:
        cubes: memory maps of BIP cubes of one shape, one a frame; a generator of them never has more than two open,
            each of which is one of the files that a process may hold. Only where the system cannot read by position
            (Windows) are they kept and read through.
    """

    def __init__(self, cubes: Iterable[np.memmap]) -> None:
        by_position = hasattr(os, "pread")
        self._paths: list[Path] = []
        self._files: list[FileIO] = []
        self._cubes: list[np.memmap] = []
        starts = []
        for cube in cubes:
            self.shape: tuple[int, int, int] = cube.shape
            self.dtype = cube.dtype
            self._paths.append(Path(str(cube.filename)))
            starts.append(cube.offset)
            if by_position:
                self._files.append(self._paths[-1].open("rb", buffering=0))
            else:
                self._cubes.append(cube)
        self._starts = np.array(starts)

    def close(self) -> None:
        """Give the files back: for a reader that is done before the process is."""
        for file in self._files:
            file.close()
        self._cubes.clear()

    def read(self, indices: Int[np.ndarray, "count 3"]) -> UInt16[np.ndarray, "count bands"]:
        """Packed spectra at (frame, line, sample).

        Raises:
            InputError: a file became shorter since it was opened.
        """
        return self._read_by_position(indices) if self._files else self._read_through_maps(indices)

    def _read_by_position(self, indices: np.ndarray) -> np.ndarray:
        _, samples, bands = self.shape
        size = bands * self.dtype.itemsize
        frames, pixels = indices[:, 0], indices[:, 1] * samples + indices[:, 2]
        offsets = (self._starts[frames] + pixels * size).tolist()
        files = [self._files[frame].fileno() for frame in frames.tolist()]
        sizes = [size] * len(files)
        if hasattr(os, "posix_fadvise"):
            for file, offset in zip(files, offsets, strict=True):
                os.posix_fadvise(file, offset, size, os.POSIX_FADV_WILLNEED)
        spectra = b"".join(map(os.pread, files, sizes, offsets))
        if len(spectra) != size * len(files):
            raise InputError(f"{self._paths[0].parent}: a cube became shorter while it was in use; process again.")
        return np.frombuffer(spectra, self.dtype).reshape(len(files), bands)

    def _read_through_maps(self, indices: np.ndarray) -> np.ndarray:
        spectra = np.empty((len(indices), self.shape[2]), self.dtype)
        for frame in np.unique(indices[:, 0]):
            rows = np.flatnonzero(indices[:, 0] == frame)
            spectra[rows] = self._cubes[frame][indices[rows, 1], indices[rows, 2]]
        return spectra


class PixelSampler:
    """Batches of random pixels of a set of frames; the same seed and step give the same batch.

    A resumed run therefore sees the batches that an uninterrupted one would have seen.

    Args:
        reader: of the frames' packed cubes.
        masks: foreground of each frame.
        num_rays_per_batch: pixels a batch.
        seed: part of every batch's seed.
        has_flagged: whether the cubes hold values that are no measurements.
    """

    def __init__(
        self,
        reader: PixelReader,
        masks: Bool[np.ndarray, "frames lines samples"],
        num_rays_per_batch: int,
        seed: int,
        *,
        has_flagged: bool,
    ) -> None:
        self.reader = reader
        self.masks = masks
        self.num_rays_per_batch = num_rays_per_batch
        self.seed = seed
        self._foreground = np.flatnonzero(masks)
        # How many pixels of the rest lie before each pixel of the foreground.
        self._rest_before = self._foreground - np.arange(len(self._foreground))
        self._values = _measured_values if has_flagged else _values

    def sample(
        self, step: int, foreground_share: float | None = None, rim_share: float = 0.0
    ) -> dict[str, np.ndarray]:
        """One batch: what `at` returns for the pixels that `draw` draws."""
        return self.at(self.draw(step, foreground_share, rim_share))

    def draw(
        self, step: int, foreground_share: float | None = None, rim_share: float = 0.0
    ) -> Int[np.ndarray, "count 3"]:
        """The pixels (frame, line, sample) of one batch.

        Args:
            step: training step.
            foreground_share: share of the pixels drawn from the foreground, in [0, 1], the others from the rest of
                the frames; ``None`` draws evenly from whole frames.
            rim_share: share of those others that is drawn from the foreground's rim.

        Raises:
            InputError: pixels of the foreground, or of the rest, are asked for, and there are none.
        """
        rng = np.random.default_rng((self.seed, step))
        count = self.num_rays_per_batch
        if foreground_share is None:
            flat = rng.integers(0, self.masks.size, count)
        else:
            in_foreground = round(count * foreground_share)
            if in_foreground > 0 and len(self._foreground) == 0:
                raise InputError(
                    "the masks of all training frames are empty, so that there is no object to train on; look at "
                    "report/ in the dataset and process again."
                )
            in_rim = round((count - in_foreground) * rim_share) if rim_share > 0.0 and len(self._rim) > 0 else 0
            in_rest, num_rest = count - in_foreground - in_rim, self.masks.size - len(self._foreground)
            if in_rest > 0 and num_rest == 0:
                raise InputError(
                    "the masks of all training frames cover whole images, so that nothing tells where the object "
                    "ends; look at report/ in the dataset and process again with a larger --masks.threshold."
                )
            drawn = [
                self._foreground[rng.integers(0, len(self._foreground), in_foreground)],
                self._rest(rng.integers(0, num_rest, in_rest)),
            ]
            if in_rim > 0:
                drawn.append(self._rim[rng.integers(0, len(self._rim), in_rim)])
            flat = np.concatenate(drawn)
        return np.stack(np.unravel_index(flat, self.masks.shape), axis=1)

    def at(self, indices: Int[np.ndarray, "count 3"]) -> dict[str, np.ndarray]:
        """Given pixels (frame, line, sample).

        Returns:
            ``indices`` (count, 3) int64: frame, line, sample; ``spectral`` (count, bands) float32 reflectance;
            ``mask`` (count, 1) bool: foreground; where the cubes have flagged values also ``valid`` (count, bands)
            bool: which of ``spectral`` were measured (0 otherwise).
        """
        frame, line, sample = indices.T
        return {
            "indices": indices,
            "mask": self.masks[frame, line, sample, None],
            **self._values(self.reader.read(indices)),
        }

    @cached_property
    def _rim(self) -> Int[np.ndarray, "count"]:
        """The pixels outside the foreground that are at most ``RIM_PX`` from it."""
        return np.flatnonzero(np.stack([dilate(mask, 2 * RIM_PX + 1) & ~mask for mask in self.masks]))

    def _rest(self, ranks: Int[np.ndarray, "count"]) -> Int[np.ndarray, "count"]:
        """The pixels with these places among all that are not foreground.

        A list of the rest would be a session's largest: a pixel has as many of the foreground before it as have no
        more of the rest before them than it has.
        """
        return ranks + np.searchsorted(self._rest_before, ranks, side="right")


def spread_over(masks: Bool[np.ndarray, "frames lines samples"], count: int) -> Int[np.ndarray, "at_most_count 3"]:
    """Pixels (frame, line, sample) evenly spread over the foreground in reading order, fewer where it is smaller."""
    foreground = np.flatnonzero(masks)
    count = min(count, len(foreground))
    chosen = foreground[((np.arange(count) + 0.5) / max(count, 1) * len(foreground)).astype(int)]
    return np.stack(np.unravel_index(chosen, masks.shape), axis=1)


def _values(counts: UInt16[np.ndarray, "count bands"]) -> dict[str, np.ndarray]:
    return {"spectral": unpack_unflagged(counts)}


def _measured_values(counts: UInt16[np.ndarray, "count bands"]) -> dict[str, np.ndarray]:
    spectra, valid = unpack(counts)
    return {"spectral": spectra, "valid": valid}
