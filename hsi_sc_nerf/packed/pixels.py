"""Random pixels of packed cubes on disk: a training batch reads its own pixels and nothing else."""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import cached_property
from io import FileIO
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, UInt16

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.morphology import beside
from hsi_sc_nerf.packed.cube import unpack, unpack_unflagged

BOUNDARY_PX = 3
"""Width of the band of background pixels along the foreground, which decide where the object ends."""


class PixelReader:
    """Reads the spectra of single pixels from files; memory maps would keep every page that was ever touched.

    Args:
        cubes: memory maps of BIP cubes of one shape, one for each frame; at most two maps of a generator are open at
            a time.
    """

    def __init__(self, cubes: Iterable[np.memmap]) -> None:
        self._files: list[FileIO] = []
        starts = []
        for cube in cubes:
            self.shape: tuple[int, int, int] = cube.shape
            self.dtype = cube.dtype
            self._files.append(FileIO(str(cube.filename), "rb"))
            starts.append(cube.offset)
        self._starts = np.array(starts)

    def close(self) -> None:
        """Close the files."""
        for file in self._files:
            file.close()

    def read(self, indices: Int[np.ndarray, "count 3"]) -> UInt16[np.ndarray, "count bands"]:
        """Packed spectra at (frame, line, sample).

        Raises:
            InputError: a file became shorter since it was opened.
        """
        _, samples, bands = self.shape
        size = bands * self.dtype.itemsize
        frames, pixels = indices[:, 0], indices[:, 1] * samples + indices[:, 2]
        offsets = (self._starts[frames] + pixels * size).tolist()
        files = [self._files[frame].fileno() for frame in frames.tolist()]
        # A disk serves many positions at once; not on macOS.
        if hasattr(os, "posix_fadvise"):
            for file, offset in zip(files, offsets, strict=True):
                os.posix_fadvise(file, offset, size, os.POSIX_FADV_WILLNEED)
        spectra = b"".join(os.pread(file, size, offset) for file, offset in zip(files, offsets, strict=True))
        if len(spectra) != size * len(files):
            folder = Path(self._files[0].name).parent
            raise InputError(f"{folder}: a cube became shorter while it was in use; process again.")
        return np.frombuffer(spectra, self.dtype).reshape(len(files), bands)


class PixelSampler:
    """Batches of random pixels of a set of frames.

    The same seed and step give the same batch, so that a resumed run sees the batches of an uninterrupted one.

    Args:
        reader: reader of the frames' packed cubes.
        masks: foreground of each frame.
        num_rays_per_batch: pixels in a batch.
        seed: part of every batch's seed.
        has_flagged: whether the cubes have values that are no measurements.

    Example:
        >>> reader = PixelReader(frame.cube() for frame in dataset.frames)
        >>> masks = np.stack([frame.mask() for frame in dataset.frames])
        >>> batch = PixelSampler(reader, masks, 4096, seed=0, has_flagged=True).sample(step=0)
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
        # Number of background pixels before each foreground pixel.
        self._background_before = self._foreground - np.arange(len(self._foreground))
        self._has_flagged = has_flagged
        self._drawn_background: Int[np.ndarray, "count"] | None = None

    def restrict_background(self, pixels: Bool[np.ndarray, "frames lines samples"]) -> None:
        """From now on, draw background pixels off the outline among these alone: those whose rays can meet something.

        Pixels on the outline are drawn as a part of the boundary.
        """
        self._drawn_background = np.flatnonzero(pixels & ~self.masks & ~self._partly_covered)

    def sample(
        self, step: int, foreground_ray_fraction: float | None = None, boundary_ray_fraction: float = 0.0
    ) -> dict[str, np.ndarray]:
        """One batch: `at` the pixels that `draw` gives."""
        return self.at(self.draw(step, foreground_ray_fraction, boundary_ray_fraction)[0])

    def draw(
        self,
        step: int,
        foreground_ray_fraction: float | None = None,
        boundary_ray_fraction: float = 0.0,
        outline_density: float = 1.0,
    ) -> tuple[Int[np.ndarray, "count 3"], int]:
        """The pixels (frame, line, sample) of one batch.

        Args:
            step: training step.
            foreground_ray_fraction: fraction of the pixels drawn from the foreground, in [0, 1]; the others are drawn
                from the background. None draws evenly from whole frames.
            boundary_ray_fraction: fraction of the background pixels drawn from within ``BOUNDARY_PX`` of the
                foreground, in [0, 1].
            outline_density: how often pixels on the outline are drawn compared with others.

        Returns:
            The pixels, and how many of them, the last, are drawn from the outline: as many in every step with the
            same fractions; 0 for whole frames.

        Raises:
            InputError: the batch needs foreground or background pixels and the masks have none.
        """
        rng = np.random.default_rng((self.seed, step))
        count = self.num_rays_per_batch
        if foreground_ray_fraction is None:
            flat = rng.integers(0, self.masks.size, count)
            return np.stack(np.unravel_index(flat, self.masks.shape), axis=1), 0
        in_foreground = round(count * foreground_ray_fraction)
        if in_foreground > 0 and len(self._foreground) == 0:
            raise InputError(
                "the masks of all training frames are empty, so that there is no object to train on; look at "
                "report/ in the dataset and process again."
            )
        on_boundary = 0
        if boundary_ray_fraction > 0.0 and sum(map(len, self._boundary)) > 0:
            on_boundary = round((count - in_foreground) * boundary_ray_fraction)
        drawn, in_background = self._drawn_background, count - in_foreground - on_boundary
        background_size = self.masks.size - len(self._foreground) if drawn is None else len(drawn)
        if in_background > 0 and background_size == 0:
            raise InputError(
                "the masks of all training frames cover whole images, so that nothing tells where the object "
                "ends; look at report/ in the dataset and process again with a larger --masks.threshold."
            )
        inside, rim = _drawn_from(self._object, in_foreground, outline_density, rng)
        far = self._background(rng.integers(0, background_size, in_background))
        beside, touching = _drawn_from(self._boundary, on_boundary, outline_density, rng)
        flat = np.concatenate([inside, far, beside, rim, touching])
        return np.stack(np.unravel_index(flat, self.masks.shape), axis=1), len(rim) + len(touching)

    def at(self, indices: Int[np.ndarray, "count 3"]) -> dict[str, np.ndarray]:
        """The given pixels (frame, line, sample).

        Returns:
            ``indices`` (count, 3) int64; ``spectral`` (count, bands) float32, reflectance; ``mask`` (count, 1) bool,
            foreground; ``free`` (count, 1) bool, neither foreground nor beside it, where the object may cover a part
            of the pixel; and, if the cubes have flagged values, ``valid`` (count, bands) bool, which of ``spectral``
            were measured (the others are 0).
        """
        frame, line, sample = indices.T
        mask, partial = (table[frame, line, sample, None] for table in (self.masks, self._partly_covered))
        batch = {"indices": indices, "mask": mask, "free": ~(mask | partial)}
        counts = self.reader.read(indices)
        if not self._has_flagged:
            return batch | {"spectral": unpack_unflagged(counts)}
        spectral, valid = unpack(counts)
        return batch | {"spectral": spectral, "valid": valid}

    @cached_property
    def _partly_covered(self) -> Bool[np.ndarray, "frames lines samples"]:
        """Background pixels of which the object may cover a part."""
        return np.stack([beside(mask, 1) for mask in self.masks])

    @cached_property
    def _object(self) -> tuple[Int[np.ndarray, "count"], Int[np.ndarray, "count"]]:
        """Foreground pixels inside the outline, and those on it (flat indices)."""
        rim = np.stack([beside(~mask, 1) for mask in self.masks])
        return np.flatnonzero(self.masks & ~rim), np.flatnonzero(rim)

    @cached_property
    def _boundary(self) -> tuple[Int[np.ndarray, "count"], Int[np.ndarray, "count"]]:
        """Background pixels within ``BOUNDARY_PX`` of the foreground: off and on the outline (flat indices)."""
        near = np.stack([beside(mask, BOUNDARY_PX) for mask in self.masks])
        return np.flatnonzero(near & ~self._partly_covered), np.flatnonzero(self._partly_covered)

    def _background(self, ranks: Int[np.ndarray, "count"]) -> Int[np.ndarray, "count"]:
        """Flat indices of the background pixels with these ranks.

        A list of all background pixels would be the largest array of a session. A pixel's index is its rank plus the
        number of foreground pixels before it.
        """
        if self._drawn_background is not None:
            return self._drawn_background[ranks]
        return ranks + np.searchsorted(self._background_before, ranks, side="right")


def _drawn_from(
    parts: tuple[Int[np.ndarray, "a"], Int[np.ndarray, "b"]], count: int, density: float, rng: np.random.Generator
) -> list[Int[np.ndarray, "drawn"]]:
    """Random pixels off and on the outline, ``count`` in all; those on it are drawn ``density`` as often."""
    off, on = map(len, parts)
    on_outline = round(density * count * on / max(off + on, 1)) if off > 0 else count
    drawn = zip(parts, (count - on_outline, on_outline), strict=True)
    return [part[rng.integers(0, max(len(part), 1), number)] for part, number in drawn]


def spread_over(masks: Bool[np.ndarray, "frames lines samples"], count: int) -> Int[np.ndarray, "at_most_count 3"]:
    """Pixels (frame, line, sample) evenly spread over the foreground in reading order, fewer where it is smaller."""
    foreground = np.flatnonzero(masks)
    count = min(count, len(foreground))
    chosen = foreground[((np.arange(count) + 0.5) / max(count, 1) * len(foreground)).astype(int)]
    return np.stack(np.unravel_index(chosen, masks.shape), axis=1)
