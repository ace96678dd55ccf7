"""What a SPECIM IQ leaves on disk: its metadata, and which of its dark cubes belongs to its white.

A capture is a folder: ``capture/`` holds the counts NAME, the shutter's DARKREF_NAME, a white WHITEREF_NAME and its
WHITEDARKREF_NAME; ``results/`` the instrument's own REFLECTANCE_NAME; ``metadata/NAME.xml`` its settings.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.errors import InputError

IMAGE_ROTATION_DEG = 90
"""The slit stands upright and scans sideways: counts and REFLECTANCE lie turned by this, counter-clockwise."""
# Fields that no other camera's metadata have, spelt as ``_plain`` leaves them: WR_mode and datacube_angle.
_FIELDS_OF_ITS_OWN = ("wrmode", "datacubeangle")


@dataclass(frozen=True)
class SpecimMetadata:
    """What ``metadata/NAME.xml`` tells.

    Attributes:
        path: the file.
        integration_time_ms: of the capture; None where it is not given.
        white_mode: "custom": the white was taken at another time, with an integration time and a dark of its own;
            "simultaneous": it was seen in the capture's own frame; None where it is not given.
        is_specim_iq: whether a real SPECIM IQ wrote it (``image_rotation_deg`` rests on this).
    """

    path: Path
    integration_time_ms: float | None
    white_mode: str | None
    is_specim_iq: bool


def read_metadata(path: Path) -> SpecimMetadata:
    """Read a capture's XML: ``<key field="integration_time">10</key>`` and the like, in any namespace.

    A field's name may be an attribute ``field`` or ``name`` or the element's own, in any letters, with blanks,
    hyphens or underscores.

    A real instrument is known by its name anywhere in the file or by the fields ``WR_mode`` and ``datacube_angle``,
    which no other camera has; a file that says "simulated" is none.

    Raises:
        InputError: no XML, or an integration time that is not a positive number.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError, ValueError, LookupError) as error:
        raise InputError(f"{path}: is no readable XML ({error}); copy the capture's metadata again.") from error
    values: dict[str, str] = {}
    words = []
    for element in root.iter():
        text = (element.text or "").strip()
        name = element.get("field") or element.get("name") or str(element.tag).rpartition("}")[2]
        if text:
            values.setdefault(_plain(name), text)
        words += [text, *element.attrib.values()]
    everything = _plain(" ".join(words))
    named = "specimiq" in everything or any(field in values for field in _FIELDS_OF_ITS_OWN)
    return SpecimMetadata(
        path=path,
        integration_time_ms=_integration_time_ms(path, values.get("integrationtime") or values.get("tint")),
        white_mode=_plain(values["wrmode"]) if "wrmode" in values else None,
        is_specim_iq=named and "simulated" not in everything,
    )


def image_rotation_deg(metadata: SpecimMetadata | None, cube: Cube) -> int:
    """How far a file's image is turned from upright: 90 where a real SPECIM IQ took it, else 0.

    The sign is in the metadata (``read_metadata``) or, where that has none, in the header's ``sensor type`` or
    ``description``.
    """
    if metadata is not None and metadata.is_specim_iq:
        return IMAGE_ROTATION_DEG
    told = _plain(" ".join(str(cube.header.get(key, "")) for key in ("sensor type", "description")))
    return IMAGE_ROTATION_DEG if "specimiq" in told and "simulated" not in told else 0


def dark_of_white(
    white_mode: str | None, dark: Cube | None, white_dark: Cube | None, same_exposure: bool
) -> Cube | None:
    """The dark cube that belongs to a capture's white.

    In "simultaneous" mode it is the capture's own. Else it is WHITEDARKREF; without one, the capture's own where the
    white was exposed as long (``same_exposure``), and none where it was not.
    """
    if white_mode == "simultaneous":
        return dark
    return white_dark or (dark if same_exposure else None)


def _plain(text: str) -> str:
    """Lower-case letters and digits alone, so that spellings of a name agree."""
    return re.sub(r"[^a-z0-9]", "", text.lower())


def _integration_time_ms(path: Path, text: str | None) -> float | None:
    if text is None:
        return None
    number = re.fullmatch(r"([0-9.eE+-]+)\s*(ms)?", text)
    try:
        value = float(number.group(1)) if number else 0.0
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise InputError(f"{path}: integration time {text!r} is not a positive number of ms; correct it.")
    return value
