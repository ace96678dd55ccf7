"""Single frames that do not belong to the turntable: the object, the table or the camera was knocked for one capture.

The machine is held, and each frame's markers are asked whether they fit it by a turn alone, or only where the frame
moves freely beside it. Markers that fit neither way are no matter of the frame's motion and have no say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import f as f_distribution

from hsi_sc_nerf.poses.initialise import Observations, Turntable
from hsi_sc_nerf.poses.projection import corner_slopes, project_corners

_FREE = 6
_STEPS = 30
_SMALLEST_GAIN = 1e-6
# A marker has no say if its corners stay this many standard deviations away from the freely moved frame (RMS).
_MISFIT_SIGMAS = 5.0
# One marker that is read wrongly looks like a frame that was knocked; several do not agree by chance.
_FEWEST_MARKERS = 2
_LEAST_SHARE = 0.5


@dataclass(frozen=True)
class FrameMotions:
    """What each of ``frames`` says about a motion of its own."""

    frames: Int[np.ndarray, "f"]
    chance: Float[np.ndarray, "f"]
    """By chance alone the free motion would lower the squares by so much with this probability (F-test)."""
    away_px: Float[np.ndarray, "f"]
    """How far the markers are from the turntable at the frame's best angle, root mean square over the corners."""


def frame_motions(
    machine: Turntable,
    observations: Observations,
    centre_px: tuple[float, float],
    side_m: float,
    weights: Float[np.ndarray, "n 8 8"],
    loss_scale: float,
) -> FrameMotions:
    """Whether each frame fits the machine by its angle, or calls for tilts and shifts of its own.

    Camera, lens and layout stay as they are. Frames of fewer than two markers, or of which fewer than half agree on
    one motion, get a chance of 1: that is for the single markers to tell.

    Args:
        machine: a still turntable; it may lack markers that are observed, whose rows are ignored.
        observations: marker corners.
        centre_px: the principal point.
        side_m: the markers' side.
        weights: an observation's residual is multiplied by this (``adjust.whitening``).
        loss_scale: weighted residuals well above this count by their size, not its square (soft L1).
    """
    known = np.isin(observations.marker, machine.markers) & np.isin(observations.frame, machine.frames)
    seen, weights = observations.select(known), weights[known]
    n = len(machine.frames)
    frames = _Frames(machine, seen, centre_px, side_m, weights, loss_scale)
    everything = np.ones(len(seen), bool)
    level = replace(machine, tilts_rad=np.zeros((n, 2)), shifts_m=np.zeros((n, 3)))
    moved = frames.fitted(level, everything, _FREE)
    sigmas = np.sqrt((frames.residuals(moved) ** 2).mean(axis=-1))
    agrees = sigmas < _MISFIT_SIGMAS * max(1.0, float(np.median(sigmas)))
    turned, moved = frames.fitted(level, agrees, 1), frames.fitted(moved, agrees, _FREE)
    own, table = frames.costs(moved, agrees), frames.costs(turned, agrees)
    markers, all_markers = np.bincount(frames.frame[agrees], minlength=n), np.bincount(frames.frame, minlength=n)
    enough = (markers >= _FEWEST_MARKERS) & (markers >= _LEAST_SHARE * all_markers)
    freedom = int((8 * markers - _FREE)[enough].sum())
    variance = max(1.0, float(own[enough].sum()) / max(freedom, 1))
    ratio = np.maximum(table - own, 0.0) / (_FREE - 1) / variance
    chance = np.where(enough, f_distribution.sf(ratio, _FREE - 1, max(freedom, 1)), 1.0)
    squared = (frames.distances_px(turned) ** 2).sum(-1).mean(-1)
    away = np.sqrt(np.bincount(frames.frame[agrees], squared[agrees], n) / np.maximum(markers, 1))
    return FrameMotions(machine.frames, chance, away)


class _Frames:
    """All frames before the same machine, each with an angle, and perhaps a motion, of its own."""

    def __init__(self, machine, seen, centre_px, side_m, weights, loss_scale):
        self.frame = np.searchsorted(machine.frames, seen.frame)
        self.marker = np.searchsorted(machine.markers, seen.marker)
        self.seen, self.weights, self.loss_scale = seen, weights, loss_scale
        self.centre_px, self.side_m = centre_px, side_m

    def distances_px(self, machine: Turntable) -> Float[np.ndarray, "n 4 2"]:
        projection = project_corners(machine, self.frame, self.marker, self.centre_px, self.side_m)
        return projection.pixels - self.seen.corners_px

    def residuals(self, machine: Turntable) -> Float[np.ndarray, "n 8"]:
        return np.einsum("nij,nj->ni", self.weights, self.distances_px(machine).reshape(-1, 8))

    def costs(self, machine: Turntable, rows: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "f"]:
        """Soft L1 loss of each frame."""
        scaled = self.residuals(machine)[rows] / self.loss_scale
        by_row = 2.0 * self.loss_scale**2 * (np.sqrt(1.0 + scaled**2) - 1.0).sum(axis=-1)
        return np.bincount(self.frame[rows], by_row, len(machine.frames))

    def fitted(self, machine: Turntable, rows: Bool[np.ndarray, "n"], free: int) -> Turntable:
        """The machine with the first ``free`` of each frame's angle, tilts (2) and shifts (3) fitted to its rows.

        Levenberg-Marquardt of all frames side by side, each with its own damping.
        """
        n = len(machine.frames)
        damping, cost = np.full(n, 1e-3), self.costs(machine, rows)
        for _ in range(_STEPS):
            normal, gradient = self._normal_equations(machine, rows, free)
            diagonal = np.maximum(np.einsum("fii->fi", normal), 1e-12)
            damped = normal + (damping[:, None] * diagonal)[..., None] * np.eye(free) + 1e-12 * np.eye(free)
            step = np.zeros((n, _FREE))
            step[:, :free] = -np.linalg.solve(damped, gradient[..., None])[..., 0]
            candidate = _moved(machine, step)
            lower = self.costs(candidate, rows)
            better = lower < cost
            machine = _moved(machine, np.where(better[:, None], step, 0.0))
            gain = np.where(better, cost - lower, 0.0)
            damping = np.where(better, np.maximum(damping / 10.0, 1e-9), np.minimum(damping * 10.0, 1e9))
            settled = np.where(better, gain <= _SMALLEST_GAIN * (1.0 + cost), damping >= 1e6)
            cost = np.where(better, lower, cost)
            if settled.all():
                break
        return machine

    def _normal_equations(self, machine, rows, free):
        projection = project_corners(machine, self.frame, self.marker, self.centre_px, self.side_m)
        slopes = corner_slopes(machine, self.frame, projection, self.centre_px)
        values = self.weights @ np.concatenate([slopes.angle[..., None], slopes.motion], axis=-1)[..., :free]
        values, residual = values[rows], self.residuals(machine)[rows]
        weighted = values / np.sqrt(1.0 + (residual / self.loss_scale) ** 2)[..., None]
        normal = np.zeros((len(machine.frames), free, free))
        gradient = np.zeros((len(machine.frames), free))
        np.add.at(normal, self.frame[rows], np.swapaxes(weighted, 1, 2) @ values)
        np.add.at(gradient, self.frame[rows], np.einsum("nik,ni->nk", weighted, residual))
        return normal, gradient


def _moved(machine, step):
    return replace(
        machine,
        angles_rad=machine.angles_rad + step[:, 0],
        tilts_rad=machine.tilts_rad + step[:, 1:3],
        shifts_m=machine.shifts_m + step[:, 3:],
    )
