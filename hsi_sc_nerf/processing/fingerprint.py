"""Fingerprints of files and settings, by which a run recognises what an earlier one made from the same input."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hsi_sc_nerf import __version__
from hsi_sc_nerf.capture.session import Capture, Session


def session_fingerprint(session: Session, config: Any, files: Iterable[Path] = ()) -> str:
    """Fingerprint of a whole session and of the settings that it is processed with.

    Args:
        session: its files count by name, size and time of last change.
        config: settings, a dataclass.
        files: further files that the settings name; those that do not exist are left out.
    """
    named = _stamps(session.path, [path for path in files if path.is_file()])
    return fingerprint([session_files(session), asdict(config), named])


def fingerprint(content: Any) -> str:
    """Hash of JSON content and of this package's version."""
    text = json.dumps([__version__, content], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def session_files(session: Session) -> list[list[tuple[str, int, int]]]:
    """Name, size and time of last change of all files of a session."""
    return [shared_files(session), *(capture_files(session, frame) for frame in session.frames)]


def capture_files(session: Session, capture: Capture) -> list[tuple[str, int, int]]:
    """The same of the files that belong to one capture."""
    paths = [path for cube in capture.cubes for path in (cube.header_path, cube.data_path)]
    if capture.metadata is not None:
        paths.append(capture.metadata.path)
    return _stamps(session.path, paths)


def shared_files(session: Session) -> list[tuple[str, int, int]]:
    """The same of the files that every frame's reflectance depends on.

    These are ``session.json``, the files it names, and the tarp.
    """
    paths = [session.info_path, session.band_centres_path, session.panel_reflectance_path]
    stamps = _stamps(session.path, [path for path in paths if path is not None and path.is_file()])
    return stamps if session.white is None else stamps + capture_files(session, session.white)


def _stamps(root: Path, paths: Iterable[Path]) -> list[tuple[str, int, int]]:
    return [(os.path.relpath(p, root), p.stat().st_size, p.stat().st_mtime_ns) for p in paths]
