"""Checks of the markers: how many are detected, how far the table turned, and how accurate poses from them will be.

A first estimate of the poses, from markers as they are detected, gives the turn of the table and the images' rotation
from upright.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, UInt8

from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import Finding, Level, names_in_short
from hsi_sc_nerf.inspection.quicklook import WORKERS, Quicklook, reflectance_noise
from hsi_sc_nerf.poses.marker_detection import Detections, detect_markers, find_dictionary
from hsi_sc_nerf.poses.marker_fit import fit_marker
from hsi_sc_nerf.poses.marker_initialisation import initialise
from hsi_sc_nerf.poses.model_selection import usable
from hsi_sc_nerf.poses.turntable import FEWEST_FRAMES, MarkerObservations

LEAST_NOISE = 1e-4
"""Smallest noise of the reflectance that is stated."""
FITTED_MARKERS = 5
"""Number of markers whose corners are fitted, to estimate the corners' error."""
MIRRORED_FRAMES, MORE_IN_MIRROR = 6, 2
"""Number of frames whose mirror images are searched for markers if the images themselves show no turn, and the factor
by which the mirror images must show more markers."""
EXPECTED = ((20.0, 0.04, 0.5), (10.0, 0.05, 0.6), (8.0, 0.5, 6.5))
"""Smallest side of a marker in px, and the largest error of poses in degrees and mm that simulated sessions with such
markers have (docs/validation/poses.md). Smaller markers are refused."""
STOOD_STILL = 0.2
"""The table did not turn if it turned by less than this fraction of the usual step."""
LARGE_GAP = 1.7
"""A step counts as a gap from this factor of the usual step, which unevenness does not reach."""
LEAST_TURN_DEG = 20.0
"""Shorter arcs of the markers' circles do not determine the axis."""
LOOKS_DOWN_DEG = (5.0, 85.0)
"""Elevations of the camera at which the turntable shows which way up the image is: not at its side or above it."""
LARGEST_ROLL_DEG = 30.0
"""Largest roll of the camera beside a quarter turn."""


@dataclass(frozen=True, eq=False)
class Markers:
    """The markers of a session.

    Attributes:
        dictionary: dictionary of the markers; None if no marker was detected.
        detections: markers of each frame.
        angles_deg: the table's angle by frame, counter-clockwise from above; nan where it is not known.
        rotation_deg: rotation of the files' images from upright, counter-clockwise: 0, 90, 180 or 270; None if the
            markers do not determine it.
        side_px: median side of a marker; nan without any.
        corner_error_px: standard deviation of a fitted corner; nan where none could be fitted.
        mirrored: whether markers are detected only in the images' mirror images.
    """

    dictionary: str | None
    detections: list[Detections]
    angles_deg: Float[np.ndarray, "frames"]
    rotation_deg: int | None
    side_px: float
    corner_error_px: float
    mirrored: bool = False

    @property
    def steps_deg(self) -> Float[np.ndarray, "steps"]:
        """Turns from frame to frame, in (-180, 180]; nan where one is not known."""
        return (np.diff(self.angles_deg) + 180.0) % 360.0 - 180.0

    @property
    def usual_step_deg(self) -> float | None:
        """Usual turn from frame to frame, positive counter-clockwise; None if it is not known, or none is usual."""
        steps = self.steps_deg[np.isfinite(self.steps_deg)]
        median = np.median(steps) if len(steps) else 0.0
        near = steps[np.abs(steps - median) <= 0.5 * abs(median)]
        return float(near.mean()) if len(near) >= max(1, len(self.angles_deg) // 3) else None


def find_markers(session: Session, quicklooks: Sequence[Quicklook]) -> Markers:
    """Look for markers in all frames, of the stated dictionary or of the one that fits best."""
    grays = [quicklook.gray for quicklook in quicklooks]
    dictionary = session.info.marker_dictionary or find_dictionary(grays)
    detections: list[Detections] = [{} for _ in grays]
    if dictionary is not None:
        with ThreadPoolExecutor(WORKERS) as pool:
            detections = list(pool.map(partial(detect_markers, dictionary=dictionary), grays))
    seen = [(index, *marker) for index, found in enumerate(detections) for marker in found.items()]
    sides = [np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean() for _, _, corners in seen]
    errors = []
    for number in np.unique(np.linspace(0, max(len(seen) - 1, 0), FITTED_MARKERS).astype(int))[: len(seen)].tolist():
        index, marker, corners = seen[number]
        assert dictionary is not None
        fit = fit_marker(grays[index].astype(float), dictionary, marker, corners)
        if fit is not None:
            errors.append(float(np.sqrt(np.diag(fit.covariance_px2).mean())))
    markers = Markers(
        dictionary if sides else None,
        detections,
        *turn_and_rotation_deg(detections, grays[0].shape),
        float(np.median(sides)) if sides else float("nan"),
        float(np.median(errors)) if errors else float("nan"),
    )
    if markers.usual_step_deg is None and _seen_in_mirror(grays, detections, session.info.marker_dictionary):
        return replace(markers, mirrored=True)
    return markers


def _seen_in_mirror(
    grays: Sequence[UInt8[np.ndarray, "h w"]], detections: Sequence[Detections], dictionary: str | None
) -> bool:
    """Whether frames show far more markers when they are mirrored; a few may be misread cells."""
    chosen = np.unique(np.linspace(0, len(grays) - 1, MIRRORED_FRAMES).astype(int)).tolist()
    mirrored = [np.ascontiguousarray(grays[index][:, ::-1]) for index in chosen]
    dictionary = dictionary or find_dictionary(mirrored)
    if dictionary is None:
        return False
    seen = sum(len(detect_markers(gray, dictionary)) for gray in mirrored)
    return seen > max(MORE_IN_MIRROR * sum(len(detections[index]) for index in chosen), len(chosen))


def check_markers(session: Session, markers: Markers) -> list[Finding]:
    """The findings ``markers``, ``mirrored``, ``turn`` and ``expected-accuracy``."""
    findings = [_seen(session, markers), _turn(session, markers), _expected(session, markers)]
    if markers.mirrored:
        sentence = (
            f"{session.path}: the images are mirrored: their markers can be read only in a mirror, and the model "
            "would be the object's mirror image; export the cubes without flipping their lines or samples."
        )
        findings.insert(1, Finding("mirrored", "red", sentence))
    return findings


def _seen(session: Session, markers: Markers) -> Finding:
    numbers = np.array([len(seen) for seen in markers.detections])
    names = [frame.name for frame in session.frames]
    values: dict[str, object] = {
        "dictionary": markers.dictionary,
        "markers_by_frame": dict(zip(names, numbers.tolist(), strict=True)),
        "side_px": None if np.isnan(markers.side_px) else round(markers.side_px, 2),
        "corner_error_px": None if np.isnan(markers.corner_error_px) else round(markers.corner_error_px, 4),
    }
    if markers.dictionary is None:
        stated = session.info.marker_dictionary
        of = f"of {stated}" if stated else "of the usual dictionaries"
        sentence = f"No marker {of} was detected; without markers, poses need texture or known angles, and a scale."
        return Finding("markers", "amber", sentence, values)
    text = f"{np.median(numbers):g} markers of {markers.dictionary} a frame, {markers.side_px:.0f} px wide"
    if np.isfinite(markers.corner_error_px):
        text += f", with a corner error of {markers.corner_error_px:.2g} px"
    without = [name for name, number in zip(names, numbers, strict=True) if number == 0]
    level: Level = "green"
    if without:
        level, text = "amber", f"{text}; none was detected in {names_in_short(without)}, which will be left out"
    elif np.median(numbers) < 2 or markers.side_px < EXPECTED[-1][0]:
        level, text = "amber", f"{text}; show more or larger ones"
    return Finding("markers", level, f"Markers: {text}.", values)


def _turn(session: Session, markers: Markers) -> Finding:
    known = np.isfinite(markers.angles_deg)
    step = markers.usual_step_deg
    names = [frame.name for frame in session.frames]
    if step is None and known.sum() > len(known) // 2:
        sentence = (
            "The table's steps from frame to frame are too different for one to be usual; check that the frames' "
            "names are in the order of the turn."
        )
        return Finding("turn", "amber", sentence)
    if step is None or abs(step) < 0.1:
        return Finding(
            "turn", "amber", "The table's turn is not known before the poses: too few frames share markers."
        )
    direction = "ccw" if step > 0.0 else "cw"
    ordered = np.sort(markers.angles_deg[known] % 360.0)
    gaps = np.diff(np.append(ordered, ordered[0] + 360.0))
    gap = int(gaps.argmax())
    values: dict[str, object] = {
        "usual_step_deg": round(abs(step), 2),
        "direction": direction,
        "largest_gap_deg": round(float(gaps[gap]), 1),
        "angle_deg_by_frame": {
            name: round(float(a), 1) if np.isfinite(a) else None
            for name, a in zip(names, markers.angles_deg, strict=True)
        },
    }
    text = f"steps of {abs(step):.3g} degrees {direction}"
    stated = session.info.direction
    if stated is not None and stated != direction:
        sentence = (
            f"{session.info_path}: states that the table turns {stated}, but by its markers it turns {direction}; "
            "correct direction."
        )
        return Finding("turn", "red", sentence, values)
    still = [
        f"{names[i]} to {names[i + 1]}" for i in np.flatnonzero(np.abs(markers.steps_deg) < STOOD_STILL * abs(step))
    ]
    faults = []
    if still:
        faults.append(f"the table did not turn from {names_in_short(still, 3)}")
    if gaps[gap] > LARGE_GAP * abs(step) + 2.0:
        faults.append(f"no frame shows {gaps[gap]:.0f} degrees of the turn, from {ordered[gap]:.0f} degrees on")
    if faults:
        return Finding("turn", "amber", f"Turn: {text}, but {' and '.join(faults)}.", values)
    return Finding("turn", "green", f"Turn: {text}, a whole turn.", values)


def _expected(session: Session, markers: Markers) -> Finding:
    noise = reflectance_noise(session)
    spectra = (
        f"one value of a pixel's reflectance has a noise of at most {max(noise, LEAST_NOISE):.2g}, measured between "
        "two frames"
    )
    if markers.dictionary is None:
        poses = "without markers the accuracy of poses is not known in advance"
    elif np.median([len(seen) for seen in markers.detections]) == 0 or markers.side_px < EXPECTED[-1][0]:
        poses = "markers of less than 8 px give no usable poses"
    else:
        _, rotation_deg, position_mm = next(row for row in EXPECTED if markers.side_px >= row[0])
        poses = (
            f"simulated sessions with such markers have poses within {rotation_deg:g} degrees and {position_mm:g} mm "
            "(docs/validation/poses.md)"
        )
    return Finding(
        "expected-accuracy", "green", f"Expected accuracy: {poses}; {spectra}.", {"reflectance_noise": noise}
    )


def turn_and_rotation_deg(
    detections: Sequence[Detections], shape: tuple[int, ...]
) -> tuple[Float[np.ndarray, "frames"], int | None]:
    """The table's angle in each frame, and how the images are rotated from upright.

    Args:
        detections: markers of each frame.
        shape: lines and samples of the images.

    Returns:
        Degrees relative to the first frame that has an angle, counter-clockwise seen from above, nan where markers do
        not link a frame to most others; and the rotation, counter-clockwise: 0, 90, 180 or 270 degrees, None where
        the markers do not determine it.
    """
    seen = [(frame, *marker) for frame, found in enumerate(detections) for marker in sorted(found.items())]
    unknown = np.full(len(detections), np.nan)
    if not seen:
        return unknown, None
    frame, marker, corners = (np.array(column) for column in zip(*seen, strict=True))
    linked, _, _ = usable(MarkerObservations(frame, marker, corners, np.zeros((len(frame), 8, 8))))
    if len(np.unique(linked.frame)) < FEWEST_FRAMES:
        return unknown, None
    lines, samples = shape
    try:
        turntable = initialise(linked, (samples / 2, lines / 2), samples, side_m=1.0)
    except InputError:
        return unknown, None
    angles_deg = turntable.over_session(turntable.relative_angles_deg(), len(detections))
    if np.nanmax(angles_deg) - np.nanmin(angles_deg) < LEAST_TURN_DEG:
        return unknown, None
    right, down, forward = turntable.camera_rotation[:, 2]
    roll_deg = np.rad2deg(np.arctan2(-down, right)) - 90.0
    nearest = 90 * round(roll_deg / 90.0)
    looks_down = LOOKS_DOWN_DEG[0] < np.rad2deg(np.arcsin(np.clip(-forward, -1.0, 1.0))) < LOOKS_DOWN_DEG[1]
    is_clear = looks_down and abs(roll_deg - nearest) <= LARGEST_ROLL_DEG
    return angles_deg, nearest % 360 if is_clear else None
