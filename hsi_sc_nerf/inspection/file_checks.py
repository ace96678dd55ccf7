"""Checks that need no pixels: every capture accounted for, and what the headers say of day, exposure and binning."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from hsi_sc_nerf.capture.session import Capture, Session, in_short
from hsi_sc_nerf.findings import Finding, Level

_DAY = re.compile(r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}")


def check_files(session: Session) -> list[Finding]:
    """The findings ``frames``, ``damaged``, ``dates``, ``integration-times`` and ``binning``."""
    return [
        _frames(session),
        *_damaged(session),
        _same(
            session,
            "dates",
            "acquisition days",
            acquisition_day,
            "red",
            "frames of another day may show another object under other light; leave them out",
        ),
        _same(
            session,
            "integration-times",
            "integration times (ms)",
            lambda capture: capture.integration_time_ms,
            "amber",
            "reflectance is scaled accordingly, with more noise in the shorter ones",
        ),
        _same(session, "binning", "binnings", _binning, "red", "their pixels do not match; leave them out"),
    ]


def acquisition_day(capture: Capture) -> str | None:
    """The day that the header states, as it writes it; None without one."""
    text = str(capture.cube.fields.get("acquisition date", "")).strip()
    match = _DAY.search(text)
    return match.group() if match else text or None


def names_in_short(names: Sequence[str], most: int = 6) -> str:
    """Names in a sentence; of many the first ones and their number."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def leave_out(names: Sequence[str]) -> str:
    """The options that leave captures out."""
    return " ".join(f"--exclude {name}" for name in names)


def _binning(capture: Capture) -> str | None:
    binning = capture.cube.fields.get("binning")
    return None if binning is None else " x ".join(binning) if isinstance(binning, list) else str(binning)


def _frames(session: Session) -> Finding:
    white = "no white reference" if session.white is None else f"the white reference {session.white.name}"
    first, last = session.frames[0].name, session.frames[-1].name
    parts = [f"{len(session.frames)} frames ({first} to {last}) and {white}"]
    if session.excluded:
        parts.append(f"left out by --exclude: {names_in_short(session.excluded)}")
    if session.skipped:
        parts.append(f"no captures: {names_in_short(list(session.skipped))}")
    values = {
        "frames": [frame.name for frame in session.frames],
        "white": None if session.white is None else session.white.name,
        "excluded": list(session.excluded),
        "skipped": dict(session.skipped),
        "size_px": list(session.frames[0].cube.shape[:2]),
        "bands": session.frames[0].cube.shape[2],
    }
    level: Level = "amber" if any(name.lower().endswith(".hdr") for name in session.skipped) else "green"
    return Finding("frames", level, "; ".join(parts) + ".", values)


def _damaged(session: Session) -> list[Finding]:
    if not session.damaged:
        return []
    sentence = (
        f"{session.path}: {in_short(session.damaged)} cannot be used; copy the captures again, or leave them out "
        "with --skip-damaged."
    )
    return [Finding("damaged", "red", sentence, dict(session.damaged))]


def _same(
    session: Session, name: str, what: str, value_of: Callable[[Capture], object], level: Level, advice: str
) -> Finding:
    """Whether a value of the headers is the same in all frames; those that differ from most are named."""
    values: Mapping[str, object] = {frame.name: value_of(frame) for frame in session.frames}
    given = Counter(value for value in values.values() if value is not None)
    if not given:
        return Finding(name, "green", f"The headers state no {what}.")
    usual = given.most_common(1)[0][0]
    others = [frame for frame, value in values.items() if value not in (usual, None)]
    if not others:
        white = None if session.white is None else value_of(session.white)
        if name == "dates" and white not in (usual, None):
            sentence = f"The white reference was taken on {white}, the frames on {usual}; take both on one day."
            return Finding(name, "amber", sentence, {"usual": usual, "white": white})
        return Finding(name, "green", f"All frames have the same {what}: {usual}.", {"usual": usual})
    differing = ", ".join(sorted({str(values[frame]) for frame in others}))
    sentence = (
        f"{session.path}: the {what} of {names_in_short(others)} differ from the other frames' ({differing}, not "
        f"{usual}): {advice}"
    )
    sentence += f" with {leave_out(others)}." if level == "red" else "."
    return Finding(name, level, sentence, {"usual": usual, "others": {f: values[f] for f in others}})
