"""NetCDF clouds of others are read in a process of their own first.

Some damaged files keep HDF5, the library that reads them, busy for ever, or end its process, and nothing in that
process can stop it. What a process of its own has read to the end can be read here.
"""

from __future__ import annotations

import math
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import LARGEST_DEFLATION

_STARTS_S = 5.0
"""Processor time: a process takes a second to start, however busy the machine is."""
_BYTES_PER_S = 5e6
"""Slower than any processor reads a cloud."""
_STUCK_S = 300.0
"""What has not ended by then waits for something that does not come, such as the other end of a pipe."""
_BLOCK_VALUES = 1 << 22
_ROOM_BYTES, _LARGEST_RATIO = 1 << 27, 32
"""Memory that reading may take: for blocks and libraries, and for each byte of the file, which may be compressed."""


def require_readable(path: Path) -> None:
    """Refuse a NetCDF file that cannot be read to its end, or claims more than it can hold.

    Raises:
        InputError: it is such a file, or h5netcdf is not installed.
    """
    no_end = InputError(f"{path}: is damaged, so that reading it comes to no end; write it again.")
    try:
        limit_s = math.ceil(_STARTS_S + path.stat().st_size / _BYTES_PER_S)
        words = [sys.executable, "-m", __name__, str(path), str(limit_s)]
        tried = subprocess.run(
            words,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_STUCK_S + limit_s,
        )
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the file.") from error
    except subprocess.TimeoutExpired as error:
        raise no_end from error
    if tried.returncode == -getattr(signal, "SIGXCPU", 0) != 0:
        raise no_end
    if tried.returncode != 0:
        reason = (tried.stderr.strip().splitlines() or [f"HDF5 ended with status {tried.returncode}"])[-1]
        raise InputError(
            f"{path}: cannot be read ({reason}); check the file, and run `pip install 'hsi-sc-nerf[formats]'`."
        )


def require_room(claimed_bytes: int, stored_bytes: int) -> None:
    """Refuse a table that claims more than was stored of it, however well it is compressed.

    Raises:
        InputError: it does.
    """
    if claimed_bytes > LARGEST_DEFLATION * stored_bytes:
        raise InputError(f"it claims {claimed_bytes} bytes and has {stored_bytes}; write it again.")


def limit_processor_time(seconds: int) -> None:
    """End this process (SIGXCPU) after so many seconds of processor time; not on Windows."""
    with suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))  # then SIGKILL


def limit_memory(more_bytes: int) -> None:
    """Let this process take so much more memory than it has; where the system tells how much that is (Linux)."""
    with suppress(ImportError, FileNotFoundError):
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + more_bytes, used + more_bytes))


def _read(path: Path) -> None:
    """Read all that a NetCDF file holds, a block at a time."""
    import h5netcdf

    limit_memory(_ROOM_BYTES + _LARGEST_RATIO * path.stat().st_size)
    with h5netcdf.File(path, "r") as file:
        dict(file.attrs)
        variables = list(file.variables.values())
        claimed = sum(math.prod(variable.shape) * variable.dtype.itemsize for variable in variables)
        require_room(claimed, path.stat().st_size)
        for variable in variables:
            dict(variable.attrs)
            rows = max(1, _BLOCK_VALUES // max(1, math.prod(variable.shape[1:])))
            for start in range(0, variable.shape[0] if variable.shape else 1, rows):
                variable[start : start + rows] if variable.shape else variable[...]


if __name__ == "__main__":
    limit_processor_time(int(sys.argv[2]))
    _read(Path(sys.argv[1]))
