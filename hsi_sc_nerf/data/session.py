"""A capture session on disk: which cubes are frames, which is the white tarp, and what session.json adds.

Two layouts: the SPECIM IQ's (``NAME/capture/NAME.hdr`` with ``DARKREF_NAME`` beside it) and a plain folder of
ENVI pairs, where a dark cube is called ``DARKREF_NAME`` (of that capture) or ``dark...`` (of all).
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.data.envi import Cube, open_cube
from hsi_sc_nerf.errors import InputError

SESSION_INFO_NAME = "session.json"
# Headers list centres to about 0.01 nm; two captures of one instrument agree to that.
_SAME_WAVELENGTH_NM = 0.01
_DARK_PREFIX, _WHITE_PREFIX = "darkref_", "whiteref_"


@dataclass(frozen=True)
class SessionInfo:
    """What ``session.json`` may tell, because the instrument cannot.

    Attributes:
        object: what is on the turntable.
        nominal_step_deg: the turntable's step between frames, degrees, positive.
        direction: the turntable's turn seen from above, counter-clockwise or clockwise.
        marker_dictionary: OpenCV's name, for example ``DICT_5X5_50``.
        marker_side_m: side of a marker's black square, metres.
        container_diameter_m: of the upright cylinder that the object stands on.
        container_height_m: of its lid above the disc.
        white_reference: name of the capture of the white tarp.
    """

    object: str | None = None
    nominal_step_deg: float | None = None
    direction: Literal["ccw", "cw"] | None = None
    marker_dictionary: str | None = None
    marker_side_m: float | None = None
    container_diameter_m: float | None = None
    container_height_m: float | None = None
    white_reference: str = "white_reference"


@dataclass(frozen=True, eq=False)
class Capture:
    """One capture: its raw cube and, where the instrument took one, the dark cube that belongs to it."""

    name: str
    cube: Cube
    dark: Cube | None


@dataclass(frozen=True, eq=False)
class Session:
    """A session whose frames all have one shape and one list of bands."""

    path: Path
    info: SessionInfo
    white: Capture
    frames: tuple[Capture, ...]

    @property
    def wavelengths_nm(self) -> Float[np.ndarray, "bands"]:
        """Band centres, the same in all frames."""
        return self.frames[0].cube.wavelengths_nm


@dataclass(frozen=True)
class _CaptureHeaders:
    name: str
    header: Path
    dark: Path | None


def is_session(path: Path) -> bool:
    """Whether ``path`` is a folder that holds raw captures (nothing is read or checked)."""
    path = Path(path)
    return path.is_dir() and bool(_capture_folders(path) or _headers_in(path))


def open_session(path: Path) -> Session:
    """Find the captures of a session, open their cubes and check that they belong together.

    Raises:
        InputError: no such folder, no frames, a single frame, no white reference, a cube that cannot be opened,
            frames that differ in shape or bands, or a ``session.json`` that cannot be used.
    """
    path = Path(path)
    if not path.is_dir():
        raise InputError(f"{path}: there is no such session folder; check the path.")
    info = read_session_info(path / SESSION_INFO_NAME)
    found = _specim_iq_captures(path) or _plain_captures(path)
    if not found:
        raise InputError(
            f"{path}: holds no captures; give a folder with NAME/capture/NAME.hdr or with ENVI header and data pairs."
        )
    whites = [headers for headers in found if headers.name.lower() == info.white_reference.lower()]
    frames = [headers for headers in found if headers not in whites]
    if not whites:
        raise InputError(
            f"{path}: has no capture called {info.white_reference}; add the white tarp under this name or give its "
            f"name as 'white_reference' in {SESSION_INFO_NAME}."
        )
    if len(frames) < 2:
        raise InputError(
            f"{path}: has {'a single frame' if frames else 'no frames'} beside the white reference; a reconstruction "
            "needs several frames of the turning object."
        )
    session = Session(path, info, _open_capture(whites[0]), tuple(_open_capture(headers) for headers in frames))
    _check_consistency(session)
    return session


def read_session_info(path: Path) -> SessionInfo:
    """Read ``session.json``; without one, everything is unknown.

    Raises:
        InputError: no JSON object, an unknown key, or a value of the wrong kind.
    """
    if not path.is_file():
        return SessionInfo()
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: is no JSON ({error}); correct it.") from error
    known = [field.name for field in fields(SessionInfo)]
    if not isinstance(content, dict):
        raise InputError(f"{path}: is no JSON object; write {{...}} with any of the keys {', '.join(known)}.")
    unknown = sorted(set(content) - set(known))
    if unknown:
        raise InputError(f"{path}: does not know the key {unknown[0]}; the keys are {', '.join(known)}.")
    values = {key: value for key, value in content.items() if value is not None}
    for key, value in values.items():
        _check_value(path, key, value)
    if ("container_diameter_m" in values) != ("container_height_m" in values):
        raise InputError(
            f"{path}: gives one dimension of the container; give its diameter and its height, or neither."
        )
    return SessionInfo(**values)


def _check_value(path: Path, key: str, value: Any) -> None:
    if key == "direction":
        valid, wanted = value in ("ccw", "cw"), "ccw or cw (seen from above)"
    elif key in ("object", "marker_dictionary", "white_reference"):
        valid, wanted = isinstance(value, str) and value != "", "a text"
    else:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        valid, wanted = is_number and 0.0 < value < float("inf"), "a positive number"
    if not valid:
        raise InputError(f"{path}: {key} is {value!r}, but must be {wanted}; correct it.")


def _natural_order(name: str) -> list[tuple[int, str]]:
    """Sort key by which frame_9 comes before frame_10."""
    parts = re.split(r"(\d+)", name.lower())
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def _capture_folders(path: Path) -> list[Path]:
    folders = [f for f in path.iterdir() if not f.name.startswith(".") and (f / "capture").is_dir()]
    return sorted(folders, key=lambda folder: _natural_order(folder.name))


def _headers_in(path: Path) -> dict[str, Path]:
    """Headers of a folder by their names without the ending, in natural order."""
    headers = [f for f in path.iterdir() if f.suffix.lower() == ".hdr" and not f.name.startswith(".")]
    return {h.stem: h for h in sorted(headers, key=lambda header: _natural_order(header.stem))}


def _specim_iq_captures(path: Path) -> list[_CaptureHeaders]:
    captures = []
    for folder in _capture_folders(path):
        headers = _headers_in(folder / "capture")
        if folder.name not in headers:
            raise InputError(
                f"{folder}: has no capture/{folder.name}.hdr; copy the capture again or move the folder away."
            )
        dark = next((h for name, h in headers.items() if name.lower() == _DARK_PREFIX + folder.name.lower()), None)
        captures.append(_CaptureHeaders(folder.name, headers[folder.name], dark))
    return captures


def _plain_captures(path: Path) -> list[_CaptureHeaders]:
    headers = _headers_in(path)
    own_dark = {
        n.lower().removeprefix(_DARK_PREFIX): h for n, h in headers.items() if n.lower().startswith(_DARK_PREFIX)
    }
    shared_dark = [
        h for n, h in headers.items() if n.lower().startswith("dark") and not n.lower().startswith(_DARK_PREFIX)
    ]
    if len(shared_dark) > 1:
        raise InputError(
            f"{path}: {shared_dark[0].name} and {shared_dark[1].name} both look like the dark cube of all captures; "
            "keep one, or call each DARKREF_NAME after its capture."
        )
    return [
        _CaptureHeaders(name, header, own_dark.get(name.lower(), shared_dark[0] if shared_dark else None))
        for name, header in headers.items()
        if not name.lower().startswith(("dark", _WHITE_PREFIX))
    ]


def _open_capture(headers: _CaptureHeaders) -> Capture:
    dark = None if headers.dark is None else open_cube(headers.dark)
    return Capture(headers.name, open_cube(headers.header), dark)


def _check_consistency(session: Session) -> None:
    first = session.frames[0]
    for capture in (*session.frames, session.white):
        for cube in (capture.cube, capture.dark):
            if cube is None:
                continue
            same_bands = cube.wavelengths_nm.shape == first.cube.wavelengths_nm.shape and np.allclose(
                cube.wavelengths_nm, first.cube.wavelengths_nm, rtol=0.0, atol=_SAME_WAVELENGTH_NM
            )
            if not same_bands:
                raise InputError(
                    f"{cube.header_path}: its bands differ from those of {first.cube.header_path}; "
                    "leave this capture out or take it again with the same bands."
                )
        if capture is not session.white and capture.cube.shape != first.cube.shape:
            raise InputError(
                f"{capture.cube.header_path}: its {capture.cube.shape[:2]} lines and samples differ from the "
                f"{first.cube.shape[:2]} of {first.cube.header_path}; leave this capture out."
            )
