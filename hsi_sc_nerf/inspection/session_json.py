"""What ``session.json`` could state, filled in from the markers; and whether anything gives the scale."""

from __future__ import annotations

import json
from dataclasses import fields

from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.inspection.marker_checks import Markers
from hsi_sc_nerf.poses.pose_methods import PoseMethod

WHOLE_TURN_DEG = 0.05
"""Frames that fill a turn to this fraction are taken for one whole turn."""


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
        turn = abs(step) * len(session.frames)
        whole = abs(turn / 360.0 - 1.0) < WHOLE_TURN_DEG
        content["nominal_step_deg"] = round(360.0 / len(session.frames), 3) if whole else round(2.0 * abs(step)) / 2.0
        content["direction"] = "ccw" if step > 0.0 else "cw"
    return content | stated


def suggestion(session: Session, content: dict[str, object]) -> str:
    """Lines that show a ``session.json`` to copy."""
    missing = [key for key, value in content.items() if value is None]
    ask = f" with {', '.join(missing)} in the place of null" if missing else ""
    return f"This is what the frames show; write it to {session.info_path}{ask}:\n{json.dumps(content, indent=2)}"


def check_scale(session: Session, poses: PoseMethod, scale_known: bool) -> Finding:
    """The finding ``scale``: whether anything gives the size of what is seen.

    Args:
        session: the session.
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
        return Finding("scale", "green", f"Scale: {', '.join(known) or 'an option'} gives it.", known)
    where = f"{session.info_path}: does not give" if session.info_path.is_file() else f"{session.path}: nothing gives"
    sentence = (
        f"{where} a scale; state marker_side_m, the side of a marker's black square in metres, in session.json or "
        "by --marker-side-m, or do without a scale by --poses colmap."
    )
    return Finding("scale", "red" if poses in ("auto", "markers") else "amber", sentence)
