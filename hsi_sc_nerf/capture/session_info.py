"""``session.json``: what the user states about a session."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.capture.envi_header import SENSIBLE_NM
from hsi_sc_nerf.errors import InputError, shown
from hsi_sc_nerf.files import read_json
from hsi_sc_nerf.number_table import read_number_table
from hsi_sc_nerf.settings_file import read_dataclass
from hsi_sc_nerf.spectra import listed_twice

SESSION_INFO_NAME = "session.json"
_FILES = ("band_centres", "panel_reflectance")
_LARGEST_M = {
    "marker_side_m": 0.5,
    "container_diameter_m": 3.0,
    "container_height_m": 3.0,
    "camera_distance_m": 30.0,
}
"""Lengths of a turntable session in metres; larger ones are centimetres or millimetres."""


@dataclass(frozen=True)
class SessionInfo:
    """The content of ``session.json``.

    Attributes:
        object: what is on the turntable.
        nominal_step_deg: the turntable's step between frames, positive.
        direction: the turntable's direction seen from above, counter-clockwise or clockwise.
        marker_dictionary: OpenCV's name, for example ``DICT_5X5_50``.
        marker_side_m: side of a marker's black square.
        container_diameter_m: diameter of the upright cylinder that the object stands on.
        container_height_m: height of the cylinder's lid above the disc.
        frame_angles_deg: readings of the turntable's scale, one a capture, for uneven, known steps.
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
        InputError: the file cannot be read or is not a JSON object; a key is unknown; a value is of the wrong kind; a
            named file is missing.
    """
    if not os.path.lexists(path):
        return SessionInfo()
    known = ", ".join(field.name for field in fields(SessionInfo))
    content = read_json(path, f"write {{...}} with keys of {known}, or remove it")
    values = {key: value for key, value in content.items() if value is not None}
    info = read_dataclass(SessionInfo, values, str(path), "")
    for key, value in values.items():
        if key in _FILES and not os.path.isfile(path.parent / value):
            expected = f"the name of a CSV file beside {path.name}"
        elif key in ("nominal_step_deg", *_LARGEST_M) and not value > 0.0:
            expected = "a positive number"
        elif key in _LARGEST_M and value > _LARGEST_M[key]:
            expected = f"a length in metres, at most {_LARGEST_M[key]:g}"
        elif key == "image_rotation_deg" and value not in (0, 90, 180, 270):
            expected = "0, 90, 180 or 270 degrees"
        elif key == "marker_dictionary" and not (value.startswith("DICT_") and hasattr(cv2.aruco, value)):
            expected = "OpenCV's name of a dictionary, such as DICT_5X5_50"
        elif value == "":
            expected = "a text"
        else:
            continue
        raise InputError(f"{path}: {key} is {shown(value)}, but must be {expected}; correct it.")
    if (info.container_diameter_m is None) != (info.container_height_m is None):
        raise InputError(
            f"{path}: gives one dimension of the container; give its diameter and its height, or neither."
        )
    return info


def read_band_centres(path: Path) -> Float[np.ndarray, "bands"]:
    """Band centres in nm from the first column of a CSV; its title may say that they are in micrometres.

    Raises:
        InputError: the file cannot be read, its numbers are no wavelengths, or two are the same.
    """
    try:
        table = read_number_table(path, columns=1)
        first = table.by_title().values() if table.titles else table.numbers.T
        centres_nm = next(iter(first), np.empty(0))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: is not a list of band centres ({error}); write a line of names and one wavelength in nm a line."
        ) from error
    if len(centres_nm) == 0 or not SENSIBLE_NM[0] <= centres_nm.min() <= centres_nm.max() <= SENSIBLE_NM[1]:
        raise InputError(f"{path}: its band centres are not wavelengths in nm; write one number a line, from 100.")
    twice_nm = listed_twice(centres_nm)
    if twice_nm is not None:
        raise InputError(f"{path}: lists {twice_nm:g} nm twice; give each band its own centre.")
    return centres_nm
