"""The files of each capture, by their names alone: folders of a SPECIM IQ, or a plain folder of ENVI pairs.

A SPECIM IQ makes a folder for each capture: ``capture/`` holds the counts NAME, the dark DARKREF_NAME, a white
WHITEREF_NAME and its dark WHITEDARKREF_NAME; ``results/`` the instrument's own REFLECTANCE_NAME; and
``metadata/NAME.xml`` its settings. A plain folder uses the same names, and ``dark...`` is the dark cube of all.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from hsi_sc_nerf.capture.envi import DATA_SUFFIXES
from hsi_sc_nerf.errors import InputError

_DARK, _WHITE, _WHITE_DARK, _PRODUCT = "darkref_", "whiteref_", "whitedarkref_", "reflectance_"
_PREFIXES = (_DARK, _WHITE, _WHITE_DARK, _PRODUCT)


@dataclass(frozen=True)
class CaptureFiles:
    """Headers of one capture's cubes, and its XML. ``counts`` or ``product`` is not None.

    Attributes:
        name: of the capture.
        counts: the raw counts.
        dark: DARKREF, counts without light.
        white: WHITEREF, counts of a white.
        white_dark: WHITEDARKREF, counts without light for ``white``.
        product: REFLECTANCE, the instrument's finished reflectance.
        metadata: the instrument's XML.
    """

    name: str
    counts: Path | None = None
    dark: Path | None = None
    white: Path | None = None
    white_dark: Path | None = None
    product: Path | None = None
    metadata: Path | None = None

    @property
    def headers(self) -> list[Path]:
        """All headers that exist."""
        cubes = (self.counts, self.dark, self.white, self.white_dark, self.product)
        return [header for header in cubes if header is not None]


def holds_captures(path: Path) -> bool:
    """Whether a folder has captures, by its files' names."""
    return bool(_specim_iq_folders(path) or _headers_in(path))


def find_captures(path: Path) -> list[CaptureFiles]:
    """The captures of a session's folder, in natural order of their names.

    Raises:
        InputError: a SPECIM IQ's folder without its cube, or two cubes that could be the dark of all captures.
    """
    return _specim_iq_captures(path) or _plain_captures(path)


def _natural_order(name: str) -> list[tuple[int, str]]:
    """Sort key by which frame_9 comes before frame_10."""
    parts = re.split(r"(\d+)", name.lower())
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def _headers_in(path: Path) -> dict[str, Path]:
    """Headers of a folder by their names without ending (NAME for ``NAME.raw.hdr``), in natural order."""
    if not path.is_dir():
        return {}
    headers = [f for f in path.iterdir() if f.suffix.lower() == ".hdr" and not f.name.startswith(".")]
    names = {h: Path(h.stem).stem if Path(h.stem).suffix.lower() in DATA_SUFFIXES[1:] else h.stem for h in headers}
    return {names[h]: h for h in sorted(headers, key=lambda header: _natural_order(names[header]))}


def _of_capture(name: str, headers: dict[str, Path]) -> dict[str, Path]:
    """The headers that belong to a capture, by their prefix ("" for the counts)."""
    lower = {key.lower(): header for key, header in headers.items()}
    own = {prefix: lower.get(prefix + name.lower()) for prefix in ("", *_PREFIXES)}
    return {prefix: header for prefix, header in own.items() if header is not None}


def _specim_iq_folders(path: Path) -> list[Path]:
    folders = [
        folder
        for folder in path.iterdir()
        if not folder.name.startswith(".")
        and ((folder / "capture").is_dir() or any(_is_product(name) for name in _headers_in(folder / "results")))
    ]
    return sorted(folders, key=lambda folder: _natural_order(folder.name))


def _is_product(name: str) -> bool:
    return name.lower().startswith(_PRODUCT)


def _specim_iq_captures(path: Path) -> list[CaptureFiles]:
    captures = []
    for folder in _specim_iq_folders(path):
        in_capture, in_results = _headers_in(folder / "capture"), _headers_in(folder / "results")
        # A folder may have been renamed, while its files keep the name that the instrument gave.
        ids = [name for name in in_capture if not name.lower().startswith(_PREFIXES)]
        ids += [name[len(_PRODUCT) :] for name in in_results if _is_product(name)]
        capture_id = ids[0] if len(set(ids)) == 1 else folder.name
        own = _of_capture(capture_id, in_capture)
        product = _of_capture(capture_id, in_results).get(_PRODUCT)
        if "" not in own and product is None:
            raise InputError(
                f"{folder}: has no capture/{folder.name}.hdr and no results/REFLECTANCE_{folder.name}.hdr; copy the "
                "capture again or move the folder away."
            )
        metadata = folder / "metadata" / f"{capture_id}.xml"
        captures.append(
            CaptureFiles(
                folder.name,
                counts=own.get(""),
                dark=own.get(_DARK),
                white=own.get(_WHITE),
                white_dark=own.get(_WHITE_DARK),
                product=product or own.get(_PRODUCT),
                metadata=metadata if metadata.is_file() else None,
            )
        )
    return captures


def _plain_captures(path: Path) -> list[CaptureFiles]:
    headers = _headers_in(path)
    shared_dark = [h for name, h in headers.items() if name.lower().startswith("dark") and not _has_prefix(name)]
    if len(shared_dark) > 1:
        raise InputError(
            f"{path}: {shared_dark[0].name} and {shared_dark[1].name} both look like the dark cube of all captures; "
            "keep one, or call each DARKREF_NAME after its capture."
        )
    names = {name.lower(): name for name in headers if not (_has_prefix(name) or name.lower().startswith("dark"))}
    for name in headers:
        if _is_product(name):
            names.setdefault(name.lower().removeprefix(_PRODUCT), name[len(_PRODUCT) :])
    captures = []
    for name in sorted(names.values(), key=_natural_order):
        own = _of_capture(name, headers)
        dark = own.get(_DARK, shared_dark[0] if shared_dark else None)
        captures.append(
            CaptureFiles(name, own.get(""), dark, own.get(_WHITE), own.get(_WHITE_DARK), own.get(_PRODUCT))
        )
    return captures


def _has_prefix(name: str) -> bool:
    return name.lower().startswith(_PREFIXES)
