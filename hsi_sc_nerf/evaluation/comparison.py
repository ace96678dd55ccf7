"""A reconstruction against a reference: brought into one frame, with the distances measured both ways."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.registration import Registration, align_by_features, refine, robust_radius
from hsi_sc_nerf.evaluation.spatial import Surface, ThresholdCurves, sample_surface, threshold_curves
from hsi_sc_nerf.geometry.camera import Similarity
from hsi_sc_nerf.geometry.ply_file import is_metric, ply_triangles, read_ply
from hsi_sc_nerf.settings_file import between, check_options

Alignment = Literal["features", "icp", "none"]
Track = Callable[[Sequence[Any], str], Iterable[Any]]
"""Wraps what takes long, with a description of it, to show a progress bar."""

FORMATS = (".ply", ".obj", ".stl")
METRES = {"m": 1.0, "mm": 0.001}
THRESHOLDS, LARGEST_THRESHOLD_M = 201, 5 * paper.F_SCORE_THRESHOLD_M
"""Number of thresholds of the curves, and the largest."""
FEWEST_POINTS = 100
LARGEST_RATIO = 10.0
"""If one of the two is larger than this times the other, their units differ."""


@dataclass(frozen=True)
class CompareConfig:
    """How a cloud is compared with a reference."""

    align: Alignment | None = None
    """How the cloud is brought into the reference's frame: "features" aligns any attitude and refines it by ICP,
    "icp" only refines (the two must already lie almost right), "none" leaves the cloud where it is. Default: "none"
    for a simulated session, whose true surface is in the cloud's frame, and "features" for a file."""
    with_scale: bool = False
    """Let the alignment also change the cloud's size, for a reference (or a cloud) that is not to scale."""
    accept_symmetric: bool = False
    """With features: if the shape is (nearly) symmetric and fits equally well in several attitudes, take one of them.
    The scores hold for each, but a point on the cloud need not be that point on the object."""
    reference_unit: Literal["m", "mm"] = "m"
    """Unit of length of the reference file."""
    threshold_m: float = between(1e-9, 10.0, default=paper.F_SCORE_THRESHOLD_M)
    """Distance within which a point is correct, in metres; 0.002 is the paper's."""
    points: int = between(FEWEST_POINTS, math.inf, default=100_000)
    """Number of points sampled on a mesh, evenly over its area."""
    whole_reference: bool = False
    """With a simulated session: recall also counts the parts of the true surface that no view sees, such as the
    base."""


@dataclass(frozen=True)
class Reference:
    """What a cloud is compared with.

    Attributes:
        name: for messages.
        surface: metres.
        seen: which of the surface's points recall counts; None for all.
        align: how a cloud is aligned with it where the settings do not say.
        metric: whether its lengths are metres; else nothing gave its scale.
    """

    name: str
    surface: Surface
    seen: Bool[np.ndarray, "n"] | None = None
    align: Alignment = "features"
    metric: bool = True


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison, in metres and in the reference's frame."""

    config: CompareConfig
    alignment: Alignment
    registration: Registration | None
    cloud: Surface
    """Aligned."""
    reference: Surface
    to_reference_m: Float[np.ndarray, "n"]
    """Distance of each of the cloud's points to the reference."""
    to_cloud_m: Float[np.ndarray, "m"]
    """Distance of each of the reference's points to the cloud."""
    seen_fraction: float | None
    """Fraction of the reference's surface that some view sees and that recall counts; None if recall counts all."""

    @cached_property
    def curves(self) -> ThresholdCurves:
        """From 0 to the largest threshold."""
        thresholds_m = np.linspace(0.0, LARGEST_THRESHOLD_M, THRESHOLDS)
        return threshold_curves(self.to_reference_m, self.to_cloud_m, thresholds_m)


def without_progress(items: Sequence[Any], _description: str) -> Iterable[Any]:
    """The `Track` that shows nothing."""
    return items


def compare(
    cloud_path: Path, reference: Reference, config: CompareConfig | None = None, track: Track = without_progress
) -> Comparison:
    """Compare a cloud or mesh with a reference.

    Precision is measured against the whole reference; recall counts the points that ``reference.seen`` names.

    Args:
        cloud_path: PLY cloud, or PLY, OBJ or STL mesh, in metres.
        reference: `read_reference` of a file, or `hsi_sc_nerf.simulate.scores.true_reference` of a
            simulated session.

    Raises:
        InputError: a file or a setting cannot be used, the sizes do not fit together, one of the two has no scale, or
            the shape is symmetric, so that features do not determine its attitude.

    Example:
        >>> found = compare(Path("point_cloud.ply"), read_reference(Path("scan.stl"), CompareConfig()))
        >>> score_at(found.to_reference_m, found.to_cloud_m, threshold_m=0.002).f_score
        96.2
    """
    config = config or CompareConfig()
    alignment = config.align or reference.align
    check_options(config)
    if config.with_scale and alignment == "none":
        raise InputError(
            "--with-scale changes the cloud's size while it is aligned, but --align is none (as for a simulated "
            "session where it is not given); choose one, such as --align icp."
        )
    cloud = surface_of(Path(cloud_path), config)
    if not config.with_scale and _states_metres(Path(cloud_path)) != reference.metric:
        raise InputError(
            f"{cloud_path if reference.metric else reference.name}: nothing gave its scale, so that its lengths are "
            "no metres; let the alignment change the size (--align features --with-scale)."
        )
    _check_sizes(str(cloud_path), cloud, reference, alignment, config)
    registration = _register(str(cloud_path), cloud, reference, alignment, config, track)
    if registration is not None:
        vertices = None if cloud.vertices_m is None else registration.transform(cloud.vertices_m)
        cloud = Surface(registration.transform(cloud.points_m), vertices, cloud.triangles)
    surface, seen = reference.surface, reference.seen
    counted = surface if seen is None else Surface(surface.points_m[seen], surface.vertices_m, surface.triangles)
    return Comparison(
        config=config,
        alignment=alignment,
        registration=registration,
        cloud=cloud,
        reference=counted,
        to_reference_m=surface.distances_m(cloud.points_m),
        to_cloud_m=cloud.distances_m(counted.points_m),
        seen_fraction=None if seen is None else float(seen.mean()),
    )


def read_reference(path: Path, config: CompareConfig) -> Reference:
    """A cloud or mesh in ``config.reference_unit`` as the reference of a comparison.

    Raises:
        InputError: the file cannot be used.

    Example:
        >>> len(read_reference(Path("point_cloud.ply"), CompareConfig()).surface.points_m)
        30
    """
    surface = surface_of(path, config, METRES[config.reference_unit])
    return Reference(str(path), surface, metric=_states_metres(path))


def _states_metres(path: Path) -> bool:
    return path.suffix.lower() != ".ply" or is_metric(read_ply(path))


def surface_of(path: Path, config: CompareConfig, unit_m: float = 1.0) -> Surface:
    """The points of a cloud, or a mesh with ``config.points`` points on it, in metres.

    Raises:
        InputError: the file cannot be used.
    """
    vertices, triangles = read_surface(path)
    vertices = vertices * unit_m
    if not len(triangles):
        return Surface(vertices)
    try:
        return Surface(sample_surface(vertices, triangles, config.points), vertices, triangles)
    except ValueError as error:
        raise InputError(f"{path}: its triangles have no area; export the mesh again.") from error


def read_surface(path: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]:
    """Vertices, in the file's unit, and triangles (none for a point cloud). Polygons are triangulated as fans.

    Raises:
        InputError: the file is missing, has another format, cannot be read, or has no points or points that are not
            finite.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give a point cloud (PLY) or a mesh (PLY, OBJ, STL).")
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: cannot be compared; give a point cloud (PLY) or a mesh {FORMATS}.")
    try:
        if path.suffix.lower() == ".ply":
            content = read_ply(path)  # mapped: only three of a spectral cloud's hundreds of columns are read
            vertices = np.stack([np.asarray(content["vertex"][axis], float) for axis in "xyz"], axis=-1)
            triangles = ply_triangles(content)
        else:
            import trimesh

            mesh = trimesh.load_mesh(path, process=False)
            vertices, triangles = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    except InputError:
        raise
    except Exception as error:  # trimesh's readers raise errors of many types
        raise InputError(f"{path}: cannot be read ({error!r}); export it again.") from error
    if not len(vertices):
        raise InputError(f"{path}: holds no surface and no points; export it again, clouds as PLY.")
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise InputError(f"{path}: its triangles refer to vertices that do not exist; export it again.")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: some points have coordinates that are not finite; remove them or export it again.")
    return vertices, triangles


def _check_sizes(
    cloud_name: str, cloud: Surface, reference: Reference, alignment: Alignment, config: CompareConfig
) -> None:
    for name, surface in ((cloud_name, cloud), (reference.name, reference.surface)):
        if alignment != "none" and (len(surface.points_m) < FEWEST_POINTS or robust_radius(surface.points_m) == 0):
            raise InputError(
                f"{name}: has {len(surface.points_m)} points, too few to align by; take a denser one or --align none."
            )
    ratio = robust_radius(reference.surface.points_m) / max(robust_radius(cloud.points_m), 1e-12)
    # An alignment by features with a scale takes any size.
    if not (config.with_scale and alignment == "features") and not 1 / LARGEST_RATIO < ratio < LARGEST_RATIO:
        larger, smaller = (reference.name, cloud_name) if ratio > 1.0 else (cloud_name, reference.name)
        times = max(ratio, 1.0 / max(ratio, 1e-12))
        raise InputError(
            f"{larger}: is {times:.3g} times as large as {smaller}; the cloud has to be in metres, the reference in "
            f"{config.reference_unit} (--reference-unit), or align with a scale (--align features --with-scale)."
        )


def _register(
    cloud_name: str,
    cloud: Surface,
    reference: Reference,
    alignment: Alignment,
    config: CompareConfig,
    track: Track,
) -> Registration | None:
    if alignment == "none":
        return None
    # Near the origin, because rounding spoils Open3D's normals and equations kilometres away, as on a survey's grid.
    there = Similarity(translation=-np.median(reference.surface.points_m, axis=0))
    here = there if alignment == "icp" else Similarity(translation=-np.median(cloud.points_m, axis=0))
    clouds = here(cloud.points_m), there(reference.surface.points_m)
    if alignment == "icp":
        found = refine(*clouds, with_scale=config.with_scale)
    else:
        found = align_by_features(*clouds, config.with_scale, lambda starts: track(starts, "Trying other attitudes"))
    if found.rival is not None and not config.accept_symmetric:
        raise InputError(
            f"{cloud_name}: features do not determine its attitude in {reference.name}, because turned by "
            f"{found.rival.turn_deg:.0f} degrees it fits as well (RMS {1000 * found.rival.rms_m:.2f} mm against "
            f"{1000 * found.rival.taken_rms_m:.2f} mm); bring the two together by hand and use --align icp, or take "
            "either attitude with --accept-symmetric."
        )
    return replace(found, transform=there.inverse().after(found.transform).after(here))
