"""Mistakes that spoil a session, each made in a copy of it."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from session_truth import SessionTruth

from hsi_sc_nerf.capture.envi import open_cube, write_cube

OTHER_DAY = "26-10-2026"
LIT = 0.6
"""Light of a shadow, of the lamps' own."""
LINES_NM, LINE_WIDTH_NM, LINE_HEIGHT = (546.0, 611.0), 4.0, 0.3
"""Of a fluorescent lamp, over the light of the session's lamps."""

Cubes = Callable[[np.ndarray], np.ndarray]


Make = Callable[[Path, Path, Path], None]


@dataclass(frozen=True)
class Mistake:
    """One mistake, and the words with which `process` is called."""

    name: str
    make: Make
    """Makes it in the folder of a copy; the second folder is the session itself with its truth, the third one of two
    frames of another object."""
    words: tuple[str, ...] = ()
    replaces_frames: bool = False
    """Whether it replaces frames, which then do not count in the errors."""


def stated(session: Path) -> dict[str, object]:
    """Content of ``session.json``."""
    return json.loads((session / "session.json").read_text(encoding="utf-8"))


def frames_of(session: Path) -> list[Path]:
    """Folders of the frames, in their order."""
    white = stated(session)["white_reference"]
    return sorted(path.parent for path in session.glob("*/capture") if path.parent.name != white)


def replaced_frames(session: Path) -> list[Path]:
    """The frames at the angles of the other object's two."""
    frames = frames_of(session)
    return [frames[0], frames[len(frames) // 2]]


def edit_headers(folder: Path, pattern: str, replacement: str) -> None:
    """Replace a pattern in all headers of a folder."""
    for path in folder.rglob("*.hdr"):
        path.write_text(re.sub(pattern, replacement, path.read_text(encoding="utf-8")), encoding="utf-8")


def _state(session: Path, **values: object) -> None:
    content = {key: value for key, value in (stated(session) | values).items() if value is not None}
    (session / "session.json").write_text(json.dumps(content), encoding="utf-8")


def edit_cube(header: Path, change: Cubes) -> None:
    """Change a cube's numbers; its header keeps what does not describe them."""
    cube = open_cube(header)
    counts = change(cube.read().astype(np.float32))
    if cube.dtype.kind == "u" and np.isfinite(counts).all():
        counts = np.clip(np.rint(counts), 0, 4095).astype(np.uint16)
    kept = {key: cube.fields[key] for key in ("sensor type", "tint", "acquisition date") if key in cube.fields}
    write_cube(header, counts, wavelengths_nm=cube.wavelengths_nm, extra_header=kept)


def header_of(capture: Path, prefix: str = "") -> Path:
    """Of the cube of a capture, or of one of its references."""
    return capture / "capture" / f"{prefix}{capture.name}.hdr"


def _white(session: Path) -> Path:
    return session / str(stated(session)["white_reference"])


def _dark_level(session: Path) -> float:
    return float(open_cube(header_of(_white(session), "DARKREF_")).read().mean())


def _white_light(session: Path) -> np.ndarray:
    """Counts above dark of the white, by band."""
    white = open_cube(header_of(_white(session))).read()
    lines, samples, _ = white.shape
    middle = white[lines // 4 : -lines // 4, samples // 4 : -samples // 4]
    return np.median(middle, axis=(0, 1)).astype(np.float32) - _dark_level(session)


def _light(change: Cubes, dark: float) -> Cubes:
    """A change of counts by one of the light above dark."""
    return lambda counts: dark + change(counts - dark)


def _in_frames(change_in: Callable[[Path], Cubes]) -> Make:
    """A change of all frames, which the session tells."""

    def make(session: Path, source: Path, other: Path) -> None:
        change = change_in(session)
        for frame in frames_of(session):
            edit_cube(header_of(frame), change)

    return make


def _in_white_light(change: Cubes) -> Make:
    """A change of the white's counts above dark."""
    return lambda session, *_: edit_cube(header_of(_white(session)), _light(change, _dark_level(session)))


def _in_all_cubes(change: Cubes) -> Make:
    def make(session: Path, source: Path, other: Path) -> None:
        for header in session.rglob("*.hdr"):
            edit_cube(header, change)

    return make


def nothing(session: Path, source: Path, other: Path) -> None:
    """No mistake."""


def _frame_as_white(session: Path, source: Path, other: Path) -> None:
    white, frame = _white(session), frames_of(session)[3]
    for path in (frame / "capture").iterdir():
        shutil.copy(path, white / "capture" / path.name.replace(frame.name, white.name))


def _another_day(session: Path, source: Path, other: Path) -> None:
    for frame, of_other in zip(replaced_frames(session), frames_of(other), strict=True):
        for path in (of_other / "capture").iterdir():
            shutil.copy(path, frame / "capture" / path.name.replace(of_other.name, frame.name))
        edit_headers(frame, r"acquisition date = .*", f"acquisition date = {OTHER_DAY}")


def _another_object(session: Path, source: Path, other: Path) -> None:
    _another_day(session, source, other)
    edit_headers(session, r"acquisition date = .*", f"acquisition date = {OTHER_DAY}")


def _without_folder(session: Path, source: Path, other: Path) -> None:
    frame = frames_of(session)[4]
    for path in (frame / "capture").iterdir():
        path.rename(frame / path.name)
    (frame / "capture").rmdir()


def _empty_capture(session: Path, source: Path, other: Path) -> None:
    for path in (frames_of(session)[4] / "capture").iterdir():
        path.unlink()


def _empty_file(session: Path, source: Path, other: Path) -> None:
    frame = frames_of(session)[4]
    (frame / "capture" / f"{frame.name}.raw").write_bytes(b"")


def _no_session_json(session: Path, source: Path, other: Path) -> None:
    (session / "session.json").unlink()


def _upright_in_specim_iq_folders(session: Path, source: Path, other: Path) -> None:
    _state(session, image_rotation_deg=None)
    for path in [*session.rglob("*.hdr"), *session.rglob("*.xml")]:
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace("simulated SPECIM IQ", "SPECIM IQ"), encoding="utf-8")


def _light_in_dark(session: Path, source: Path, other: Path) -> None:
    light = 0.05 * _white_light(session)
    edit_cube(header_of(frames_of(session)[3], "DARKREF_"), lambda counts: counts + light)


def _without_dark(session: Path, source: Path, other: Path) -> None:
    for path in (frames_of(session)[3] / "capture").glob("DARKREF_*"):
        path.unlink()


def _coverage(source: Path, name: str) -> np.ndarray:
    return np.asarray(SessionTruth.of(source).coverage(name), np.float32)


def _slip(session: Path, source: Path, other: Path) -> None:
    """The object of the second half of the frames is that of one frame later; markers and disc are not."""
    frames = frames_of(session)
    first = len(frames) // 2
    for frame, later in zip(frames[first:], [*frames[first + 1 :], frames[0]], strict=True):
        shown, turned = _coverage(source, frame.name), _coverage(source, later.name)
        of_object = (np.maximum(shown, turned) > 0.0)[..., None]
        counts = open_cube(header_of(source / later.name)).read()
        edit_cube(header_of(frame), lambda own, on=of_object, new=counts: np.where(on, new, own))


def _shadow(session: Path, source: Path, other: Path) -> None:
    """A shadow over the left half of the object in two frames."""
    dark = _dark_level(session)
    for frame in frames_of(session)[5:7]:
        on_object = _coverage(source, frame.name)
        left = np.arange(on_object.shape[1]) < np.average(
            np.arange(on_object.shape[1]), weights=on_object.sum(axis=0)
        )
        factor = 1.0 - (1.0 - LIT) * on_object * left
        edit_cube(header_of(frame), _light(lambda light, by=factor: light * by[..., None], dark))


def _stretched(factor: float, counts: np.ndarray) -> np.ndarray:
    """Lines that lie closer: more of them for the same scene, cut to as many as before."""
    lines, samples, _ = counts.shape
    longer = round(lines * factor)
    bands = (
        cv2.resize(band, (samples, longer), interpolation=cv2.INTER_CUBIC) for band in np.moveaxis(counts, -1, 0)
    )
    first = (longer - lines) // 2
    return np.stack([*bands], axis=-1)[first : first + lines]


def _half_in_shade(light: np.ndarray) -> np.ndarray:
    return light * np.where(np.arange(light.shape[1]) < light.shape[1] // 2, LIT, 1.0)[:, None]


def _room_lamp(session: Path) -> Cubes:
    nm = open_cube(header_of(_white(session))).wavelengths_nm
    factor = 1.0 + LINE_HEIGHT * sum(np.exp(-0.5 * ((nm - line) / LINE_WIDTH_NM) ** 2) for line in LINES_NM)
    return _light(lambda light: light * factor, _dark_level(session))


def _nan_bands(session: Path, source: Path, other: Path) -> None:
    """Floats, as other software exports them: the outermost bands and one value in a thousand are NaN."""
    rng = np.random.default_rng(0)

    def drop(counts: np.ndarray) -> np.ndarray:
        counts[..., -3:] = np.nan
        counts[rng.random(counts.shape, np.float32) < 0.001] = np.nan
        return counts

    _in_all_cubes(drop)(session, source, other)


def _sized(factor: float, container: bool) -> Make:
    def make(session: Path, source: Path, other: Path) -> None:
        without = {} if container else {"container_diameter_m": None, "container_height_m": None}
        _state(session, marker_side_m=factor * float(str(stated(session)["marker_side_m"])), **without)

    return make


def _sized_with_distance(session: Path, source: Path, other: Path) -> None:
    _sized(1.1, container=False)(session, source, other)
    camera = next(iter(SessionTruth.of(source).poses.values()))
    _state(session, camera_distance_m=float(np.linalg.norm(camera[:2, 3])))


def _other_direction(session: Path, source: Path, other: Path) -> None:
    _state(session, direction="ccw" if stated(session)["direction"] == "cw" else "cw")


def _veil(fraction: float, session: Path) -> Cubes:
    light = fraction * _white_light(session)
    return lambda counts: counts + light


def _reversed_wavelengths(session: Path, source: Path, other: Path) -> None:
    for header in session.rglob("*.hdr"):
        cube = open_cube(header)
        listed = ", ".join(f"{nm:.2f}" for nm in cube.wavelengths_nm[::-1])
        text = header.read_text(encoding="utf-8")
        text = re.sub(r"(?ms)^wavelength = \{.*?\}", f"wavelength = {{{listed}}}", text)
        header.write_text(text, encoding="utf-8")


WALL = Mistake("textured wall", nothing)
MISTAKES = [
    Mistake("none", nothing),
    WALL,
    Mistake("none, --poses colmap", nothing, ("--poses", "colmap")),
    Mistake("white is one of the frames", _frame_as_white),
    Mistake("two frames of another day and object", _another_day, replaces_frames=True),
    Mistake("two frames of another object", _another_object, replaces_frames=True),
    Mistake("a capture without capture/", _without_folder),
    Mistake("one empty capture", _empty_capture),
    Mistake("one empty capture, --skip-damaged", _empty_capture, ("--skip-damaged",)),
    Mistake("a file of 0 bytes", _empty_file),
    Mistake("no session.json", _no_session_json),
    Mistake("upright pictures as SPECIM IQ", _upright_in_specim_iq_folders),
    Mistake("light in one dark cube, 5 % of the white", _light_in_dark),
    Mistake("one dark cube is missing", _without_dark),
    Mistake("the object slips by one step", _slip),
    Mistake("a shadow on the object in two frames, -40 %", _shadow),
    Mistake("pixels not square by 5 %", _in_frames(lambda _: partial(_stretched, 1.05))),
    Mistake("mirrored images", _in_all_cubes(lambda counts: counts[:, ::-1])),
    Mistake("a grey card as white, 40 %", _in_white_light(lambda light: 0.4 * light)),
    Mistake("white half in shade, -40 %", _in_white_light(_half_in_shade)),
    Mistake("a room's lamp on the frames only", _in_frames(_room_lamp)),
    Mistake("NaN in bands and values", _nan_bands),
    Mistake("marker side in cm", _sized(100.0, container=False)),
    Mistake("marker side 10 % too long, container stated", _sized(1.1, container=True)),
    Mistake("marker side 10 % too long, no other length", _sized(1.1, container=False)),
    Mistake("marker side 10 % too long, camera distance stated", _sized_with_distance),
    Mistake("the other direction stated", _other_direction),
    Mistake(
        "frames exposed half as long as stated",
        _in_frames(lambda session: _light(lambda light: 0.5 * light, _dark_level(session))),
    ),
    Mistake("stray light of 5 % over all frames", _in_frames(partial(_veil, 0.05))),
    Mistake("stray light of 20 % over all frames", _in_frames(partial(_veil, 0.2))),
    Mistake("wavelengths listed in reverse", _reversed_wavelengths),
]
