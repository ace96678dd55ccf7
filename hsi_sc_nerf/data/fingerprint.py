"""Fingerprints of files and settings: has this been made already, from the same input?"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hsi_sc_nerf import __version__
from hsi_sc_nerf.data.session import SESSION_INFO_NAME, Capture, Session


def fingerprint(content: Any) -> str:
    """Hash of something that JSON can hold, and of this package's version."""
    text = json.dumps([__version__, content], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def capture_files(session: Session, capture: Capture) -> list[tuple[str, int, int]]:
    """Name, size and time of last change of each file that a capture's reflectance depends on."""
    cubes = [cube for cube in (capture.cube, capture.dark) if cube is not None]
    return _stamps(session.path, (path for cube in cubes for path in (cube.header_path, cube.data_path)))


def session_files(session: Session) -> list[list[tuple[str, int, int]]]:
    """The same for all captures of a session and its ``session.json``."""
    info = session.path / SESSION_INFO_NAME
    captures = [capture_files(session, capture) for capture in (session.white, *session.frames)]
    return [*captures, _stamps(session.path, [info] if info.is_file() else [])]


def session_fingerprint(session: Session, config: Any) -> str:
    """Fingerprint of a whole session and of the settings (a dataclass) that it is processed with."""
    return fingerprint([session_files(session), asdict(config)])


def _stamps(root: Path, paths: Iterable[Path]) -> list[tuple[str, int, int]]:
    return [(p.relative_to(root).as_posix(), p.stat().st_size, p.stat().st_mtime_ns) for p in paths]
