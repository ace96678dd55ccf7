"""The lines of a cube, one after the other, without mapping the file or holding more than one of them."""

from __future__ import annotations

import os
from types import TracebackType

import numpy as np
from jaxtyping import Num

from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.errors import InputError


class CubeLines:
    """Lines of a cube by their number, as ``(samples, bands)``; each is overwritten by the next.

    Reading into the same memory again costs a fraction of what touching fresh pages of a memory map does, above all
    where several threads do so at a time. The lines of a BSQ file lie apart in it and come from a memory map.

    Use as a context manager.
    """

    def __init__(self, cube: Cube) -> None:
        self.shape = cube.shape
        self.dtype = cube.dtype
        self._cube = cube
        self._map = np.asarray(cube.memmap()) if cube.interleave == "bsq" else None
        lines, samples, bands = cube.shape
        by_band = cube.interleave == "bil"
        self._line = np.empty((bands, samples) if by_band else (samples, bands), cube.dtype)
        self._view = self._line.T if by_band else self._line
        self._offset = cube.data_path.stat().st_size - lines * self._line.nbytes
        self._file = -1

    def __enter__(self) -> CubeLines:
        try:
            self._file = os.open(self._cube.data_path, os.O_RDONLY)
        except OSError as error:
            raise InputError(f"{self._cube.data_path}: cannot be read ({error.strerror}); check the file.") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        os.close(self._file)

    def __getitem__(self, line: int) -> Num[np.ndarray, "samples bands"]:
        """One line.

        Raises:
            InputError: the file ends before it, or the operating system refused to read.
        """
        if self._map is not None:
            return self._map[line]
        try:
            got = os.preadv(self._file, [self._line.data], self._offset + line * self._line.nbytes)
        except OSError as error:
            raise InputError(
                f"{self._cube.data_path}: cannot be read ({error.strerror}); copy the capture again."
            ) from error
        if got != self._line.nbytes:
            raise InputError(f"{self._cube.data_path}: ends in its line {line}; copy the capture again.")
        return self._view
