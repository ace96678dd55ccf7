"""A capture session on disk: its frames, its white tarp, and the cubes of each capture.

``instrument.py`` finds the files of a SPECIM IQ or of a plain folder; ``session_info.py`` reads ``session.json``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.capture.envi import Cube, open_cube
from hsi_sc_nerf.capture.envi_header import EnviHeader, read_header
from hsi_sc_nerf.capture.instrument import (
    CaptureFiles,
    SpecimMetadata,
    list_captures,
    read_metadata,
    usual_rotation_deg,
    with_band_widths,
)
from hsi_sc_nerf.capture.roles import copies_of_others, damaged_captures, turn_of, white_name, with_angles_of
from hsi_sc_nerf.capture.session_info import SESSION_INFO_NAME, SessionInfo, read_band_centres, read_session_info
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.spectra import SAME_BAND_NM, listed_twice


@dataclass(frozen=True, eq=False)
class Capture:
    """One capture: its counts and the references that belong to them.

    Attributes:
        name: name of the folder or the file.
        cube: the raw counts, or ``product`` if there are none (``has_counts`` is False).
        dark: counts without light, at the integration time of ``cube``; None, as is ``white``, without raw counts.
        white: WHITEREF, counts of a white.
        white_dark: counts without light that belong to ``white``; the capture's own dark if that fits.
        product: REFLECTANCE, the reflectance that the instrument computed.
        metadata: content of the instrument's XML; None if there is none or nothing in it was needed.
    """

    name: str
    cube: Cube
    dark: Cube | None = None
    white: Cube | None = None
    white_dark: Cube | None = None
    product: Cube | None = None
    metadata: SpecimMetadata | None = None

    @property
    def has_counts(self) -> bool:
        """Whether ``cube`` holds raw counts."""
        return self.cube is not self.product

    @property
    def cubes(self) -> tuple[Cube, ...]:
        """All cubes of the capture, each once."""
        own = (self.cube, self.dark, self.white, self.white_dark, self.product)
        return tuple(dict.fromkeys(cube for cube in own if cube is not None))

    @property
    def integration_time_ms(self) -> float | None:
        """Integration time of ``cube`` by its header or the metadata; None if neither gives it."""
        in_metadata = None if self.metadata is None else self.metadata.integration_time_ms
        return self.cube.integration_time_ms or in_metadata

    @property
    def white_integration_time_ms(self) -> float | None:
        """Integration time of ``white``; None if it is not given or there is no white."""
        if self.white is None:
            return None
        in_same_frame = self.metadata is not None and self.metadata.white_mode == "simultaneous"
        return self.white.integration_time_ms or (self.integration_time_ms if in_same_frame else None)


@dataclass(frozen=True, eq=False)
class Session:
    """A session whose frames all have one shape and one list of bands.

    Attributes:
        path: its folder.
        info: content of ``session.json``.
        white: the capture of the white tarp, if there is one. `white_source` says what else there may be.
        frames: the other captures, in natural order of their names.
        image_rotation_deg: rotation of the files' images from upright, counter-clockwise.
        damaged: captures that cannot be used and are left out, by name, with the reason.
        skipped: folders and cubes that are no captures, by name, with the reason.
        excluded: captures that the user leaves out.
        turn: names of all captures of the turning object in their order, with those that are damaged or excluded;
            without excluded copies of others.
    """

    path: Path
    info: SessionInfo
    white: Capture | None
    frames: tuple[Capture, ...]
    image_rotation_deg: int = 0
    damaged: Mapping[str, str] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)
    excluded: tuple[str, ...] = ()
    turn: tuple[str, ...] = ()

    @property
    def captures(self) -> tuple[Capture, ...]:
        """The tarp, if there is one, and the frames."""
        return self.frames if self.white is None else (self.white, *self.frames)

    @property
    def places(self) -> tuple[int, ...]:
        """Each frame's place in the turn: the table turned for the captures that are left out, too."""
        return tuple(self.turn.index(frame.name) for frame in self.frames)

    @property
    def wavelengths_nm(self) -> Float[np.ndarray, "bands"]:
        """Band centres, the same in all frames."""
        return self.frames[0].cube.wavelengths_nm

    @property
    def has_counts(self) -> bool:
        """Whether every frame has raw counts."""
        return all(frame.has_counts for frame in self.frames)

    @property
    def has_own_whites(self) -> bool:
        """Whether every frame has raw counts and a white of its own."""
        return all(frame.has_counts and frame.white is not None for frame in self.frames)

    @property
    def has_products(self) -> bool:
        """Whether every frame has the instrument's finished reflectance."""
        return all(frame.product is not None for frame in self.frames)

    @property
    def quarter_turns(self) -> int:
        """``np.rot90``'s k that turns a file's image upright: 0 to 3."""
        return -self.image_rotation_deg // 90 % 4

    @property
    def info_path(self) -> Path:
        """Where ``session.json`` is or would be."""
        return self.path / SESSION_INFO_NAME

    @property
    def panel_reflectance_path(self) -> Path | None:
        """The CSV of the white's own reflectance that ``session.json`` names."""
        return None if self.info.panel_reflectance is None else self.path / self.info.panel_reflectance


def is_session(path: Path) -> bool:
    """Whether ``path`` is a folder that holds captures, by its files' names."""
    path = Path(path)
    if not path.is_dir():
        return False
    cubes = (file for pattern in ("*", "results/REFLECTANCE_*") for file in path.glob(f"*/{pattern}"))
    return any(file.suffix.lower() == ".hdr" for file in path.iterdir()) or any(
        file.name == "capture" or file.suffix.lower() == ".hdr" for file in cubes
    )


def open_session(path: Path, *, exclude: Collection[str] = (), skip_damaged: bool = False) -> Session:
    """Find the captures of a session, open their cubes and check that they belong together.

    Args:
        skip_damaged: whether captures that cannot be used are left out (`Session.damaged`) instead of refused.

    Raises:
        InputError: no such folder; fewer than two frames; captures that cannot be opened, or differ from most in
            shape or bands; or a ``session.json`` that cannot be used, or names a white that is not there.

    Example:
        >>> session = open_session(Path("captures"))
        >>> len(session.frames), session.wavelengths_nm[[0, -1]]
        >>> counts = session.frames[0].cube.memmap()  # (lines, samples, bands)
    """
    path = Path(path)
    if not path.is_dir():
        raise InputError(f"{path}: there is no such session folder; check the path.")
    info = read_session_info(path / SESSION_INFO_NAME)
    found = list_captures(path)
    if not found.captures and not found.damaged:
        raise InputError(
            f"{path}: holds no captures; give a folder with NAME/capture/NAME.hdr or with ENVI header and data pairs."
        )
    unknown = set(exclude) - {files.name for files in found.captures} - set(found.damaged) - set(found.skipped)
    if unknown:
        raise InputError(f"{path}: has no capture {', '.join(sorted(unknown))} to leave out; check the name.")
    kept = [files for files in found.captures if files.name not in exclude]
    damaged = dict(found.damaged)
    opened = open_captures(sorted(found.captures, key=lambda files: files.name in exclude), info, path, damaged)
    damaged = {name: reason for name, reason in damaged.items() if name not in exclude}
    captures = [capture for capture in opened if capture.name not in exclude]
    info = replace(info, white_reference=white_name(info, [*(files.name for files in kept), *damaged]))
    white = info.white_reference.lower()
    of_all = {name.lower() for name in (*(files.name for files in found.captures), *found.damaged)}
    if white not in of_all and info.white_reference != SessionInfo.white_reference:
        raise InputError(
            f"{path / SESSION_INFO_NAME}: names {info.white_reference} as white_reference, but there is no such "
            "capture; correct the name, or leave it out."
        )
    broken_white = next((reason for name, reason in damaged.items() if name.lower() == white), None)
    if broken_white is None and damaged and not captures:  # all for the same reason, most likely
        broken_white = next(iter(damaged.values()))
    if broken_white is not None:
        raise InputError(f"{broken_white}.")
    tarp = next((c for c in captures if c.name.lower() == white and c.has_counts), None)
    frames = [capture for capture in captures if capture.name.lower() != white]
    frames = _consistent(frames, tarp, damaged)
    if damaged and not skip_damaged:
        raise InputError(damaged_captures(path, damaged))
    if len(frames) < 2:
        raise InputError(
            f"{path}: has {'a single frame' if frames else 'no frames'} beside the white reference; a reconstruction "
            "needs several frames of the turning object."
        )
    rotation_deg = info.image_rotation_deg
    if rotation_deg is None:
        rotation_deg = usual_rotation_deg(frames[0].cube)
    names = [frame.name for frame in frames]
    left_out = {files.name for files in found.captures} - {capture.name for capture in captures}
    every = turn_of(names, {*left_out, *found.damaged, *damaged})
    copies = copies_of_others(
        [capture.cube.data_path for capture in captures],
        {capture.name: capture.cube.data_path for capture in opened if capture.name in exclude},
    )
    turn = tuple(name for name in every if name not in copies)
    return Session(
        path,
        with_angles_of(with_angles_of(info, names, every), names, turn),
        tarp,
        tuple(frames),
        rotation_deg,
        damaged=damaged,
        skipped=found.skipped,
        excluded=tuple(exclude),
        turn=turn,
    )


def open_captures(
    captures: list[CaptureFiles], info: SessionInfo, root: Path, damaged: dict[str, str]
) -> list[Capture]:
    """Open captures; those that cannot be opened are added to ``damaged``.

    A header without wavelengths, or with equal ones, takes those of session.json or of another cube with as many
    bands.
    """
    listed = None if info.band_centres is None else read_band_centres(root / info.band_centres)
    headers: dict[str, dict[str, EnviHeader]] = {}
    by_band_count: dict[int, Float[np.ndarray, "bands"]] = {}
    opened: list[Capture] = []
    for files in captures:
        try:
            headers[files.name] = {role: with_band_widths(read_header(path)) for role, path in files.headers.items()}
        except InputError as error:
            damaged[files.name] = str(error).removesuffix(".")
    for header in (header for by_role in headers.values() for header in by_role.values()):
        if header.wavelengths_nm is not None and listed_twice(header.wavelengths_nm) is None:
            by_band_count.setdefault(header.shape[2], header.wavelengths_nm)
    for files in (files for files in captures if files.name in headers):
        try:
            cubes = {
                role: open_cube(header, by_band_count.get(header.shape[2]) if listed is None else listed)
                for role, header in headers[files.name].items()
            }
            opened.append(_capture(files, cubes))
        except InputError as error:
            damaged[files.name] = str(error).removesuffix(".")
    return opened


def _capture(files: CaptureFiles, cubes: dict[str, Cube]) -> Capture:
    """A capture of opened cubes. Its XML is read only if it is needed."""
    counts, dark, white, product = (cubes.get(role) for role in ("counts", "dark", "white", "product"))
    if counts is None:  # the references of counts that are not there
        return Capture(files.name, cubes["product"], product=product)
    needs_metadata = white is not None or counts.integration_time_ms is None
    metadata = read_metadata(files.metadata) if files.metadata is not None and needs_metadata else None
    capture = Capture(files.name, counts, dark, white, product=product, metadata=metadata)
    if white is None:
        return capture
    if metadata is not None and metadata.white_mode == "simultaneous":
        return replace(capture, white_dark=dark)
    same_exposure = capture.white_integration_time_ms == capture.integration_time_ms
    return replace(capture, white_dark=cubes.get("white_dark") or (dark if same_exposure else None))


def _consistent(frames: list[Capture], tarp: Capture | None, damaged: dict[str, str]) -> list[Capture]:
    """The frames of the size and bands that most have; the others are added to ``damaged``.

    Raises:
        InputError: the tarp has other bands.
    """
    if not frames:
        return frames
    kinds = [(frame.cube.shape, frame.cube.wavelengths_nm.round(1).tobytes()) for frame in frames]
    usual = frames[kinds.index(max(kinds, key=kinds.count))].cube
    if tarp is not None and (reason := _difference(tarp, usual, same_size=False)):
        raise InputError(f"{reason}.")
    fitting = []
    for frame in frames:
        if reason := _difference(frame, usual):
            damaged[frame.name] = reason
        else:
            fitting.append(frame)
    return fitting


def _difference(capture: Capture, usual: Cube, same_size: bool = True) -> str:
    """How a capture's cubes differ from a session's usual cube; empty where they fit."""
    for cube in capture.cubes:
        same_bands = cube.wavelengths_nm.shape == usual.wavelengths_nm.shape and np.allclose(
            cube.wavelengths_nm, usual.wavelengths_nm, rtol=0.0, atol=SAME_BAND_NM
        )
        if not same_bands:
            return (
                f"{cube.header_path}: its bands differ from those of {usual.header_path}; leave this capture out or "
                "take it again with the same bands"
            )
        if same_size and cube in (capture.cube, capture.product) and cube.shape != usual.shape:
            return (
                f"{cube.header_path}: its {cube.shape[:2]} lines and samples differ from the {usual.shape[:2]} of "
                f"{usual.header_path}; leave this capture out"
            )
    return ""
