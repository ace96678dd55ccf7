"""All checks of a session in the order of their cost, their picture, and the ``session.json`` that they suggest."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from matplotlib import rc_context

from hsi_sc_nerf.calibration.calibration_checks import check_white
from hsi_sc_nerf.calibration.reference_checks import check_dark, check_lines
from hsi_sc_nerf.calibration.white_reference import Roi
from hsi_sc_nerf.calibration.white_source import WhiteSource
from hsi_sc_nerf.capture.session import Session, open_session
from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import Finding, Level, names_in_short
from hsi_sc_nerf.inspection.capture_checks import check_files, check_frames
from hsi_sc_nerf.inspection.marker_checks import Markers, check_markers, find_markers
from hsi_sc_nerf.inspection.paper_check import check_paper
from hsi_sc_nerf.inspection.quicklook import Quicklook, quicklooks_of
from hsi_sc_nerf.plotting import COLOURS, STYLE, new_figure, save_figure, show_image
from hsi_sc_nerf.poses.known_angles import are_assumed, known_angles_deg
from hsi_sc_nerf.poses.pose_methods import PoseMethod

WHOLE_TURN_FRACTION = 0.05
"""Captures that fill a turn up to this fraction are taken for one whole turn."""
THUMBNAIL_COLUMNS = 12
THUMBNAIL_PX = 112
THUMBNAIL_GAMMA = 1.0 / 2.2


@dataclass(frozen=True, eq=False)
class Inspection:
    """What the checks of a session found.

    Attributes:
        session: the session, with the rotation of its images as measured.
        quicklooks: quicklooks of each frame.
        markers: the markers of the frames.
        findings: results of all checks.
        session_json: content of ``session.json`` with what could be measured filled in; None for what is not known.
    """

    session: Session
    quicklooks: Sequence[Quicklook]
    markers: Markers
    findings: Sequence[Finding]
    session_json: dict[str, object]

    def report(self) -> dict[str, object]:
        """Content of ``inspection.json``."""
        return {
            "session": str(self.session.path),
            "findings": [asdict(finding) for finding in self.findings],
            "session_json": self.session_json,
        }


def inspect_session(
    session: Session | Path | str,
    poses: PoseMethod = "auto",
    scale_known: bool = False,
    white_source: Literal["auto"] | WhiteSource = "auto",
    skip_damaged: bool = False,
    roi: Roi | None = None,
) -> Inspection:
    """Check a session before anything is computed from it; a few lines and bands of each cube are read.

    Args:
        session: the session, opened with ``skip_damaged``, or its folder.
        poses: how poses will be found; without a scale, "auto" and "markers" are red.
        scale_known: whether something beside ``session.json`` gives the scale.
        white_source: where the white is.
        skip_damaged: whether the user leaves damaged captures out.
        roi: region of the white; None finds a tarp by its brightness.

    Raises:
        InputError: the session cannot be opened or does not have that source of white, or a cube or the panel
            cannot be read.

    Example:
        >>> inspection = inspect_session("captures")
        >>> refuse_red(inspection.findings)
    """
    if not isinstance(session, Session):
        session = open_session(Path(session), skip_damaged=True)
    of_white = check_white(session, white_source, roi)  # first: it refuses a session without a white
    quicklooks = quicklooks_of(session, None if white_source == "target" else roi)
    markers = find_markers(session, quicklooks)
    session, upright = _upright(session, markers, poses)
    suggested = filled_in(session, markers)
    findings = [
        *check_files(session, skip_damaged),
        *of_white,
        check_dark(session, white_source, {quicklook.name: quicklook.dark_spectrum for quicklook in quicklooks}),
        *check_lines(session, [quicklook.bright_spectra for quicklook in quicklooks], white_source),
        *check_frames(session, quicklooks, markers.detections),
        *check_markers(session, markers),
        *check_paper(session, quicklooks, markers.detections, white_source),
        upright,
        check_scale(session, poses, scale_known),
        *check_angles(session, poses, markers),
    ]
    return Inspection(session, quicklooks, markers, findings, suggested)


def _upright(session: Session, markers: Markers, poses: PoseMethod) -> tuple[Session, Finding]:
    """The session with the rotation of its images by its markers, unless ``session.json`` states one.

    Markers tell which way is up, whatever is stated. Other poses take it from the images: upside down, they would set
    the object on its head.
    """
    measured, stated = markers.rotation_deg, session.info.image_rotation_deg
    values = {"stated_deg": stated, "measured_deg": measured}
    if measured is None:
        source = "session.json" if stated is not None else "the instrument's default"
        sentence = f"Upright: images are rotated by {session.image_rotation_deg} degrees, according to {source}."
        return session, Finding("upright", "green", sentence, values)
    if stated is not None and stated != measured:
        sentence = (
            f"{session.info_path}: states image_rotation_deg {stated}, but by the markers it is {measured}; correct "
            "it, or leave it out."
        )
        is_spoilt = poses in ("colmap", "angles") and (measured - stated) % 360 == 180
        return session, Finding("upright", "red" if is_spoilt else "amber", sentence, values)
    sentence = f"Upright: images are rotated by {measured} degrees, as the markers show."
    return replace(session, image_rotation_deg=measured), Finding("upright", "green", sentence, values)


def filled_in(session: Session, markers: Markers) -> dict[str, object]:
    """Content of ``session.json``: what it states, what the markers show, and None for a scale that is not known."""
    default = SessionInfo()
    stated = {
        field.name: getattr(session.info, field.name)
        for field in fields(SessionInfo)
        if getattr(session.info, field.name) != getattr(default, field.name)
    }
    content: dict[str, object] = {"object": session.path.resolve().name}
    if markers.dictionary is not None:
        content |= {"marker_dictionary": markers.dictionary, "marker_side_m": None}
    step = markers.usual_step_deg
    if step is not None:
        content["nominal_step_deg"] = _nominal_step_deg(session, abs(step))
        content["direction"] = "ccw" if step > 0.0 else "cw"
    return content | stated


def _nominal_step_deg(session: Session, usual_step_deg: float) -> float:
    """Step from place to place in the turn, by the usual step from frame to frame.

    The markers show whether the captures that are left out belong to a whole turn: of both counts, the one that fits
    the step better is taken.
    """
    step = usual_step_deg / float(np.median(np.diff(session.places)))
    count = min(len(session.turn), len(session.frames), key=lambda captures: abs(captures * step - 360.0))
    whole = abs(count * step / 360.0 - 1.0) < WHOLE_TURN_FRACTION
    return round(360.0 / count, 3) if whole else round(2.0 * step) / 2.0


def suggestion(session: Session, content: dict[str, object]) -> str:
    """Lines that show a ``session.json`` to copy."""
    missing = [key for key, value in content.items() if value is None]
    fill_in = f", with values of {', '.join(missing)} instead of null" if missing else ""
    return (
        f"The frames show the following; write it to {session.info_path}{fill_in}:\n{json.dumps(content, indent=2)}"
    )


def check_scale(session: Session, poses: PoseMethod, scale_known: bool) -> Finding:
    """The finding ``scale``: whether anything gives the scale.

    Args:
        poses: how poses will be found; from features or angles they may do without a scale.
        scale_known: whether something beside ``session.json`` gives it.
    """
    info = session.info
    known = {
        name: value
        for name in ("marker_side_m", "container_diameter_m", "camera_distance_m")
        if (value := getattr(info, name)) is not None
    }
    if known or scale_known:
        given = " and ".join(known) or "an option"
        return Finding("scale", "green", f"Scale: given by {given}.", known)
    where = f"{session.info_path}: does not give" if session.info_path.is_file() else f"{session.path}: nothing gives"
    sentence = (
        f"{where} a scale; state marker_side_m, the side of a marker's black square in metres, in session.json or "
        "by --marker-side-m, or go on without a scale by --poses colmap."
    )
    return Finding("scale", "red" if poses in ("auto", "markers") else "amber", sentence)


def check_angles(session: Session, poses: PoseMethod, markers: Markers) -> list[Finding]:
    """The finding ``angles`` if those of ``session.json`` cannot be used or are needed and missing, or rest on an
    assumption about captures that are left out."""
    info, places = session.info, session.places
    needed = poses == "angles" or (poses == "auto" and markers.dictionary is None)
    try:
        known_angles_deg(info, places, required=poses == "angles")
    except InputError as error:
        return [Finding("angles", "red" if needed else "amber", f"{session.info_path}: {error}.")]
    step, frames = info.nominal_step_deg, {frame.name for frame in session.frames}
    if step is None or not are_assumed(info, places):
        return []
    gaps = [name for name in session.turn[places[0] : places[-1]] if name not in frames]
    sentence = (
        f"The table is taken to have turned by a nominal step for {names_in_short(gaps)}, too, left out between "
        f"{session.frames[0].name} and {session.frames[-1].name}; if it did not, give frame_angles_deg."
    )
    values = dict(
        zip([frame.name for frame in session.frames], [step * (p - places[0]) for p in places], strict=True)
    )
    # Held angles are measured by nothing; features measure them otherwise, and markers do without them.
    level: Level = "red" if poses == "angles" else "amber" if needed or poses == "colmap" else "green"
    return [Finding("angles", level, sentence, values)]


def draw_inspection(inspection: Inspection, path: Path) -> None:
    """Draw the picture.

    Raises:
        InputError: the operating system refused to write.
    """
    quicklooks, session = inspection.quicklooks, inspection.session
    names = [q.name for q in quicklooks]
    red = " ".join(finding.sentence for finding in inspection.findings if finding.level == "red")
    rows = -(-len(quicklooks) // THUMBNAIL_COLUMNS)
    thumbnails = [_thumbnail(np.rot90(q.picture, session.quarter_turns)) for q in quicklooks]
    height, width = thumbnails[0].shape[:2]
    sheet = np.ones((rows * height, THUMBNAIL_COLUMNS * width, 3), np.float32)
    lines: dict[str, Sequence[float]] = {
        "brightness": [float(q.picture.mean()) for q in quicklooks],
        "sharpness, 1/px": [q.sharpness_per_px for q in quicklooks],
        "markers": [len(seen) for seen in inspection.markers.detections],
    }
    with rc_context(STYLE):
        figure = new_figure(11.0, 1.0 + 11.0 / THUMBNAIL_COLUMNS * rows * height / width + 3.6)
        parts = figure.subplots(1 + len(lines), 1, height_ratios=[max(1.2 * rows, 1.2), 1, 1, 1])
        parts[0].set_title(session.path.resolve().name)
        for index, (name, thumbnail) in enumerate(zip(names, thumbnails, strict=True)):
            top, left = index // THUMBNAIL_COLUMNS * height, index % THUMBNAIL_COLUMNS * width
            sheet[top : top + height, left : left + width] = thumbnail
            box = {"color": COLOURS[1] if is_named(name, red) else "0.2", "pad": 1}
            parts[0].text(left + 3, top + 3, name, fontsize=6, va="top", color="white", bbox=box)
        show_image(parts[0], sheet)
        for axes, (label, values) in zip(parts[1:], lines.items(), strict=True):
            axes.plot(values, marker=".", color=COLOURS[0])
            axes.set(ylabel=label, ylim=(0, 1.1 * max(max(values), 1e-9)))
            shown = range(0, len(names), max(1, len(names) // 12))
            labels = [names[index] for index in shown] if axes is parts[-1] else []
            axes.set_xticks(list(shown), labels or [""] * len(shown), rotation=30, ha="right", fontsize=7)
        save_figure(figure, path)


def is_named(name: str, sentences: str) -> bool:
    """Whether sentences name a capture, not only one whose name begins or ends with the same letters."""
    return re.search(rf"(?<![^\s'(]){re.escape(name)}(?![\w-]|\.\w)", sentences) is not None


def _thumbnail(picture: np.ndarray) -> np.ndarray:
    """A small picture, brightened as a photograph, with a white border at the right and below."""
    scale = THUMBNAIL_PX / max(picture.shape[:2])
    small = cv2.resize(np.ascontiguousarray(picture), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.pad(np.clip(small, 0.0, 1.0) ** THUMBNAIL_GAMMA, ((0, 3), (0, 3), (0, 0)), constant_values=1.0)
