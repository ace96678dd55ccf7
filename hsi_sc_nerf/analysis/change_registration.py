"""How an object was set down again: turn, tip, place and growth between two clouds, by shape and spectra together.

Colours and shape in one least-squares problem, as Park et al. 2017 ("Colored Point Cloud Registration Revisited"),
with a scale, Tukey's loss, and many starts about the turntable's axis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.analysis.change_features import SurfaceSample, surface_gradients
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.registration import robust_radius
from hsi_sc_nerf.geometry.camera import Similarity, rotation_about_z
from hsi_sc_nerf.robust_scatter import TUKEY, robust_std, tukey_weights

SCALE_RANGE = (0.8, 1.25)
"""Growth beyond this is another object, or other units."""
TURN_STEP_DEG = 10.0
"""Between starts; at the equator of a fruit it is about one coarse spacing."""
ANOTHER_ATTITUDE_DEG = 10.0
AMBIGUOUS_P = 0.01
"""An attitude is ruled out if it would fit this well by chance with at most this probability."""
BLOCK = 0.8
"""Side, in radii of the object, of blocks whose errors are taken for independent; within one they may be the same."""
LEAST_OVERLAP = 0.5
FINE_ATTITUDES = 4
"""The best of the coarse ones, which are fitted again to the fine sample."""
COARSE_ROUNDS, FINE_ROUNDS = 25, 30
CONVERGED = 1e-5
_OFF_EDGE = 1.5
"""Pairs further apart along the surface than this, in spacings, lie beyond the reference's edge."""
_PARAMETERS = 7
_LEAST_SCATTER = 1e-9


@dataclass(frozen=True)
class Attitude:
    """The similarity that brings a cloud onto the reference, and how sure it is.

    Attributes:
        transform: into the reference's frame; its scale is below 1 where the object grew.
        turn_deg: turn about z from the reference to the cloud, in (-180, 180].
        turn_sd_deg: its standard deviation.
        tip_deg: angle between the two upright axes.
        growth: size of the cloud's object relative to the reference's.
        growth_sd: its standard deviation.
        residual_m: robust standard deviation of the distance between the two surfaces.
        overlap: fraction of the cloud with a counterpart on the reference.
        rival_turn_deg: angle to the best other attitude, NaN if all starts led to one.
        rival_p: probability that the other attitude fits so much worse by chance.
    """

    transform: Similarity
    turn_deg: float
    turn_sd_deg: float
    tip_deg: float
    growth: float
    growth_sd: float
    residual_m: float
    overlap: float
    rival_turn_deg: float
    rival_p: float


def find_attitude(
    moving: Sequence[SurfaceSample],
    reference: Sequence[SurfaceSample],
    track: Callable[[list[Similarity]], Iterable[Similarity]] = iter,
) -> Attitude:
    """How the object of one cloud must be moved to lie on that of another.

    From turns all around the axis, Gauss-Newton steps minimise the distances to tangent planes and the differences of
    spectral features, each in units of its robust standard deviation, with Tukey's loss: what was lost, such as a
    stem, does not count. Errors of points nearby are alike, so standard deviations are those of a sandwich estimate
    over blocks (Liang and Zeger 1986). Two attitudes are compared by a paired t-test of their losses over the blocks.

    Args:
        moving: coarse and fine sample of the cloud, `hsi_sc_nerf.analysis.change_features.surface_samples`.
        reference: the same of the reference.
        track: wraps the starts, for a progress bar.

    Raises:
        InputError: the objects do not fit, differ too much in size, or fit in two attitudes equally well.
    """
    (coarse, fine), (thinned, target) = moving, (_FixedSample(one) for one in reference)
    found = [_fitted(coarse, thinned, start, COARSE_ROUNDS) for start in track(_starts(coarse, thinned.sample))]
    scales = _scales(coarse, thinned, min(found, key=lambda one: _loss(coarse, thinned, one, None).mean()))
    found.sort(key=lambda one: _loss(coarse, thinned, one, scales).mean())
    ranked = [_fitted(fine, target, one, FINE_ROUNDS) for one in _distinct(found)[:FINE_ATTITUDES]]
    scales = _scales(fine, target, ranked[0])
    ranked.sort(key=lambda one: _loss(fine, target, one, scales).mean())
    best = _attitude(fine, target, _distinct(ranked))
    if best.overlap < LEAST_OVERLAP:
        raise InputError(
            f"only {best.overlap:.0%} of the second surface fits the first; give clouds of one object, in metres."
        )
    if not SCALE_RANGE[0] < best.growth < SCALE_RANGE[1]:
        raise InputError(
            f"the second object fits the first only {best.growth:.2f} times as large (allowed are "
            f"{SCALE_RANGE[0]} to {SCALE_RANGE[1]}); give clouds of one object, in metres."
        )
    # Written so that NaN, of one attitude only, passes.
    if best.rival_p > AMBIGUOUS_P:
        raise InputError(
            f"two attitudes {best.rival_turn_deg:.0f} degrees apart fit equally well (the worse one would do so by "
            f"chance with p = {best.rival_p:.2g}, and p below {AMBIGUOUS_P:g} would tell them apart); mark the "
            "object with a spot before the first day."
        )
    return best


class _FixedSample:
    """The reference's sample with its search tree and the gradients of its features along the surface."""

    def __init__(self, sample: SurfaceSample) -> None:
        self.sample, self.tree = sample, cKDTree(sample.points)
        self.spacing_m = float(np.median(self.tree.query(sample.points, k=2)[0][:, 1]))
        self.gradients = surface_gradients(sample.points, sample.features)

    def residuals(
        self, points: Float[np.ndarray, "n 3"], features: Float[np.ndarray, "n f"]
    ) -> tuple[Float[np.ndarray, "n 1+f"], Float[np.ndarray, "n 1+f 3"], Bool[np.ndarray, "n"]]:
        """Distance off the tangent plane and differences of features, their gradients, and which points have one."""
        _, at = self.tree.query(points)
        offset, normals = points - self.sample.points[at], self.sample.normals[at]
        off = np.einsum("ij,ij->i", offset, normals)
        paired = np.linalg.norm(offset - off[:, None] * normals, axis=1) < _OFF_EDGE * self.spacing_m
        gradients = np.concatenate([normals[:, None], self.gradients[at]], axis=1)
        values = np.concatenate([np.zeros((len(at), 1)), self.sample.features[at] - features], axis=1)
        return values + np.einsum("nfj,nj->nf", gradients, offset), gradients, paired


def _starts(moving: SurfaceSample, reference: SurfaceSample) -> list[Similarity]:
    centres = [np.median(one.points, axis=0) for one in (moving, reference)]
    scale = robust_radius(reference.points) / robust_radius(moving.points)
    turns = (rotation_about_z(turn)[:3, :3] for turn in np.arange(0.0, 360.0, TURN_STEP_DEG))
    return [Similarity(scale, turn, centres[1] - scale * turn @ centres[0]) for turn in turns]


def _distinct(ranked: Sequence[Similarity]) -> list[Similarity]:
    """Those that are another attitude than all before them."""
    kept: list[Similarity] = []
    for one in ranked:
        if all(_between_deg(one, other) > ANOTHER_ATTITUDE_DEG for other in kept):
            kept.append(one)
    return kept


def _fitted(moving: SurfaceSample, target: _FixedSample, start: Similarity, rounds: int) -> Similarity:
    transform = start
    for _ in range(rounds):
        matrix, gradients, centre = _system(moving, target, transform)
        step = -np.linalg.solve(matrix, gradients.sum(axis=0))
        turn = Rotation.from_rotvec(step[3:6]).as_matrix()
        scale = float(np.exp(np.clip(step[6], -0.1, 0.1)))
        transform = Similarity(scale, turn, centre + step[:3] - scale * turn @ centre).after(transform)
        if np.abs(step).max() < CONVERGED:
            break
    return transform


def _system(
    moving: SurfaceSample, target: _FixedSample, transform: Similarity
) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, "n 7"], Float[np.ndarray, "3"]]:
    """Normal matrix and each point's gradient of the loss by shift, turn and growth about the centre, and that."""
    points = transform(moving.points)
    centre = points.mean(axis=0)
    residual, gradients, paired = target.residuals(points, moving.features)
    scale = robust_std(residual[paired] if paired.sum() > _PARAMETERS else residual, axis=0, least=_LEAST_SCATTER)
    weight = tukey_weights(residual, scale) * paired[:, None]
    # Off the surface, spectra mean nothing.
    weight[:, 1:] *= weight[:, :1]
    weight /= np.square(scale)
    arm = (points - centre)[:, None, :]
    jacobian = np.concatenate(
        [gradients, np.cross(arm, gradients), (gradients * arm).sum(axis=2, keepdims=True)], axis=2
    )
    matrix = np.einsum("nfi,nf,nfj->ij", jacobian, weight, jacobian)
    # What nothing determines does not move.
    matrix += np.diag(1e-9 * np.diag(matrix) + 1e-30)
    return matrix, np.einsum("nfi,nf->ni", jacobian, weight * residual), centre


def _scales(moving: SurfaceSample, target: _FixedSample, transform: Similarity) -> Float[np.ndarray, "1+f"]:
    residual, _, paired = target.residuals(transform(moving.points), moving.features)
    return robust_std(residual[paired], axis=0, least=_LEAST_SCATTER)


def _loss(
    moving: SurfaceSample, target: _FixedSample, transform: Similarity, scales: Float[np.ndarray, "1+f"] | None
) -> Float[np.ndarray, "n"]:
    """Tukey's loss of each point, 1 for a lost one; without scales, in units of the whole reference's spread."""
    residual, _, paired = target.residuals(transform(moving.points), moving.features)
    if scales is None:
        spread = robust_std(
            target.sample.features - np.median(target.sample.features, axis=0), axis=0, least=_LEAST_SCATTER
        )
        scales = np.array([target.spacing_m, *spread])
    loss = 1.0 - np.clip(1.0 - np.square(residual / (TUKEY * scales)), 0.0, None) ** 3
    return np.where(paired, loss.mean(axis=1), 1.0)


def _attitude(moving: SurfaceSample, target: _FixedSample, ranked: Sequence[Similarity]) -> Attitude:
    best = ranked[0]
    matrix, gradients, _ = _system(moving, target, best)
    block = _blocks(moving.points)
    of_blocks = np.stack([np.bincount(block, column) for column in gradients.T], axis=1)
    inverse = np.linalg.inv(matrix)
    variance = (
        np.diag(inverse @ (of_blocks.T @ of_blocks) @ inverse) * len(of_blocks) / max(len(of_blocks) - _PARAMETERS, 1)
    )
    scales = _scales(moving, target, best)
    _, _, paired = target.residuals(best(moving.points), moving.features)
    rival_turn_deg, rival_p = np.nan, np.nan
    if len(ranked) > 1:
        rival_turn_deg = _between_deg(ranked[1], best)
        more = _loss(moving, target, ranked[1], scales) - _loss(moving, target, best, scales)
        rival_p = float(stats.ttest_1samp(np.bincount(block, more), 0.0, alternative="greater").pvalue)
    back = best.rotation.T
    return Attitude(
        transform=best,
        turn_deg=float(np.rad2deg(np.arctan2(back[1, 0] - back[0, 1], back[0, 0] + back[1, 1]))),
        turn_sd_deg=float(np.rad2deg(np.sqrt(variance[5]))),
        tip_deg=float(np.rad2deg(np.arccos(np.clip(back[2, 2], -1.0, 1.0)))),
        growth=1.0 / best.scale,
        growth_sd=float(np.sqrt(variance[6]) / best.scale),
        residual_m=float(scales[0]),
        overlap=float(np.mean(paired)),
        rival_turn_deg=rival_turn_deg,
        rival_p=rival_p,
    )


def _blocks(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    side_m = BLOCK * robust_radius(points)
    return np.unique(np.floor(points / side_m).astype(int), axis=0, return_inverse=True)[1].ravel()


def _between_deg(one: Similarity, other: Similarity) -> float:
    return one.after(other.inverse()).turn_deg()
