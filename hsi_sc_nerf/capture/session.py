"""A capture session on disk: which cubes are frames, which is the white tarp, and what belongs to each frame.

Two layouts (``capture_layout.py``): the SPECIM IQ's and a plain folder of ENVI pairs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.capture.envi import Cube, cube_of
from hsi_sc_nerf.capture.envi_header import read_header
from hsi_sc_nerf.capture.layout import CaptureFiles, find_captures, holds_captures
from hsi_sc_nerf.capture.session_info import SESSION_INFO_NAME as SESSION_INFO_NAME
from hsi_sc_nerf.capture.session_info import SessionInfo, read_band_centres, read_session_info
from hsi_sc_nerf.capture.specim_iq import SpecimMetadata, dark_of_white, image_rotation_deg, read_metadata
from hsi_sc_nerf.errors import InputError

# Headers list centres to about 0.01 nm; two captures of one instrument agree to that.
_SAME_WAVELENGTH_NM = 0.01


@dataclass(frozen=True, eq=False)
class Capture:
    """One capture: its counts and what the instrument took or made with them.

    Attributes:
        name: of the folder or the file.
        cube: the raw counts; of a capture without any (``has_counts`` is false) its finished reflectance.
        dark: counts without light, exposed like ``cube``.
        white: WHITEREF: counts of a white that belong to this capture.
        white_dark: counts without light that belong to ``white``; the capture's own dark where that applies.
        product: REFLECTANCE: reflectance as the instrument itself made it.
        metadata: what the instrument's XML tells; None where there is none or nothing in it was needed.
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
        """Whether ``cube`` holds raw counts, not the finished reflectance."""
        return self.cube is not self.product

    @property
    def cubes(self) -> tuple[Cube, ...]:
        """All its cubes, each once."""
        own = (self.cube, self.dark, self.white, self.white_dark, self.product)
        return tuple(dict.fromkeys(cube for cube in own if cube is not None))

    @property
    def integration_time_ms(self) -> float | None:
        """How long ``cube`` was exposed, by its header or the metadata; None where neither tells."""
        told = None if self.metadata is None else self.metadata.integration_time_ms
        return self.cube.integration_time_ms or told

    @property
    def white_integration_time_ms(self) -> float | None:
        """How long ``white`` was exposed; None where that is not told, or there is no white."""
        if self.white is None:
            return None
        in_same_frame = self.metadata is not None and self.metadata.white_mode == "simultaneous"
        return self.white.integration_time_ms or (self.integration_time_ms if in_same_frame else None)


@dataclass(frozen=True, eq=False)
class Session:
    """A session whose frames all have one shape and one list of bands.

    Attributes:
        path: its folder.
        info: what ``session.json`` tells.
        white: the capture of the white tarp; None in a session that has none.
        frames: the other captures, in natural order of their names.
        image_rotation_deg: how far the files' images are turned from upright, counter-clockwise.
    """

    path: Path
    info: SessionInfo
    white: Capture | None
    frames: tuple[Capture, ...]
    image_rotation_deg: int = 0

    @property
    def captures(self) -> tuple[Capture, ...]:
        """The tarp, where there is one, and the frames."""
        return self.frames if self.white is None else (self.white, *self.frames)

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
        return self.has_counts and all(frame.white is not None for frame in self.frames)

    @property
    def has_products(self) -> bool:
        """Whether every frame has the instrument's finished reflectance."""
        return all(frame.product is not None for frame in self.frames)

    @property
    def quarter_turns(self) -> int:
        """``np.rot90``'s k that sets a file's image upright: 0 to 3."""
        return -self.image_rotation_deg // 90 % 4

    @property
    def info_path(self) -> Path:
        """Where ``session.json`` is or would be."""
        return self.path / SESSION_INFO_NAME

    @property
    def band_centres_path(self) -> Path | None:
        """The CSV of band centres that ``session.json`` names."""
        return None if self.info.band_centres is None else self.path / self.info.band_centres

    @property
    def panel_reflectance_path(self) -> Path | None:
        """The CSV of the white's own reflectance that ``session.json`` names."""
        return None if self.info.panel_reflectance is None else self.path / self.info.panel_reflectance


def is_session(path: Path) -> bool:
    """Whether ``path`` is a folder that holds captures (nothing is read or checked)."""
    path = Path(path)
    return path.is_dir() and holds_captures(path)


def open_session(path: Path) -> Session:
    """Find the captures of a session, open their cubes and check that they belong together.

    Raises:
        InputError: no such folder, no frames, a single frame, nothing to calibrate with (no white reference, no white
            in every frame, no finished reflectance of every frame), a cube that cannot be opened, frames that differ
            in shape or bands, or a ``session.json`` that cannot be used.
    """
    path = Path(path)
    if not path.is_dir():
        raise InputError(f"{path}: there is no such session folder; check the path.")
    info = read_session_info(path / SESSION_INFO_NAME)
    found = find_captures(path)
    if not found:
        raise InputError(
            f"{path}: holds no captures; give a folder with NAME/capture/NAME.hdr or with ENVI header and data pairs."
        )
    tarps = [files for files in found if files.name.lower() == info.white_reference.lower()]
    frames = [files for files in found if files not in tarps]
    tarp = next((files for files in tarps if files.counts is not None), None)
    _check_whites(path, info, tarp, frames)
    if len(frames) < 2:
        raise InputError(
            f"{path}: has {'a single frame' if frames else 'no frames'} beside the white reference; a reconstruction "
            "needs several frames of the turning object."
        )
    cubes = _open_cubes(
        [header for files in (*frames, *([tarp] if tarp else [])) for header in files.headers], info, path
    )
    # One frame's metadata tell how the images of all of them lie.
    first = _capture(frames[0], cubes, needs_instrument=info.image_rotation_deg is None)
    session = Session(
        path=path,
        info=info,
        white=None if tarp is None else _capture(tarp, cubes),
        frames=(first, *(_capture(files, cubes) for files in frames[1:])),
        image_rotation_deg=(
            image_rotation_deg(first.metadata, first.cube)
            if info.image_rotation_deg is None
            else info.image_rotation_deg
        ),
    )
    _check_consistency(session)
    return session


def _check_whites(path: Path, info: SessionInfo, tarp: CaptureFiles | None, frames: list[CaptureFiles]) -> None:
    """Something must turn every frame into reflectance: the tarp, a white of its own, or the instrument."""
    if all(files.product for files in frames) or all(files.counts and files.white for files in frames):
        return
    if tarp is None:
        raise InputError(
            f"{path}: has no capture called {info.white_reference}; add the white tarp under this name, give its "
            f"name as 'white_reference' in {SESSION_INFO_NAME}, or add a WHITEREF_NAME or REFLECTANCE_NAME to each "
            "frame."
        )
    without_counts = next((files for files in frames if files.counts is None), None)
    if without_counts is not None:
        raise InputError(
            f"{without_counts.product}: there are no raw counts of this frame, but of other frames there is nothing "
            "else; copy its raw cube too, or the REFLECTANCE cube of every frame."
        )


def _open_cubes(headers: Iterable[Path], info: SessionInfo, root: Path) -> dict[Path, Cube]:
    """Open cubes, each header once; what lists no wavelengths takes session.json's or those of another cube."""
    read = {path: read_header(path) for path in headers}
    listed = None if info.band_centres is None else read_band_centres(root / info.band_centres)
    of_others: dict[int, Float[np.ndarray, "bands"]] = {}
    for header in read.values():
        if header.wavelengths_nm is not None:
            of_others.setdefault(header.shape[2], header.wavelengths_nm)
    return {
        path: cube_of(header, of_others.get(header.shape[2]) if listed is None else listed)
        for path, header in read.items()
    }


def _capture(files: CaptureFiles, cubes: dict[Path, Cube], needs_instrument: bool = False) -> Capture:
    """A capture of opened cubes; its XML is read only where something in it is needed."""
    counts, dark, white, white_dark, product = (
        None if header is None else cubes[header]
        for header in (files.counts, files.dark, files.white, files.white_dark, files.product)
    )
    cube = product if counts is None else counts
    assert cube is not None  # find_captures finds no others
    needs_metadata = needs_instrument or white is not None or (counts and counts.integration_time_ms is None)
    capture = Capture(
        name=files.name,
        cube=cube,
        dark=dark,
        white=white,
        product=product,
        metadata=read_metadata(files.metadata) if files.metadata is not None and needs_metadata else None,
    )
    if white is None:
        return capture
    mode = None if capture.metadata is None else capture.metadata.white_mode
    same_exposure = capture.white_integration_time_ms == capture.integration_time_ms
    return replace(capture, white_dark=dark_of_white(mode, dark, white_dark, same_exposure))


def _check_consistency(session: Session) -> None:
    first = session.frames[0]
    for capture in session.captures:
        for cube in capture.cubes:
            same_bands = cube.wavelengths_nm.shape == first.cube.wavelengths_nm.shape and np.allclose(
                cube.wavelengths_nm, first.cube.wavelengths_nm, rtol=0.0, atol=_SAME_WAVELENGTH_NM
            )
            if not same_bands:
                raise InputError(
                    f"{cube.header_path}: its bands differ from those of {first.cube.header_path}; "
                    "leave this capture out or take it again with the same bands."
                )
        images = () if capture is session.white else (capture.cube, capture.product)
        for image in images:
            if image is not None and image.shape != first.cube.shape:
                raise InputError(
                    f"{image.header_path}: its {image.shape[:2]} lines and samples differ from the "
                    f"{first.cube.shape[:2]} of {first.cube.header_path}; leave this capture out."
                )
