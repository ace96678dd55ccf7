"""A reconstruction against a reference: read, bring into one frame, measure the distances both ways."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.closest_points import robust_radius
from hsi_sc_nerf.evaluation.registration import (
    Registration,
    align_by_features,
    refine,
)
from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.evaluation.surface_files import read_surface
from hsi_sc_nerf.evaluation.threshold_curves import (
    Shape,
    ThresholdCurves,
    best_threshold_m,
    threshold_curves,
)
from hsi_sc_nerf.geometry.similarity import Similarity

Alignment = Literal["features", "icp", "none"]
DistanceKind = Literal["surface", "points"]
Track = Callable[[Sequence[Any], str], Iterable[Any]]

METRES = {"m": 1.0, "mm": 0.001}
THRESHOLDS = 201
FEWEST_POINTS = 100
LARGEST_RATIO = 10.0
"""Of two sizes, beyond which the units are wrong rather than the reconstruction."""


@dataclass(frozen=True)
class CompareConfig:
    """How a cloud is compared with a reference."""

    align: Alignment | None = None
    """How the cloud is brought into the reference's frame: features finds the way from any attitude and then refines
    it by ICP, icp only refines (the two must lie almost right already), none leaves the cloud where it is. Without
    this option: none for a simulated session, whose truth is in the cloud's own frame, and features for a file."""
    with_scale: bool = False
    """Let the alignment change the cloud's size, too, for a reference (or a cloud) that is not to scale."""
    accept_symmetric: bool = False
    """With features: go on where the shape is (nearly) symmetric and fits equally well in several attitudes, and take
    one of them. Scores hold for each of them, but a place on the cloud need not be that place on the object."""
    reference_unit: Literal["m", "mm"] = "m"
    """Unit of length of the reference file."""
    distances: DistanceKind = "surface"
    """To what distances are measured where a mesh is given: surface is the nearest place on its triangles, points the
    nearest of the points sampled on it (the paper's formulas). For a cloud they always are to its nearest point."""
    threshold_m: float = paper.F_SCORE_THRESHOLD_M
    """Distance within which a point counts as right, in metres; 0.002 is the paper's."""
    largest_threshold_m: float = 5 * paper.F_SCORE_THRESHOLD_M
    """Where the curves end, in metres."""
    points: int = 100_000
    """How many points are sampled on a mesh, evenly over its area."""
    whole_reference: bool = False
    """With a simulated session: count also those parts of the true surface that no view sees, such as the base."""
    seed: int = 0
    """Of everything random: the same seed gives the same figures."""


@dataclass(frozen=True)
class Comparison:
    """What was measured; all in the reference's frame, in metres."""

    config: CompareConfig
    alignment: Alignment
    registration: Registration | None
    cloud: Shape
    """Aligned."""
    reference: Shape
    to_reference_m: Float[np.ndarray, "n"]
    """Distance of each of the cloud's points to the reference."""
    to_cloud_m: Float[np.ndarray, "m"]
    """Distance of each of the reference's points to the cloud."""
    seen_share: float | None
    """Share of the reference's surface that some view sees and that recall counts; None if nothing was left out."""

    @cached_property
    def curves(self) -> ThresholdCurves:
        """From 0 to the largest threshold."""
        thresholds_m = np.linspace(0.0, self.config.largest_threshold_m, THRESHOLDS)
        return threshold_curves(self.to_reference_m, self.to_cloud_m, thresholds_m)

    @cached_property
    def best_threshold_m(self) -> float:
        """The knee of the F-score's curve."""
        return best_threshold_m(self.curves)


def plainly(items: Sequence[Any], _doing: str) -> Iterable[Any]:
    """The `Track` that shows nothing."""
    return items


def compare(
    cloud_path: Path, reference_path: Path, config: CompareConfig | None = None, track: Track = plainly
) -> Comparison:
    """Compare a cloud or mesh with a reference: a mesh, a cloud, or the true mesh of a simulated session.

    Recall counts the parts of a simulated object's surface that some view sees (unless ``whole_reference``);
    precision is measured against all of it.

    Args:
        cloud_path: PLY cloud, or PLY, OBJ or STL mesh, in metres.
        reference_path: Likewise, in ``reference_unit``; or the folder of a simulated session.
        config: Settings.
        track: Wraps what takes long, with what is being done, for a progress bar.

    Raises:
        InputError: a file or a setting cannot be used, the sizes do not fit together, or the shape is symmetric, so
            that features do not say how it lies.
    """
    config = config or CompareConfig()
    is_session = Path(reference_path).is_dir()
    alignment: Alignment = config.align or ("none" if is_session else "features")
    _check(config, alignment)
    reference, seen = (
        _true_surface(Path(reference_path), config, track)
        if is_session
        else (_shape(Path(reference_path), config, METRES[config.reference_unit]), None)
    )
    cloud = _shape(Path(cloud_path), config, 1.0)
    _check_sizes(cloud_path, cloud, reference_path, reference, alignment, config)
    registration = _registered(cloud_path, cloud, reference_path, reference, alignment, config, track)
    if registration is not None:
        cloud = _moved(cloud, registration.transform)
    seen_points_m = reference.points_m if seen is None else reference.points_m[seen]
    counted = Shape(seen_points_m, reference.vertices_m, reference.triangles)
    # Distances to points are to all of the reference's points, seen or not, as they are to all of its surface.
    forth, back = (
        _measured(shape, config.distances).distances_m(points)
        for shape, points in ((reference, cloud.points_m), (cloud, seen_points_m))
    )
    return Comparison(
        config=config,
        alignment=alignment,
        registration=registration,
        cloud=cloud,
        reference=counted,
        to_reference_m=forth,
        to_cloud_m=back,
        seen_share=None if seen is None else float(seen.mean()),
    )


def _check(config: CompareConfig, alignment: Alignment) -> None:
    for option, value in {
        "--threshold-m": config.threshold_m,
        "--largest-threshold-m": config.largest_threshold_m,
    }.items():
        if not value > 0:
            raise InputError(f"{option} is {value}; it must be more than 0.")
    if config.points < FEWEST_POINTS:
        raise InputError(f"--points is {config.points}; {FEWEST_POINTS} are needed at least.")
    if config.with_scale and alignment == "none":
        raise InputError(
            "--with-scale changes the cloud's size while it is aligned, but --align is none (as for a simulated "
            "session where it is not given); choose one, such as --align icp."
        )


def _shape(path: Path, config: CompareConfig, unit_m: float) -> Shape:
    vertices, triangles = read_surface(path)
    vertices = vertices * unit_m
    if not len(triangles):
        return Shape(vertices)
    try:
        return Shape(sample_surface(vertices, triangles, config.points, config.seed), vertices, triangles)
    except ValueError as error:
        raise InputError(f"{path}: its triangles have no area; export the mesh again.") from error


def _true_surface(
    session_dir: Path, config: CompareConfig, track: Track
) -> tuple[Shape, Bool[np.ndarray, "n"] | None]:
    """The true mesh of a simulated session, and which of its points some view sees; None if all are to count."""
    from hsi_sc_nerf.simulate.scores.visible_surface import seen_points
    from hsi_sc_nerf.simulate.truth import load_truth

    if config.reference_unit != "m":
        raise InputError(f"{session_dir}: a simulated session's truth is in metres; leave out --reference-unit.")
    truth = load_truth(session_dir)
    shape = _shape(truth.mesh_path, config, 1.0)
    if config.whole_reference:
        return shape, None
    assert shape.vertices_m is not None
    assert shape.triangles is not None
    seen = seen_points(
        truth,
        shape.points_m,
        shape.vertices_m,
        shape.triangles,
        lambda captures: track(captures, "What the views see"),
    )
    if not seen.any():
        raise InputError(f"{session_dir}: no view shows the object; simulate the session again.")
    return shape, seen


def _check_sizes(
    cloud_path: Path,
    cloud: Shape,
    reference_path: Path,
    reference: Shape,
    alignment: Alignment,
    config: CompareConfig,
) -> None:
    for path, shape in ((cloud_path, cloud), (reference_path, reference)):
        if alignment != "none" and (len(shape.points_m) < FEWEST_POINTS or robust_radius(shape.points_m) == 0):
            raise InputError(
                f"{path}: has {len(shape.points_m)} points, too few to align by; take a denser one or --align none."
            )
    ratio = robust_radius(reference.points_m) / max(robust_radius(cloud.points_m), 1e-12)
    # What is scaled by features may be of any size.
    if not (config.with_scale and alignment == "features") and not 1 / LARGEST_RATIO < ratio < LARGEST_RATIO:
        larger, smaller, times = (
            (reference_path, cloud_path, ratio) if ratio > 1.0 else (cloud_path, reference_path, 1.0 / ratio)
        )
        raise InputError(
            f"{larger}: is {times:.3g} times as large as {smaller}; the cloud has to be in metres, the reference in "
            f"{config.reference_unit} (--reference-unit), or align with a scale (--align features --with-scale)."
        )


def _registered(
    cloud_path: Path,
    cloud: Shape,
    reference_path: Path,
    reference: Shape,
    alignment: Alignment,
    config: CompareConfig,
    track: Track,
) -> Registration | None:
    if alignment == "none":
        return None
    if alignment == "icp":
        return refine(cloud.points_m, reference.points_m, with_scale=config.with_scale, seed=config.seed)
    found = align_by_features(
        cloud.points_m,
        reference.points_m,
        config.with_scale,
        config.seed,
        lambda starts: track(starts, "Trying other attitudes"),
    )
    if found.rival is not None and not config.accept_symmetric:
        raise InputError(
            f"{cloud_path}: features do not say how it lies in {reference_path}, because turned by "
            f"{found.rival.turn_deg:.0f} degrees it fits as well (RMS {1000 * found.rival.rms_m:.2f} mm against "
            f"{1000 * found.rival.taken_rms_m:.2f} mm); bring the two together by hand and use --align icp, or take "
            "either attitude with --accept-symmetric."
        )
    return found


def _moved(shape: Shape, transform: Similarity) -> Shape:
    vertices = None if shape.vertices_m is None else transform(shape.vertices_m)
    return Shape(transform(shape.points_m), vertices, shape.triangles)


def _measured(shape: Shape, kind: DistanceKind) -> Shape:
    return shape if kind == "surface" else Shape(shape.points_m)
