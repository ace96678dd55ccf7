"""A capture session on disk: its frames, its white tarp, and the cubes of each capture.

``layout.py`` finds the files of a SPECIM IQ or of a plain folder of ENVI pairs; ``session_info.py`` reads
``session.json``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.capture.envi import Cube, open_cube
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
    """One capture: its counts and the references that belong to them.

    Attributes:
        name: of the folder or the file.
        cube: the raw counts, or ``product`` if there are none (``has_counts`` is False).
        dark: counts without light, at the integration time of ``cube``.
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
        white: the capture of the white tarp, if there is one.
        frames: the other captures, in natural order of their names.
        image_rotation_deg: rotation of the files' images from upright, counter-clockwise.
    """

    path: Path
    info: SessionInfo
    white: Capture | None
    frames: tuple[Capture, ...]
    image_rotation_deg: int = 0

    @property
    def captures(self) -> tuple[Capture, ...]:
        """The tarp, if there is one, and the frames."""
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
        """``np.rot90``'s k that turns a file's image upright: 0 to 3."""
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
    """Whether ``path`` is a folder that holds captures, by its files' names."""
    path = Path(path)
    return path.is_dir() and holds_captures(path)


def open_session(path: Path) -> Session:
    """Find the captures of a session, open their cubes and check that they belong together.

    Raises:
        InputError: no such folder; fewer than two frames; no white reference for every frame and no finished
            reflectance of every frame; a cube that cannot be opened; frames that differ in shape or bands; or a
            ``session.json`` that cannot be used.

    Example:
        >>> session = open_session(Path("captures"))
        >>> len(session.frames), session.wavelengths_nm[[0, -1]]
        >>> counts = session.frames[0].cube.memmap()  # (lines, samples, bands)
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
    # The images of all frames are rotated as the first frame's metadata say.
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
    """Require a way to reflectance for every frame: the tarp, its own white, or the instrument's product."""
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
    """Open cubes. A header without wavelengths takes those of session.json or of another cube with as many bands."""
    read = {path: read_header(path) for path in headers}
    listed = None if info.band_centres is None else read_band_centres(root / info.band_centres)
    by_band_count: dict[int, Float[np.ndarray, "bands"]] = {}
    for header in read.values():
        if header.wavelengths_nm is not None:
            by_band_count.setdefault(header.shape[2], header.wavelengths_nm)
    return {
        path: open_cube(header, by_band_count.get(header.shape[2]) if listed is None else listed)
        for path, header in read.items()
    }


def _capture(files: CaptureFiles, cubes: dict[Path, Cube], needs_instrument: bool = False) -> Capture:
    """A capture of opened cubes. Its XML is read only if it is needed."""
    counts, dark, white, white_dark, product = (
        None if header is None else cubes[header]
        for header in (files.counts, files.dark, files.white, files.white_dark, files.product)
    )
    cube = product if counts is None else counts
    assert cube is not None  # guaranteed by find_captures
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
