"""From a capture session to a packed dataset: calibration, poses, masks, boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Bool, Float
from rich.console import Console

from hsi_sc_nerf import paper
from hsi_sc_nerf.calibration.calibration_checks import check_calibration, check_clipped
from hsi_sc_nerf.calibration.reflectance import PixelCounts
from hsi_sc_nerf.calibration.report import REPORT_NAME, describe_calibration, draw_calibration, write_calibration
from hsi_sc_nerf.calibration.session_calibration import CalibrationConfig, calibrate_session
from hsi_sc_nerf.capture.session import Session, open_session
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import require_writable
from hsi_sc_nerf.inspection.inspect import inspect_session, suggestion
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import (
    PackedDataset,
    PackedFrame,
    is_packed,
    open_packed,
    transforms_path,
    write_transforms,
)
from hsi_sc_nerf.poses.pose_methods import PoseMethod, find_poses
from hsi_sc_nerf.processing.appearance_checks import check_appearance, check_band_order
from hsi_sc_nerf.processing.chamber import background_spectrum
from hsi_sc_nerf.processing.effects import draw_effects, measure_effects, points_of_object, show_effects
from hsi_sc_nerf.processing.frames import BinsOfFrames, pack_frames, session_fingerprint
from hsi_sc_nerf.processing.masks import MaskConfig
from hsi_sc_nerf.processing.painted_masks import note_masks
from hsi_sc_nerf.processing.posed_frames import (
    POSES_NAME,
    PoseFunction,
    container_under,
    known_camera,
    pose_frames,
    posed_frames,
)
from hsi_sc_nerf.processing.session_checks import SessionChecks, require_checks
from hsi_sc_nerf.processing.session_masks import write_masks
from hsi_sc_nerf.processing.visual_hull import assumed_disc, object_box, scene_box, size_in_words
from hsi_sc_nerf.settings_file import between, check_options
from hsi_sc_nerf.spectra import nearest_bands

OBJECT_PIXELS = 2000
"""Pixels of a frame, or a few more, that the object's mean spectrum is taken from."""


@dataclass(frozen=True)
class ProcessConfig:
    """Settings of the processing of raw captures into a packed dataset."""

    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    """White-reference calibration."""
    masks: MaskConfig = field(default_factory=MaskConfig)
    """Foreground masks."""
    pseudo_rgb_nm: tuple[float, float, float] = between(1.0, 1e5, default=paper.PSEUDO_RGB_NM)
    """Wavelengths shown as red, green and blue, nm; the nearest bands are taken."""
    poses: PoseMethod = "auto"
    """How poses are found: from markers that turn with the object; from features of the object (colmap); from the
    angles that session.json gives (angles); or by the first of these that works (auto)."""
    camera: Path | None = None
    """An earlier dataset of the same camera and turntable: with known angles and its camera, poses need neither
    markers nor texture."""
    marker_side_m: float | None = between(1e-4, 0.5, default=None)
    """Side of a marker's black square, metres; session.json's if not given."""
    workers: int = between(1, 1000, default=2)
    """Number of frames that are calibrated at the same time; each needs memory for about two copies of a raw cube."""
    exclude: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Name of a capture to leave out; may be given several times."""
    skip_damaged: bool = False
    """Leave out captures that are empty, short or unlike the others, and name them."""
    accept: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Name of a check whose red finding is accepted; may be given several times."""


def process_session(
    session_dir: Path,
    output_dir: Path,
    config: ProcessConfig | None = None,
    progress: bool = True,
    estimate_poses: PoseFunction = find_poses,
) -> Path:
    """Make a packed dataset (docs/reference/files.md) from a capture session.

    The same session is processed once with the same settings: a second call returns at once, and a run that stopped
    goes on with the frames that are not finished. ``transforms.json`` is written last, so a dataset that has one is
    complete.

    Args:
        output_dir: folder of the dataset; made if it does not exist.
        estimate_poses: called like `find_poses`.

    Returns:
        ``output_dir``.

    Raises:
        InputError: a setting is out of range; the session cannot be used (`open_session`, `calibrate_session`), has
            no marker size, no poses or no object; or the output cannot be written or holds another kind of dataset.

    Example:
        >>> data = process_session(Path("apple_01"), Path("apple_01-data"))
        >>> dataset = open_packed(data)
        >>> dataset.frames[0].cube().shape
        (512, 512, 204)
    """
    config, output_dir = config or ProcessConfig(), Path(output_dir)
    if output_dir.resolve() == Path(session_dir).resolve():
        raise InputError(f"{output_dir}: is the session itself; choose another --output-dir.")
    if (
        config.camera is not None
        and transforms_path(config.camera).resolve() == transforms_path(output_dir).resolve()
    ):
        raise InputError(f"{output_dir}: is the dataset that --camera names; choose another --output-dir.")
    check_options(config)
    require_checks(config.accept)
    require_writable(output_dir)
    # Square brackets and colons in a folder's name are no markup.
    console = Console(stderr=True, quiet=not progress, markup=False, emoji=False)

    session = open_session(session_dir, exclude=config.exclude, skip_damaged=config.skip_damaged)
    fingerprint = _fingerprint(session, config)
    if _is_up_to_date(output_dir, fingerprint):
        console.print(f"{output_dir}: is up to date.")
        return output_dir
    camera = None if config.camera is None else known_camera(open_packed(config.camera))
    scale_known = config.marker_side_m is not None or (camera is not None and camera.metric)
    session, checks = _inspect(session, config, scale_known, output_dir, console)
    side_m = config.marker_side_m or session.info.marker_side_m
    info = replace(session.info, marker_side_m=side_m, image_rotation_deg=session.image_rotation_deg)
    transforms = transforms_path(output_dir)
    if transforms.exists() and not is_packed(output_dir):
        raise InputError(f"{transforms}: belongs to another kind of dataset; choose another output folder.")
    transforms.unlink(missing_ok=True)  # its frames are about to change
    checks.write()

    with console.status("measuring white, noise and lamps"):
        calibration = calibrate_session(session, config.calibration)
        draw_calibration(output_dir / "report", session, calibration, config.pseudo_rgb_nm)
    for sentence in describe_calibration(session, calibration):
        console.print(sentence, highlight=False)
    checks.add(check_calibration(session, calibration))
    caches = pack_frames(
        session,
        calibration,
        output_dir,
        pseudo_rgb_nm=config.pseudo_rgb_nm,
        workers=config.workers,
        progress=progress,
    )
    pixel_counts = PixelCounts.total(cache.pixel_counts for cache in caches)
    num_pixels = sum(cache.gray.size for cache in caches)
    checks.add([check_clipped(session, calibration, pixel_counts, num_pixels)])
    poses = pose_frames(
        session,
        [cache.gray for cache in caches],
        info,
        camera,
        config.poses,
        output_dir,
        console,
        estimate_poses,
        checks.add,
    )
    caches = [cache for cache, used in zip(caches, poses.used, strict=True) if used]
    frames = posed_frames(output_dir, poses)
    container = container_under(session, poses)
    masks, hull, findings = write_masks(caches, frames, poses, container, config.masks, output_dir / "report")
    console.print(f"Masks: the object covers {100.0 * masks.mean():.1f} % of the pixels.")
    checks.add(findings)
    object_box_m = object_box(hull, None if container is None else container.height_m)
    console.print(f"Object: inside a box of {size_in_words(object_box_m, poses.metric)}.")
    diameter_m = session.info.container_diameter_m if poses.metric else None
    if assumption := assumed_disc(bool(poses.marker_corners_m), diameter_m):
        console.print(f"Scene: {assumption}.", highlight=False)
    wavelengths_nm = session.wavelengths_nm[calibration.bands]
    spectrum, typical = _object_spectrum(frames, masks), None
    checks.add(check_band_order(spectrum, wavelengths_nm))
    if calibration.uncertainty is not None:
        typical = calibration.uncertainty.standard_deviation(spectrum)
    write_calibration(output_dir / REPORT_NAME, session, calibration, pixel_counts, typical)

    widths_nm = session.frames[0].cube.fwhm_nm
    dataset = PackedDataset(
        root=output_dir,
        intrinsics=poses.intrinsics,
        distortion=np.array(poses.distortion, dtype=float),
        wavelengths_nm=wavelengths_nm,
        fwhm_nm=None if widths_nm is None else widths_nm[calibration.bands],
        pseudo_rgb_nm=wavelengths_nm[nearest_bands(wavelengths_nm, config.pseudo_rgb_nm)],
        object_name=session.info.object or session.path.resolve().name,
        scene_box_m=scene_box(object_box_m, poses.marker_corners_m, container, diameter_m),
        object_box_m=object_box_m,
        background_reflectance=background_spectrum(frames, masks),
        container=container,
        frames=tuple(frames),
        flagged_values=sum(int(cache.pixel_counts.flagged.sum()) for cache in caches),
        bad_bands_nm=np.delete(session.wavelengths_nm, calibration.bands),
        uncertainty=calibration.uncertainty,
        typical_uncertainty=typical,
        pose_method=poses.method,
        metric=poses.metric,
        image_rotation_deg=session.image_rotation_deg,
        origin_on_disc=poses.on_disc,
        fingerprint=fingerprint,
    )
    with console.status("measuring the effects in the session"):
        bins = BinsOfFrames(caches)
        seen = points_of_object(dataset, bins, masks, hull)
        checks.add([] if seen is None else check_appearance(seen, [frame.capture for frame in frames]))
        drift = calibration.drift, calibration.drift_corrected
        effects = measure_effects(dataset, bins, masks, seen, drift, poses)
        draw_effects(output_dir / "report" / "effects.png", effects)
    show_effects(console, effects)
    note_masks(dataset)
    write_transforms(replace(dataset, effects=effects))
    console.print(f"{output_dir}: {len(frames)} frames are ready to train on.")
    return output_dir


def _inspect(
    session: Session, config: ProcessConfig, scale_known: bool, output_dir: Path, console: Console
) -> tuple[Session, SessionChecks]:
    """The session upright, and what its inspection found, whose pictures of all frames are not kept."""
    with console.status("checking the session"):
        white = config.calibration
        inspection = inspect_session(
            session, config.poses, scale_known, white.white_source, config.skip_damaged, white.roi
        )
    no_scale = any(finding.name == "scale" and finding.level == "red" for finding in inspection.findings)
    if no_scale and not session.info_path.is_file():
        console.print(suggestion(session, inspection.session_json), highlight=False, soft_wrap=True)
    return inspection.session, SessionChecks(inspection, config.accept, output_dir)


def is_processed(session_dir: Path, output_dir: Path, config: ProcessConfig) -> bool:
    """Whether a folder holds the dataset that `process_session` would make there, so that it returns at once.

    Raises:
        InputError: the session cannot be used.
    """
    session = open_session(session_dir, exclude=config.exclude, skip_damaged=config.skip_damaged)
    return _is_up_to_date(output_dir, _fingerprint(session, config))


def _is_up_to_date(output_dir: Path, fingerprint: str) -> bool:
    """Whether a folder holds a complete dataset that was made with this fingerprint."""
    if not is_packed(output_dir) or not all((output_dir / name).is_file() for name in (REPORT_NAME, POSES_NAME)):
        return False
    try:
        dataset = open_packed(output_dir)
        if dataset.fingerprint != fingerprint:
            return False
        for frame in dataset.frames:
            dataset.cube_of(frame)
    except InputError:  # an incomplete dataset is made again
        return False
    return True


def _fingerprint(session: Session, config: ProcessConfig) -> str:
    return session_fingerprint(session, config, [] if config.camera is None else [transforms_path(config.camera)])


def _object_spectrum(
    frames: Sequence[PackedFrame], masks: Bool[np.ndarray, "frames h w"]
) -> Float[np.ndarray, "bands"]:
    """Mean over frames of the mean reflectance in the mask; 0 in a band that no frame measured there.

    At most `OBJECT_PIXELS` or a few more pixels of a frame are read, evenly spread over the mask.
    """
    total = np.zeros(frames[0].cube().shape[-1])
    number = np.zeros_like(total)
    for frame, mask in zip(frames, masks, strict=True):
        pixels = np.flatnonzero(mask)
        chosen = np.unravel_index(pixels[:: max(1, len(pixels) // OBJECT_PIXELS)], mask.shape)
        reflectance, valid = unpack(frame.cube()[chosen])
        measured = valid.sum(axis=0)
        total += reflectance.sum(axis=0) / np.maximum(measured, 1)
        number += measured > 0
    return total / np.maximum(number, 1)
