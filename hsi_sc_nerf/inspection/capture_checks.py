"""Checks of the captures: headers, exposure, focus, copies, and frames of another object."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Float
from scipy.stats import median_abs_deviation

from hsi_sc_nerf.capture.roles import damaged_captures, in_short
from hsi_sc_nerf.capture.session import Capture, Session
from hsi_sc_nerf.findings import Finding, Level, leave_out, names_in_short
from hsi_sc_nerf.inspection.quicklook import Quicklook, saturation_level
from hsi_sc_nerf.poses.marker_detection import Detections

_TIME = re.compile(r"\d+:\d+(:\d+)?")
_DAY = re.compile(
    r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}"  # 2018-06-21, 21.6.2018
    r"|\d{1,2}[-/. ]+[a-z]{3,}[-/. ]+\d{4}"  # 21-Jun-2018
    r"|[a-z]{3,}[. ]+\d{1,2}[, ]+\d{4}"  # Jun 21 2018
    r"|\d{8}",  # 20180621
    re.IGNORECASE,
)
SATURATED_AMBER, SATURATED_RED = 0.005, 0.25
"""Fractions of a frame's values that are saturated: highlights are flagged one by one; above the second limit the
exposure is wrong."""
DARK_AMBER, DARK_RED = 0.2, 0.95
"""Fractions of a frame's values without light: some in the outermost bands of a good session, all with a covered
lens."""
BLURRED = 0.6
"""A frame is less sharp than the others if its edges have this fraction of their slope."""
COMPARED_PX = 40
"""Side of the pictures in which frames are compared."""
FEWEST_COMPARED = 8
"""Fewest frames with which a different one can be recognised."""
ACCURACY_BY_VIEWS = {
    8: (2.2, 86, 0.9, 1),
    12: (1.5, 96, 0.5, 7),
    20: (1.2, 97, 0.3, 2),
    30: (1.0, 97, 0.4, 3),
    60: (0.9, 98, 0.3, 2),
}
"""Percent by number of views: root mean square error of the reflectance, F-score at 0.5 mm, error of the volume and
of the area of a bruise (docs/validation/accuracy_and_time.md)."""
LEAST_SPREAD, LARGEST_DEVIATION = 0.02, 8.0
"""Deviations are divided by a pixel's spread over the frames (at least this reflectance) and limited to this many."""
DIFFERENT_AMBER, DIFFERENT_RED = 1.5, 2.7
"""Deviation of a frame over the median of all. Frames of one object, also of a long or bruised one over half a turn,
stay below 1.3; a camera moved by 2 of 128 pixels gives 2.3; another kind of fruit 3.5 to 8."""


def check_files(session: Session, skip_damaged: bool = False) -> list[Finding]:
    """The findings ``frames``, ``damaged``, ``dates``, ``integration-times`` and ``binning``.

    Args:
        skip_damaged: whether the user leaves damaged captures out.
    """
    return [
        _frames(session),
        *_damaged(session, skip_damaged),
        _same(
            session,
            "dates",
            ("acquisition day", "acquisition days"),
            acquisition_day,
            "red",
            "frames of another day may show another object under other light; leave them out",
        ),
        _same(
            session,
            "integration-times",
            ("integration time (ms)", "integration times (ms)"),
            lambda capture: capture.integration_time_ms,
            "amber",
            "reflectance is scaled accordingly, with more noise in the shorter ones",
        ),
        _same(
            session, "binning", ("binning", "binnings"), _binning, "red", "their pixels do not match; leave them out"
        ),
    ]


def acquisition_day(capture: Capture) -> str | None:
    """The day that the header states, as it writes it but without the time; None without one."""
    text = _TIME.sub(" ", str(capture.cube.fields.get("acquisition date", "")))
    match = _DAY.search(" ".join(text.split()))
    return match.group() if match else None


def _binning(capture: Capture) -> str | None:
    binning = capture.cube.fields.get("binning")
    return None if binning is None else " x ".join(binning) if isinstance(binning, list) else str(binning)


def _accuracy_of(views: int) -> str:
    """How accurately a simulated pear was reconstructed from this number of views, or the next smaller one."""
    tried = max((count for count in ACCURACY_BY_VIEWS if count <= views), default=min(ACCURACY_BY_VIEWS))
    rmse_percent, near_percent, volume_percent, bruise_percent = ACCURACY_BY_VIEWS[tried]
    return (
        f"with {tried} views, a simulated pear had errors of {rmse_percent:g} % in reflectance, {volume_percent:g} % "
        f"in volume and {bruise_percent:g} % in the area of a bruise, and {near_percent:g} % of its surface was "
        "within 0.5 mm"
    )


def _frames(session: Session) -> Finding:
    white = "no white reference" if session.white is None else f"the white reference {session.white.name}"
    first, last = session.frames[0].name, session.frames[-1].name
    parts = [f"{len(session.frames)} frames ({first} to {last}) and {white}"]
    if len(session.frames) < max(ACCURACY_BY_VIEWS):
        parts.append(_accuracy_of(len(session.frames)))
    if session.excluded:
        parts.append(f"left out by --exclude: {names_in_short(session.excluded)}")
    if session.skipped:
        parts.append(f"not captures: {names_in_short(list(session.skipped))}")
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


def _damaged(session: Session, skip_damaged: bool) -> list[Finding]:
    if not session.damaged:
        return []
    if skip_damaged:
        sentence = f"Damaged, and left out by --skip-damaged: {in_short(session.damaged)}."
        return [Finding("damaged", "amber", sentence, dict(session.damaged))]
    return [Finding("damaged", "red", damaged_captures(session.path, session.damaged), dict(session.damaged))]


def _same(
    session: Session,
    name: str,
    one_and_more: tuple[str, str],
    value_of: Callable[[Capture], object],
    level: Level,
    advice: str,
) -> Finding:
    """The finding on a value of the headers, named in singular and plural, that should be the same in all frames."""
    what, whats = one_and_more
    values: Mapping[str, object] = {frame.name: value_of(frame) for frame in session.frames}
    given = Counter(value for value in values.values() if value is not None)
    if not given:
        return Finding(name, "green", f"The headers do not state the {what}.")
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
        f"{session.path}: the {whats} of {names_in_short(others)} differ from the other frames' ({differing}, not "
        f"{usual}): {advice}"
    )
    sentence += f" with {leave_out(others)}." if level == "red" else "."
    return Finding(name, level, sentence, {"usual": usual, "others": {f: values[f] for f in others}})


def check_frames(
    session: Session, quicklooks: Sequence[Quicklook], detections: Sequence[Detections]
) -> list[Finding]:
    """The findings ``exposure``, ``focus``, ``copies`` and ``other-object``.

    Args:
        quicklooks: quicklooks of its frames.
        detections: markers of each frame.
    """
    return [
        _exposure(session, quicklooks),
        _focus(quicklooks),
        _copies(session, quicklooks),
        _other_object(session, quicklooks, detections),
    ]


def deviations(pictures: Sequence[Float[np.ndarray, "h w channels"]]) -> Float[np.ndarray, "frames"]:
    """How much each frame deviates from what most frames show, over the median of all frames.

    Pictures are compared small and at one brightness. A pixel that changes as the object turns has a large spread
    over the frames, and weighs little.
    """
    side = (COMPARED_PX, COMPARED_PX)
    resized = [np.asarray(cv2.resize(picture, side, interpolation=cv2.INTER_AREA), float) for picture in pictures]
    small = np.clip(np.stack(resized), 0.0, 1.5)
    brightness = np.median(small / np.maximum(np.median(small, axis=0), 0.02), axis=(1, 2, 3), keepdims=True)
    small /= np.maximum(brightness, 1e-3)
    difference = np.abs(small - np.median(small, axis=0))
    spread = np.maximum(median_abs_deviation(small, scale="normal"), LEAST_SPREAD)
    deviation = np.minimum(difference / spread, LARGEST_DEVIATION).mean(axis=(1, 2, 3))
    return deviation / max(float(np.median(deviation)), 1e-12)


def _exposure(session: Session, quicklooks: Sequence[Quicklook]) -> Finding:
    level = saturation_level(session, quicklooks) if session.has_counts else None
    saturated = np.array([q.at_top_fraction * (level is not None and q.top_counts >= level) for q in quicklooks])
    dark = np.array([q.dark_fraction for q in quicklooks])
    wavelengths_nm = session.wavelengths_nm
    bright_frames, dark_frames = saturated.mean(axis=1), dark.mean(axis=1)
    worst = int(saturated.mean(axis=0).argmax())
    found: Level = "green"
    if bright_frames.max() > SATURATED_AMBER or dark_frames.max() > DARK_AMBER:
        found = "amber"
    if bright_frames.max() > SATURATED_RED or dark_frames.max() > DARK_RED:
        found = "red"
    most = 100.0 * saturated.mean(axis=0)[worst]
    text = (
        f"{100.0 * bright_frames.mean():.2g} % of the frames' values are saturated"
        f"{f' (most at {wavelengths_nm[worst]:.0f} nm: {most:.2g} %)' if most else ''}, "
        f"{100.0 * dark_frames.mean():.2g} % are dark"
    )
    if bright_frames.max() > SATURATED_AMBER:
        text += f"; the brightest frame is {quicklooks[int(bright_frames.argmax())].name}, expose shorter"
    elif dark_frames.max() > DARK_AMBER:
        text += f"; the darkest frame is {quicklooks[int(dark_frames.argmax())].name}, expose longer"
    values = {
        "saturation_counts": level,
        "saturated_fraction_by_frame": _by_name(quicklooks, bright_frames),
        "dark_fraction_by_frame": _by_name(quicklooks, dark_frames),
        "saturated_fraction_by_band": saturated.mean(axis=0).round(5).tolist(),
        "dark_fraction_by_band": dark.mean(axis=0).round(5).tolist(),
    }
    return Finding("exposure", found, f"{session.path}: {text}." if found == "red" else f"Exposure: {text}.", values)


def _focus(quicklooks: Sequence[Quicklook]) -> Finding:
    sharpness = np.array([q.sharpness_per_px for q in quicklooks])
    relative = sharpness / max(float(np.median(sharpness)), 1e-12)
    blurred = [q.name for q, ratio in zip(quicklooks, relative, strict=True) if ratio < BLURRED]
    values = {"sharpness_over_median": _by_name(quicklooks, relative)}
    if blurred:
        sentence = f"Focus: less sharp than the other frames: {names_in_short(blurred)}; look at the picture."
        return Finding("focus", "amber", sentence, values)
    return Finding("focus", "green", "Focus: all frames are about equally sharp.", values)


def _copies(session: Session, quicklooks: Sequence[Quicklook]) -> Finding:
    first_of: dict[str, str] = {}
    copies = [(first, q.name) for q in quicklooks if (first := first_of.setdefault(q.digest, q.name)) != q.name]
    if not copies:
        return Finding("copies", "green", "No frame is a copy of another.")
    text = ", ".join(f"{copy} is a copy of {first}" for first, copy in copies[:4])
    sentence = f"{session.path}: {text}; leave copies out with {leave_out([copy for _, copy in copies])}."
    return Finding("copies", "red", sentence, {"copies": [list(pair) for pair in copies]})


def _other_object(session: Session, quicklooks: Sequence[Quicklook], detections: Sequence[Detections]) -> Finding:
    if len(quicklooks) < FEWEST_COMPARED:
        return Finding("other-object", "green", "There are too few frames to recognise another object.")
    ratios = deviations([q.picture for q in quicklooks])
    seen = [set(found) for found in detections]
    strangers = [
        look.name
        for index, look in enumerate(quicklooks)
        if len(seen[index]) > 1
        and not any(seen[index] & other for number, other in enumerate(seen) if number != index)
    ]
    different = [q.name for q, ratio in zip(quicklooks, ratios, strict=True) if ratio > DIFFERENT_RED]
    values = {"deviation_over_median": _by_name(quicklooks, ratios), "unknown_markers": strangers}
    wrong = [q.name for q in quicklooks if q.name in {*different, *strangers}]
    if wrong:
        why = "unlike all other frames" if different else "markers that no other frame shows"
        sentence = (
            f"{session.path}: {why} (another object, or a moved camera): {names_in_short(wrong)}; leave out with "
            f"{leave_out(wrong)}."
        )
        return Finding("other-object", "red", sentence, values)
    doubtful = [q.name for q, ratio in zip(quicklooks, ratios, strict=True) if ratio > DIFFERENT_AMBER]
    if doubtful:
        sentence = f"Somewhat unlike the other frames: {names_in_short(doubtful)}; compare them in the picture."
        return Finding("other-object", "amber", sentence, values)
    return Finding("other-object", "green", "All frames look like frames of one object.", values)


def _by_name(quicklooks: Sequence[Quicklook], numbers: Float[np.ndarray, "frames"]) -> dict[str, float]:
    return {q.name: round(float(number), 5) for q, number in zip(quicklooks, numbers, strict=True)}
