"""``session.json``: what the user states about a session."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError, shown
from hsi_sc_nerf.files import read_json

SESSION_INFO_NAME = "session.json"
_TEXTS = ("object", "marker_dictionary", "white_reference")
_FILES = ("band_centres", "panel_reflectance")


@dataclass(frozen=True)
class SessionInfo:
    """The content of ``session.json``.

    Attributes:
        object: what is on the turntable.
        nominal_step_deg: the turntable's step between frames, positive.
        direction: the turntable's direction seen from above, counter-clockwise or clockwise.
        marker_dictionary: OpenCV's name, for example ``DICT_5X5_50``.
        marker_side_m: side of a marker's black square.
        container_diameter_m: of the upright cylinder that the object stands on.
        container_height_m: of the cylinder's lid above the disc.
        frame_angles_deg: the turntable's angle in each frame, for uneven, known steps.
        camera_distance_m: of the camera from the turntable's axis; sets the scale of a session without markers.
        white_reference: name of the capture of the white tarp.
        band_centres: a CSV beside ``session.json`` with the band centres in nm, for headers that list none.
        panel_reflectance: a CSV beside ``session.json`` with the white's own reflectance by wavelength.
        image_rotation_deg: rotation of the files' images from upright, counter-clockwise: 0, 90, 180 or 270. None
            takes it from the instrument's metadata.
    """

    object: str | None = None
    nominal_step_deg: float | None = None
    direction: Literal["ccw", "cw"] | None = None
    marker_dictionary: str | None = None
    marker_side_m: float | None = None
    container_diameter_m: float | None = None
    container_height_m: float | None = None
    frame_angles_deg: tuple[float, ...] | None = None
    camera_distance_m: float | None = None
    white_reference: str = "white_reference"
    band_centres: str | None = None
    panel_reflectance: str | None = None
    image_rotation_deg: int | None = None


def read_session_info(path: Path) -> SessionInfo:
    """Read ``session.json``; if there is none, every value is unknown.

    Raises:
        InputError: no readable file, no JSON object, an unknown key, a value of the wrong kind, or a named file that
            is missing.
    """
    if not os.path.lexists(path):
        return SessionInfo()
    known = [field.name for field in fields(SessionInfo)]
    content = read_json(path, f"write {{...}} with keys of {', '.join(known)}, or remove it")
    values = {key: value for key, value in content.items() if value is not None}
    for key, value in values.items():
        if key not in known:
            raise InputError(f"{path}: does not know the key {key}; the keys are {', '.join(known)}.")
        _check_value(path, key, value)
    if ("container_diameter_m" in values) != ("container_height_m" in values):
        raise InputError(
            f"{path}: gives one dimension of the container; give its diameter and its height, or neither."
        )
    if "frame_angles_deg" in values:
        values["frame_angles_deg"] = tuple(float(angle) for angle in values["frame_angles_deg"])
    return SessionInfo(**values)


def read_band_centres(path: Path) -> Float[np.ndarray, "bands"]:
    """Band centres in nm from the first column of a CSV with a header line.

    Raises:
        InputError: the file cannot be read, or its numbers are no wavelengths in nm.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")[1:]
        centres_nm = np.array([float(line.split(",")[0]) for line in lines if line.strip()])
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: is no list of band centres ({error}); write a line of names and one wavelength in nm a line."
        ) from error
    if len(centres_nm) == 0 or not (np.isfinite(centres_nm).all() and centres_nm.min() >= 100.0):
        raise InputError(f"{path}: its band centres are no wavelengths in nm; write one number a line, 100 at least.")
    return centres_nm


def _check_value(path: Path, key: str, value: Any) -> None:
    is_number = _is_finite_number(value)
    if key == "direction":
        valid, expected = value in ("ccw", "cw"), "ccw or cw (seen from above)"
    elif key in _FILES:
        valid = isinstance(value, str) and os.path.isfile(path.parent / value)
        expected = f"the name of a CSV file beside {path.name}"
    elif key in _TEXTS:
        valid, expected = isinstance(value, str) and value != "", "a text"
    elif key == "frame_angles_deg":
        valid = isinstance(value, list) and all(_is_finite_number(angle) for angle in value)
        expected = "a list with one number a frame"
    elif key == "image_rotation_deg":
        valid, expected = is_number and value in (0, 90, 180, 270), "0, 90, 180 or 270 degrees"
    else:
        valid, expected = is_number and value > 0.0, "a positive number"
    if not valid:
        raise InputError(f"{path}: {key} is {shown(value)}, but must be {expected}; correct it.")


def _is_finite_number(value: Any) -> bool:
    # Integers beyond the largest float are no numbers to compute with.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
