"""What is particular to an instrument: the files of each capture, its metadata, and how its images lie.

A SPECIM IQ makes a folder for each capture: ``capture/`` holds the counts NAME, the dark DARKREF_NAME, a white
WHITEREF_NAME and its dark WHITEDARKREF_NAME; ``results/`` the instrument's own REFLECTANCE_NAME; and
``metadata/NAME.xml`` its settings. A plain folder of ENVI pairs uses the same names, and ``dark...`` is the dark cube
of all. Files are recognised by their names alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from hsi_sc_nerf.capture.envi import DATA_SUFFIXES
from hsi_sc_nerf.capture.envi_header import EnviHeader
from hsi_sc_nerf.errors import InputError

_PRODUCT = "reflectance_"
_ROLES = {"": "counts", "darkref_": "dark", "whiteref_": "white", "whitedarkref_": "white_dark", _PRODUCT: "product"}
_PREFIXES = tuple(prefix for prefix in _ROLES if prefix)
IMAGE_ROTATION_DEG = 90
"""The slit is upright and scans sideways: the files' images are turned by this, counter-clockwise."""
SPECIM_IQ_FWHM_NM = 7.0
"""Width of a SPECIM IQ's bands by the paper ("Imaging setup"); its headers list none."""


@dataclass(frozen=True)
class CaptureFiles:
    """Headers of one capture's cubes, and its XML.

    Attributes:
        name: name of the capture.
        headers: by role: "counts", "dark" (DARKREF), "white" (WHITEREF), "white_dark" (WHITEDARKREF) and "product"
            (REFLECTANCE); "counts" or "product" is there.
        metadata: the instrument's XML.
    """

    name: str
    headers: dict[str, Path]
    metadata: Path | None = None


@dataclass
class Listing:
    """Everything in a session's folder, accounted for by name.

    Attributes:
        captures: in natural order of their names.
        damaged: captures without a cube, by name, with the reason.
        skipped: folders and cubes that are no captures, by name, with the reason.
    """

    captures: list[CaptureFiles] = field(default_factory=list)
    damaged: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)


def list_captures(path: Path) -> Listing:
    """The captures of a session's folder, and what else lies there.

    Raises:
        InputError: two cubes could be the dark of all captures.
    """
    found = Listing()
    folders = _in_natural_order(f for f in path.iterdir() if f.is_dir() and not f.name.startswith("."))
    in_folders = any(_is_specim_iq(folder) for folder in folders)
    if not in_folders:
        _list_plain(path, found)
    kinds = {_without_digits(folder.name) for folder in folders if _is_specim_iq(folder)}
    for folder in folders:
        if in_folders and _is_specim_iq(folder):
            _list_folder(folder, found)
        elif in_folders and (_without_digits(folder.name) in kinds or (folder / f"{folder.name}.hdr").is_file()):
            found.damaged[folder.name] = f"{folder}: has no folder capture/; move its cubes there"
        else:
            found.skipped[folder.name] = "folder without capture/"
    for header in _headers_in(path).values() if in_folders else ():
        found.skipped[header.name] = "lies beside the captures' folders"
    return found


def _is_specim_iq(folder: Path) -> bool:
    return (folder / "capture").is_dir() or any(_is_product(name) for name in _headers_in(folder / "results"))


def _is_product(name: str) -> bool:
    return name.lower().startswith(_PRODUCT)


def _without_digits(name: str) -> str:
    return re.sub(r"\d+", "", name.lower())


def _in_natural_order(paths: Iterable[Path]) -> list[Path]:
    """Sorted so that frame_9 comes before frame_10."""
    return sorted(paths, key=lambda path: natural_order(path.name))


def natural_order(name: str) -> list[tuple[int, str]]:
    """Key by which names of captures or their headers are sorted."""
    parts = re.split(r"(\d+)", name.lower().removesuffix(".hdr"))
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _headers_in(path: Path) -> dict[str, Path]:
    """Headers of a folder by their names without ending (NAME for ``NAME.raw.hdr``), in natural order."""
    if not path.is_dir():
        return {}
    headers = (f for f in path.iterdir() if f.suffix.lower() == ".hdr" and not f.name.startswith("."))
    return {
        Path(h.stem).stem if Path(h.stem).suffix.lower() in DATA_SUFFIXES[1:] else h.stem: h
        for h in _in_natural_order(headers)
    }


def _of_capture(name: str, headers: dict[str, Path]) -> dict[str, Path]:
    """The headers that belong to a capture, by their role."""
    lower = {key.lower(): header for key, header in headers.items()}
    return {role: lower[prefix + name.lower()] for prefix, role in _ROLES.items() if prefix + name.lower() in lower}


def _list_folder(folder: Path, found: Listing) -> None:
    """The capture in a folder of the SPECIM IQ."""
    in_capture, in_results = _headers_in(folder / "capture"), _headers_in(folder / "results")
    # A folder may have been renamed, while its files keep the name that the instrument gave.
    ids = [name for name in in_capture if not name.lower().startswith(_PREFIXES)]
    ids += [name[len(_PRODUCT) :] for name in in_results if _is_product(name)]
    capture_id = ids[0] if len(set(ids)) == 1 else folder.name
    own = {
        **_of_capture(capture_id, in_capture),
        **{role: h for role, h in _of_capture(capture_id, in_results).items() if role == "product"},
    }
    if "counts" not in own and "product" not in own:
        found.damaged[folder.name] = (
            f"{folder}: has no capture/{folder.name}.hdr and no results/REFLECTANCE_{folder.name}.hdr; copy the "
            "capture again or move the folder away"
        )
        return
    metadata = folder / "metadata" / f"{capture_id}.xml"
    found.captures.append(CaptureFiles(folder.name, own, metadata if metadata.is_file() else None))


def _list_plain(path: Path, found: Listing) -> None:
    """The captures of a plain folder."""
    headers = _headers_in(path)
    own_names = [name for name in headers if not name.lower().startswith(_PREFIXES)]
    shared_dark = [headers[name] for name in own_names if name.lower().startswith("dark")]
    if len(shared_dark) > 1:
        raise InputError(
            f"{path}: {shared_dark[0].name} and {shared_dark[1].name} both look like the dark cube of all captures; "
            "keep one, or call each DARKREF_NAME after its capture."
        )
    names: dict[str, str] = {}
    for name in own_names:
        if not name.lower().startswith("dark") and (twin := names.setdefault(name.lower(), name)) != name:
            raise InputError(f"{path}: {twin} and {name} differ in capitals only; rename one of them.")
    for name in headers:
        if _is_product(name):
            names.setdefault(name.lower().removeprefix(_PRODUCT), name[len(_PRODUCT) :])
    for named in _in_natural_order(map(Path, names.values())):
        dark = {"dark": shared_dark[0]} if shared_dark else {}
        found.captures.append(CaptureFiles(named.name, {**dark, **_of_capture(named.name, headers)}))
    described = {header.stem.lower() for header in headers.values()}
    for file in _in_natural_order(path.iterdir()):
        is_data = file.suffix.lower() in DATA_SUFFIXES[1:] and not file.name.startswith(".")
        if is_data and not {file.name.lower(), file.stem.lower()} & described:
            found.damaged[file.name] = f"{file}: has no header {file.stem}.hdr; copy it there"


@dataclass(frozen=True)
class SpecimMetadata:
    """The content of ``metadata/NAME.xml``.

    Attributes:
        path: the file.
        integration_time_ms: integration time of the capture; None if it is not given.
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
        raise InputError(f"{path}: is not readable XML ({error}); copy the capture's metadata again.") from error
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


def usual_rotation_deg(header: EnviHeader) -> int:
    """Rotation of a file's image from upright, counter-clockwise, by its header.

    It is 90 if the ``sensor type`` or ``description`` is that of a real SPECIM IQ, else 0.
    """
    camera = _camera(header)
    return IMAGE_ROTATION_DEG if "specimiq" in camera and "simulated" not in camera else 0


def with_band_widths(header: EnviHeader) -> EnviHeader:
    """The header, with the widths of a SPECIM IQ's bands where it lists none and nothing was binned."""
    binned = any(str(number) != "1" for number in np.atleast_1d(header.fields.get("binning", "1")))
    if header.fwhm_nm is not None or binned or "specimiq" not in _camera(header):
        return header
    return replace(header, fwhm_nm=np.full(header.shape[2], SPECIM_IQ_FWHM_NM))


def _camera(header: EnviHeader) -> str:
    """What a header says about the camera, normalised."""
    return _normalised(" ".join(str(header.fields.get(key, "")) for key in ("sensor type", "description")))


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
