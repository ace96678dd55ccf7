"""All checks of a session, in the order of their cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hsi_sc_nerf.calibration.white_check import check_white
from hsi_sc_nerf.calibration.white_source import WhiteSource
from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.inspection.file_checks import check_files
from hsi_sc_nerf.inspection.frame_checks import check_frames
from hsi_sc_nerf.inspection.look import Look, look_at_frames
from hsi_sc_nerf.inspection.marker_checks import Markers, check_markers, find_markers
from hsi_sc_nerf.inspection.session_json import check_scale, filled_in
from hsi_sc_nerf.poses.pose_methods import PoseMethod
from hsi_sc_nerf.poses.upright import rotation_from_corners

INSPECTION_NAME = "inspection.json"
UPRIGHT_FRAMES = 6
"""Frames from whose markers the upright direction is measured."""
FEWEST_SIGHTINGS = 4
"""Fewest markers, over these frames, that can show it."""


@dataclass(frozen=True, eq=False)
class Inspection:
    """What the checks of a session found.

    Attributes:
        session: the session, with the rotation of its images as measured.
        looks: a look at each frame.
        markers: what is seen of markers.
        findings: results of all checks.
        session_json: content of ``session.json`` with what could be measured filled in; None for what is not known.
    """

    session: Session
    looks: Sequence[Look]
    markers: Markers
    findings: Sequence[Finding]
    session_json: dict[str, object]

    def report(self) -> dict[str, object]:
        """Content of ``inspection.json``."""
        return {
            "session": str(self.session.path),
            "findings": [finding.as_json() for finding in self.findings],
            "session_json": self.session_json,
        }


def inspect_session(
    session: Session,
    poses: PoseMethod = "auto",
    scale_known: bool = False,
    white_source: Literal["auto"] | WhiteSource = "auto",
) -> Inspection:
    """Check a session before anything is computed from it; a few lines and bands of each cube are read.

    Args:
        session: the session, opened with ``skip_damaged``.
        poses: how poses will be found; without a scale, "auto" and "markers" are red.
        scale_known: whether something beside ``session.json`` gives the scale.
        white_source: where the white is.

    Raises:
        InputError: the session does not have that source of white, a cube cannot be read, or ``session.json`` names
            an unknown marker dictionary.

    Example:
        >>> inspection = inspect_session(open_session(Path("captures"), skip_damaged=True))
        >>> refuse_red(inspection.findings)
    """
    looks = look_at_frames(session)
    markers = find_markers(session, looks)
    session, upright = _upright(session, markers)
    suggested = filled_in(session, markers)
    findings = [
        *check_files(session),
        *check_white(session, white_source),
        *check_frames(session, looks, markers.detections),
        *check_markers(session, markers),
        upright,
        check_scale(session, poses, scale_known),
    ]
    return Inspection(session, looks, markers, findings, suggested)


def _upright(session: Session, markers: Markers) -> tuple[Session, Finding]:
    """The session with the rotation of its images by its markers, unless ``session.json`` states one."""
    step = max(1, len(markers.detections) // UPRIGHT_FRAMES)
    sightings = [
        (frame, marker, corners)
        for frame, seen in enumerate(markers.detections[::step])
        for marker, corners in seen.items()
    ]
    measured = None
    if len(sightings) >= FEWEST_SIGHTINGS:
        frame, marker, corners = (np.array(column) for column in zip(*sightings, strict=True))
        measured = rotation_from_corners(frame, marker, corners)
    values = {"stated_deg": session.info.image_rotation_deg, "measured_deg": measured}
    assumed = session.image_rotation_deg
    if measured is None:
        source = "session.json" if session.info.image_rotation_deg is not None else "the instrument's habit"
        return session, Finding(
            "upright", "green", f"Upright: images are rotated by {assumed} degrees by {source}.", values
        )
    if session.info.image_rotation_deg is not None and measured != assumed:
        sentence = (
            f"{session.info_path}: states image_rotation_deg {assumed}, but by the markers it is {measured}; correct "
            "it, or leave it out."
        )
        return session, Finding("upright", "amber", sentence, values)
    sentence = f"Upright: images are rotated by {measured} degrees, as the markers show."
    return replace(session, image_rotation_deg=measured), Finding("upright", "green", sentence, values)
