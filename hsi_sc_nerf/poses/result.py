"""The result of every pose method: markers, features, known angles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics

_STEPS_SHORT_OF_A_TURN = 1.5
"""A session is a full turn if no more than this many of its steps are missing from 360 degrees."""


@dataclass(frozen=True)
class RejectedMarker:
    """A marker that was seen in a frame (its index) and is not used there."""

    frame: int
    marker: int
    error_px: float | None
    """None where it could not be measured."""
    why: str


LARGEST_PLAQUE = 0.025
"""Markers' plaques stand off the container's wall: the container is found wider by up to this fraction."""
ScaleSource: TypeAlias = Literal["markers", "container", "outline", "distance"]


@dataclass(frozen=True)
class Scale:
    """What gives the scale, and how well it is known. Fractions are of a length on the turntable."""

    source: ScaleSource
    """The markers' side, the container that carries markers, its outline, or the given distance of the camera."""
    marker_side_m: float | None
    """Side of a marker's black square, given or measured; None without markers."""
    uncertainty: float
    """Standard deviation of the scale, as a fraction: by the fit of the corners, by the markers' own spread, and by
    ``LARGEST_PLAQUE`` where markers on the container give the scale."""
    marker_sides: dict[int, float]
    """Each marker's apparent side over the mean of all."""
    marker_side_sigmas: dict[int, float]
    """Standard deviations of these."""
    container_diameter_m: float | None
    """Diameter of the container as given."""
    measured_container_diameter_m: float | None
    """Diameter of the circle that the upright markers' planes touch; None where there are none.

    A plaque stands off the wall and makes it wider than the container by twice that.
    """

    @property
    def disagreement_percent(self) -> float | None:
        """Percentage by which the container is wider by the markers than as given; None where one is not known."""
        if self.container_diameter_m is None or self.measured_container_diameter_m is None:
            return None
        return 100.0 * (self.measured_container_diameter_m / self.container_diameter_m - 1.0)


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations by the covariance of the adjustment; the length that gives the scale is taken for exact.

    ``process`` checks the worst frame, and the largest of many errors exceeds the standard deviation of each.
    """

    focal: float
    """Standard deviation of the focal length, as a fraction of it."""
    distance: float
    """Standard deviation of the camera's distance from the axis, as a fraction of it."""
    size: float
    """Standard deviation of lengths on the turntable, as a fraction."""
    angle_deg: Float[np.ndarray, "n"]
    """Standard deviation of each frame's angle relative to the mean of all; nan where a frame is not used."""
    rotation_deg: float
    """Root mean square of the largest rotation error of all frames, object frame."""
    position_m: float
    """Root mean square of the largest position error of the camera in all frames, object frame."""


@dataclass(frozen=True)
class TurntablePoses:
    """Poses of all frames in the object frame (docs/concepts/frames.md), and the evidence for them.

    Rows of frames that are not ``used`` are nan: a frame that cannot be posed is left out, never guessed.
    ``dropped`` says why, by the frame's name. Angles are degrees, counter-clockwise seen from above, relative to the
    first used frame and unwrapped over the session. Where the table wobbles (``model`` is "free poses") they are
    turns about the mean axis, and the poses of two frames differ by more than a turn about z.
    """

    names: tuple[str, ...]
    intrinsics: PinholeIntrinsics
    distortion: tuple[float, float, float, float]
    """OpenCV's k1, k2, p1, p2; k1 and k2 are exactly 0 unless the images show a distortion."""
    camera_to_world: Float[np.ndarray, "n 4 4"]
    angles_deg: Float[np.ndarray, "n"]
    reprojection_error_px: Float[np.ndarray, "n"]
    used: Bool[np.ndarray, "n"]
    overall_error_px: float
    markers_per_frame: tuple[int, ...]
    marker_corners_m: dict[int, Float[np.ndarray, "4 3"]] = field(default_factory=dict)
    dropped: dict[str, str] = field(default_factory=dict)
    dictionary: str | None = None
    """OpenCV's name; None where the poses rest on no markers."""
    blur_px: float = 0.0
    disc_markers: tuple[int, ...] = ()
    disc_by_container: bool = False
    """Whether the foot of the container's outline, or an earlier dataset, gives the height of the disc."""
    disc_tilt_deg: float | None = None
    loop_closure_deg: float | None = None
    findings: tuple[Finding, ...] = ()
    """What the method found beside the poses."""
    method: Literal["markers", "colmap", "angles"] = "markers"
    """How the poses were found."""
    chosen: str = ""
    """Which method was used, and why the others were not."""
    metric: bool = True
    """Whether lengths are metres; otherwise they are in units of the camera's distance from the axis."""
    model: Literal["turntable", "free poses"] = "turntable"
    """One axis and one angle a frame; or, for a table that wobbles, small motions of each frame beside its angle."""
    wobble_deg: float | None = None
    """Root mean square of the table's tilts off its mean axis, where the poses are free."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """Evidence for lens_distortion and for wobble, where the method tests for them: -log10 of the p-value."""
    outliers: tuple[RejectedMarker, ...] = ()
    camera_given: bool = False
    """Whether the camera of an earlier session helped."""
    scale: Scale | None = None
    """Where the size comes from; None where it is not known."""
    uncertainty: Uncertainty | None = None

    @property
    def on_disc(self) -> bool:
        """Whether the origin is on the disc; else its height is not known."""
        return bool(self.disc_markers) or self.disc_by_container


def is_full_turn(angles_deg: np.ndarray) -> bool:
    """Whether unwrapped angles go round once, with the last frame a neighbour of the first."""
    widest_step = np.abs(np.diff(angles_deg)).max()
    return bool(abs(angles_deg[-1] - angles_deg[0]) >= 360.0 - _STEPS_SHORT_OF_A_TURN * widest_step)
