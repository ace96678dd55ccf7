"""From a capture session to a packed dataset: calibration, poses, masks, boxes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console

from hsi_sc_nerf import paper
from hsi_sc_nerf.calibration.config import CalibrationConfig
from hsi_sc_nerf.calibration.pixel_counts import Tally
from hsi_sc_nerf.calibration.report import (
    REPORT_NAME,
    describe_calibration,
    describe_tally,
    draw_calibration,
    write_calibration,
)
from hsi_sc_nerf.calibration.session_calibration import calibrate_session
from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.morphology import fill_holes
from hsi_sc_nerf.packed.dataset import (
    TRANSFORMS_NAME,
    Container,
    PackedDataset,
    PackedFrame,
    is_packed,
    open_packed,
    transforms_path,
    write_transforms,
)
from hsi_sc_nerf.packed.uncertainty import typical_uncertainty
from hsi_sc_nerf.poses.pose_methods import PoseMethod, find_poses
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.poses.structure_from_motion import FeatureConfig
from hsi_sc_nerf.processing.calibrated_frames import pack_frames
from hsi_sc_nerf.processing.fingerprint import session_fingerprint
from hsi_sc_nerf.processing.frames import FrameNotes, border_spectrum, object_spectrum
from hsi_sc_nerf.processing.masks import MaskConfig, above_lid, choose_threshold, foreground_mask, shaded_parts
from hsi_sc_nerf.processing.posed_frames import (
    PoseFunction,
    check_scale,
    container_under,
    known_camera,
    pose_frames,
    posed_frames,
)
from hsi_sc_nerf.processing.report import mask_picture
from hsi_sc_nerf.processing.scene_box import assumed_disc, object_box, scene_box
from hsi_sc_nerf.spectra.pseudo_rgb import nearest_bands

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ProcessConfig:
    """Settings of the way from raw captures to a packed dataset."""

    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    """White-reference calibration."""
    masks: MaskConfig = field(default_factory=MaskConfig)
    """Foreground masks."""
    pseudo_rgb_nm: tuple[float, float, float] = paper.PSEUDO_RGB_NM
    """Wavelengths shown as red, green and blue, nm; the nearest bands are taken."""
    poses: PoseMethod = "auto"
    """How poses are found: from markers that turn with the object; from features of the object (colmap); from the
    angles that session.json gives (angles); or by the first of these that works (auto)."""
    features: FeatureConfig = field(default_factory=FeatureConfig)
    """Poses from features."""
    camera: Path | None = None
    """A dataset that was made before with the same camera and turntable: with known angles and its camera, poses need
    neither markers nor texture."""
    marker_side_m: float | None = None
    """Side of a marker's black square, metres; session.json's where it is not given here."""
    marker_range_nm: tuple[float, float] = (450.0, 700.0)
    """Markers are looked for in the mean image of these bands, nm (many inks are transparent beyond 700 nm)."""
    object_margin_m: float = 0.003
    """The object's box is widened by this, metres."""
    scene_margin_m: float = 0.005
    """The box of everything that turns is widened by this, metres."""
    workers: int = 2
    """Frames that are calibrated at the same time; each needs memory for about two copies of a raw cube."""


def process_session(
    session_dir: Path,
    output_dir: Path,
    config: ProcessConfig | None = None,
    progress: bool = True,
    estimate_poses: PoseFunction = find_poses,
) -> Path:
    """Make the packed dataset ``output_dir`` (docs/architecture.md) from a capture session; returns its path.

    The same session with the same settings is processed once: a second call returns at once. A run that stopped
    goes on with the frames that are not finished. ``transforms.json`` is written last, so a dataset that has one is
    whole.

    Raises:
        InputError: a setting is out of range; the session cannot be used (``open_session``, ``white_reference``), has
            no marker size, shows no markers or no object; or the output cannot be written or holds another dataset.
    """
    config = config or ProcessConfig()
    _check_settings(config)
    output_dir = Path(output_dir)
    # A folder's name in square brackets, or between colons, is no command to the console.
    console = Console(stderr=True, quiet=not progress, markup=False, emoji=False)
    session = open_session(session_dir)
    stamp = session_fingerprint(session, config, _named_files(config))
    if _is_done(output_dir, stamp):
        console.print(f"{output_dir}: is up to date.")
        return output_dir
    camera = None if config.camera is None else known_camera(open_packed(config.camera))
    info = replace(session.info, marker_side_m=config.marker_side_m or session.info.marker_side_m)
    check_scale(session, info, camera, config.poses)
    _clear_transforms(output_dir)

    with console.status("measuring white, noise and lamps"):
        calibration = calibrate_session(session, config.calibration)
        draw_calibration(output_dir / "report", session, calibration, config.pseudo_rgb_nm)
    for sentence in describe_calibration(session, calibration):
        console.print(sentence, highlight=False)
    notes = pack_frames(
        session,
        calibration,
        output_dir,
        config.masks,
        pseudo_rgb_nm=config.pseudo_rgb_nm,
        marker_range_nm=config.marker_range_nm,
        workers=config.workers,
        progress=progress,
    )
    tally = Tally.total(note.tally for note in notes)
    wavelengths_nm = session.wavelengths_nm[calibration.bands]
    values = sum(note.score.size for note in notes) * len(wavelengths_nm)
    console.print(describe_tally(tally, values), highlight=False)

    images = [note.gray for note in notes]
    poses = pose_frames(
        session,
        images,
        info,
        camera,
        config.poses,
        config.features,
        output_dir,
        console,
        estimate_poses,
        config.marker_range_nm,
    )
    frames = posed_frames(output_dir, poses)
    container = container_under(session, poses)
    camera_to_worlds = np.stack([frame.camera_to_world for frame in frames])
    used_notes = [note for note, posed in zip(notes, poses.used, strict=True) if posed]
    masks = _make_masks(used_notes, camera_to_worlds, poses, container, config.masks)
    for frame, mask in zip(frames, masks, strict=True):
        write_png(frame.mask_path, mask.astype(np.uint8) * 255)
        if not mask.any():
            _log.warning("%s: nothing of the object was found in this frame (see report/masks.png)", frame.capture)
    mask_picture(
        output_dir / "report" / "masks.png",
        [frame.pseudo_rgb() for frame in frames],
        list(masks),
        [frame.capture for frame in frames],
    )
    console.print(f"Masks: the object covers {100.0 * masks.mean():.1f} % of the pixels.")

    bounds = object_box(
        masks,
        camera_to_worlds,
        poses.intrinsics,
        min_z_m=None if container is None else container.height_m,
        margin_m=config.object_margin_m,
    )
    size_mm = " x ".join(f"{1000.0 * side:.0f}" for side in np.diff(bounds, axis=0)[0])
    console.print(f"Object: inside a box of {size_mm} mm.")
    typical = None
    if calibration.uncertainty is not None:
        typical = typical_uncertainty(calibration.uncertainty, _mean_spectrum(frames, masks))
    write_calibration(output_dir / REPORT_NAME, session, calibration, tally, typical)
    widths_nm = session.frames[0].cube.fwhm_nm
    diameter_m = session.info.container_diameter_m if poses.metric else None
    if note := assumed_disc(bool(poses.marker_corners_m), diameter_m):
        console.print(f"Scene: {note}.", highlight=False)
    dataset = PackedDataset(
        root=output_dir,
        intrinsics=poses.intrinsics,
        distortion=np.array(poses.distortion, dtype=float),
        wavelengths_nm=wavelengths_nm,
        fwhm_nm=None if widths_nm is None else widths_nm[calibration.bands],
        pseudo_rgb_nm=wavelengths_nm[nearest_bands(wavelengths_nm, config.pseudo_rgb_nm)],
        object_name=session.info.object or session.path.resolve().name,
        scene_box_m=scene_box(bounds, poses.marker_corners_m, container, config.scene_margin_m, diameter_m),
        object_box_m=bounds,
        background_reflectance=_background(frames, masks),
        container=container,
        frames=tuple(frames),
        flagged_values=sum(int(note.tally.flagged.sum()) for note in used_notes),
        bad_bands_nm=np.delete(session.wavelengths_nm, calibration.bands),
        uncertainty=calibration.uncertainty,
        typical_uncertainty=typical,
        fingerprint=stamp,
    )
    write_transforms(dataset)
    console.print(f"{output_dir}: {len(frames)} frames are ready to train on.")
    return output_dir


def _check_settings(config: ProcessConfig) -> None:
    bins = config.masks.spectral_bins
    for option, value, least in (("workers", config.workers, 1), ("masks.spectral-bins", bins, 2)):
        if value < least:
            raise InputError(f"--{option} is {value}, but must be {least} or more; correct it.")


def _named_files(config: ProcessConfig) -> list[Path]:
    """Files outside of the session that settings name and the dataset depends on."""
    panel, camera = config.calibration.panel, config.camera
    return ([] if panel is None else [panel]) + ([] if camera is None else [transforms_path(camera)])


def _is_done(output_dir: Path, stamp: str) -> bool:
    if not is_packed(output_dir):
        return False
    try:
        return open_packed(output_dir).fingerprint == stamp
    except InputError:  # an incomplete dataset is made again
        return False


def _clear_transforms(output_dir: Path) -> None:
    """Take away an outdated ``transforms.json``: its frames are about to change."""
    transforms = output_dir / TRANSFORMS_NAME
    if transforms.exists() and not is_packed(output_dir):
        raise InputError(f"{transforms}: belongs to another kind of dataset; choose another output folder.")
    transforms.unlink(missing_ok=True)


def _make_masks(
    notes: Sequence[FrameNotes],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    poses: TurntablePoses,
    container: Container | None,
    config: MaskConfig,
) -> Bool[np.ndarray, "frames h w"]:
    threshold = choose_threshold([note.score for note in notes], config)
    distortion = np.array(poses.distortion, dtype=float)
    masks = []
    for note, pose in zip(notes, camera_to_worlds, strict=True):
        allowed = above_lid(poses.intrinsics, distortion, pose, container, config.overhang) if container else None
        body = foreground_mask(
            note.score,
            threshold,
            allowed=allowed,
            weak_share=config.weak_share,
            morphology_fraction=config.morphology_fraction,
        )
        if config.shaded_share is not None:
            shaded = shaded_parts(body, note.score, note.brightness, allowed=allowed, share=config.shaded_share)
            body = fill_holes(body | shaded)
        masks.append(body)
    return np.stack(masks)


def _background(frames: Sequence[PackedFrame], masks: Bool[np.ndarray, "frames h w"]) -> Float[np.ndarray, "bands"]:
    """Median over frames of the spectra along the image's border; 0 in a band that no frame shows there."""
    spectra = np.stack([border_spectrum(frame.cube_path, mask) for frame, mask in zip(frames, masks, strict=True)])
    shown = np.isfinite(spectra).any(axis=0)
    background = np.zeros(spectra.shape[1])
    background[shown] = np.nanmedian(spectra[:, shown], axis=0)
    return background


def _mean_spectrum(
    frames: Sequence[PackedFrame], masks: Bool[np.ndarray, "frames h w"]
) -> Float[np.ndarray, "bands"]:
    """Mean over frames of the object's spectrum; 0 in a band that no frame has."""
    spectra = np.stack([object_spectrum(frame.cube_path, mask) for frame, mask in zip(frames, masks, strict=True)])
    shown = np.isfinite(spectra)
    return np.where(shown, spectra, 0.0).sum(axis=0) / np.maximum(shown.sum(axis=0), 1)
