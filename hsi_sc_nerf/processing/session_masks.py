"""Foreground masks of a session's frames and their visual hull: found, checked, written and drawn.

An object on a container is searched for above the lid, in a cylinder that is hardly wider than the lid. If it ends at
the side of that cylinder, wider ones are tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.packed.dataset import Container, PackedFrame
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.processing.frames import BinsOfFrames, FrameCache
from hsi_sc_nerf.processing.lid_regions import above_lid, lid_middle
from hsi_sc_nerf.processing.mask_checks import check_masks
from hsi_sc_nerf.processing.masks import MaskConfig, foreground_masks, mask_picture
from hsi_sc_nerf.processing.visual_hull import VotedHull, voted_hull

OVERHANGS = (1.2, 1.6, 2.4)
"""Radii of the cylinder above the lid in which the object is searched for, as multiples of the lid's."""


def write_masks(
    caches: Sequence[FrameCache],
    frames: Sequence[PackedFrame],
    poses: TurntablePoses,
    container: Container | None,
    config: MaskConfig,
    report_dir: Path,
) -> tuple[Bool[np.ndarray, "frames h w"], VotedHull, list[Finding]]:
    """Find the masks of posed frames, write them and their picture.

    Args:
        caches: what was kept of the frames when they were calibrated.
        frames: where the masks go, and the poses.
        report_dir: where ``masks.png`` goes.

    Returns:
        The masks, their visual hull, and the findings on them.

    Raises:
        InputError: the spectra of object and background hardly differ; the operating system refused to write.

    Example:
        >>> masks, hull, findings = write_masks(caches, frames, poses, container, MaskConfig(), data / "report")
        >>> refuse_red(findings)
    """
    bins, names = BinsOfFrames(caches), [frame.capture for frame in frames]
    brightness = np.stack([image.mean(axis=0, dtype=np.float32) for image in bins])
    camera_to_worlds, lens = np.stack([frame.camera_to_world for frame in frames]), poses.intrinsics
    lid_middles = None
    if container is not None:
        lid_middles = np.stack([lid_middle(lens, pose, container) for pose in camera_to_worlds])

    def hull_of(masks: Bool[np.ndarray, "frames h w"]) -> VotedHull:
        return voted_hull(masks, camera_to_worlds, lens, None if container is None else container.height_m)

    def found_within(overhang: float) -> tuple[Bool[np.ndarray, "frames h w"], VotedHull, list[Finding]]:
        regions = None
        if container is not None:
            distortion = np.array(poses.distortion, dtype=float)
            regions = np.stack([above_lid(lens, distortion, pose, container, overhang) for pose in camera_to_worlds])
        masks, left_out = foreground_masks(bins, config, regions)
        hull = hull_of(masks)
        findings = check_masks(
            masks,
            names,
            hull,
            brightness,
            left_out,
            lambda others: hull_of(others).silhouettes,
            regions,
            lid_middles,
        )
        return masks, hull, findings

    masks, hull, findings = found_within(OVERHANGS[0] if config.overhang is None else config.overhang)
    is_cut_off = any(finding.name == "masks-cut" for finding in findings)
    for overhang in OVERHANGS[1:] if config.overhang is None and is_cut_off else ():
        try:
            wider = found_within(overhang)
        except InputError:  # nothing stands out any more: the narrow space is the better one
            break
        if not any(finding.name == "masks-cut" or finding.level == "red" for finding in wider[2]):
            masks, hull, findings = wider
            break
    if not any(finding.level == "red" for finding in findings):
        masks = hull.trim(masks)
    for frame, mask in zip(frames, masks, strict=True):
        write_png(frame.mask_path, mask.astype(np.uint8) * 255)
    mask_picture(report_dir / "masks.png", [frame.pseudo_rgb() for frame in frames], list(masks), names)
    return masks, hull, findings
