"""What is particular to a SPECIM IQ: its metadata, how its images lie, and which dark belongs to its white."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.errors import InputError

IMAGE_ROTATION_DEG = 90
"""The slit is upright and scans sideways: the files' images are turned by this, counter-clockwise."""


@dataclass(frozen=True)
class SpecimMetadata:
    """The content of ``metadata/NAME.xml``.

    Attributes:
        path: the file.
        integration_time_ms: of the capture; None if it is not given.
        white_mode: "custom": the white was taken at another time, with its own integration time and dark;
            "simultaneous": it was taken in the capture's own frame; None if it is not given.
    """

    path: Path
    integration_time_ms: float | None
    white_mode: str | None


def read_metadata(path: Path) -> SpecimMetadata:
    """Read a capture's XML: ``<key field="integration_time">10</key>`` and similar, in any namespace.

    A field's name is the attribute ``field`` or ``name`` or the element's tag; case, blanks, hyphens and underscores
    are ignored.

    Raises:
        InputError: the file is no XML, or the integration time is not a positive number.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError, ValueError, LookupError) as error:
        raise InputError(f"{path}: is no readable XML ({error}); copy the capture's metadata again.") from error
    values: dict[str, str] = {}
    for element in root.iter():
        text = (element.text or "").strip()
        name = element.get("field") or element.get("name") or str(element.tag).rpartition("}")[2]
        if text:
            values.setdefault(_normalised(name), text)
    return SpecimMetadata(
        path=path,
        integration_time_ms=_integration_time_ms(path, values.get("integrationtime") or values.get("tint")),
        white_mode=_normalised(values["wrmode"]) if "wrmode" in values else None,
    )


def usual_rotation_deg(cube: Cube) -> int:
    """Rotation of a file's image from upright, counter-clockwise, as far as its header tells.

    It is 90 if the ``sensor type`` or ``description`` is that of a real SPECIM IQ, else 0.
    """
    camera = _normalised(" ".join(str(cube.fields.get(key, "")) for key in ("sensor type", "description")))
    return IMAGE_ROTATION_DEG if "specimiq" in camera and "simulated" not in camera else 0


def dark_of_white(
    white_mode: str | None, dark: Cube | None, white_dark: Cube | None, same_exposure: bool
) -> Cube | None:
    """The dark cube of a capture's white.

    In "simultaneous" mode this is the capture's own dark. Otherwise it is WHITEDARKREF or, without one, the capture's
    own dark if white and capture have the same integration time (``same_exposure``).
    """
    if white_mode == "simultaneous":
        return dark
    return white_dark or (dark if same_exposure else None)


def _normalised(text: str) -> str:
    """Lower-case letters and digits of a text, so that spellings of a name agree."""
    return re.sub(r"[^a-z0-9]", "", text.lower())


def _integration_time_ms(path: Path, text: str | None) -> float | None:
    if text is None:
        return None
    try:
        value = float(text.removesuffix("ms"))
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise InputError(f"{path}: integration time {text!r} is not a positive number of ms; correct it.")
    return value
