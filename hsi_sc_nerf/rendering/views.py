"""Cameras to render from: frames of the session, an orbit, or a camera path from nerfstudio's viewer."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from nerfstudio.cameras.camera_paths import get_path_from_json
from nerfstudio.cameras.cameras import Cameras

from hsi_sc_nerf.data.datamanager import SpectralDataset
from hsi_sc_nerf.data.dataparser import pinhole_cameras
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import turntable_camera_to_world
from hsi_sc_nerf.models.trained_run import TrainedRun


@dataclass(frozen=True, eq=False)
class Views:
    """Cameras to render from, in scene units.

    Attributes:
        kind: one word for them, used in file names.
        cameras: the cameras.
        names: a file name for each camera.
        measured: the frames taken by these cameras, in the same order; None if none were taken.
    """

    kind: str
    cameras: Cameras
    names: Sequence[str]
    measured: SpectralDataset | None = None

    def __iter__(self) -> Iterator[tuple[str, Cameras]]:
        return ((name, self.cameras[i : i + 1]) for i, name in enumerate(self.names))


def views_of_frames(run: TrainedRun, split: Literal["held-out", "training"]) -> Views:
    """The cameras of a split's frames, and the measured frames.

    Example:
        >>> run = open_run(Path("config.yml"))
        >>> for name, camera in views_of_frames(run, "held-out"):
        ...     view = render_view(run.model, camera)
    """
    manager = run.manager
    dataset = manager.eval_dataset if split == "held-out" else manager.train_dataset
    return Views(split, dataset.cameras, [frame.capture for frame in dataset.frames], dataset)


def views_of_orbit(run: TrainedRun, count: int, size: float = 1.0) -> Views:
    """The session's camera while the object makes one even counter-clockwise turn before the fixed background.

    Args:
        run: the trained run.
        count: views in the turn.
        size: factor on the size of the camera's images.
    """
    first = run.refined_poses_m()[0]
    poses = np.stack([turntable_camera_to_world(first, angle) for angle in np.arange(count) * 360.0 / count])
    poses[:, :3, 3] = run.to_scene(poses[:, :3, 3])
    cameras = pinhole_cameras(poses, run.dataset.intrinsics, run.dataset.distortion)
    cameras.rescale_output_resolution(size)
    return Views("orbit", cameras, [f"orbit_{i:03d}" for i in range(count)])


def views_of_path(path: Path) -> Views:
    """The cameras of a path that nerfstudio's viewer exported (its Render tab).

    Their background is the chamber's median spectrum, since none of them stands where the camera stood.

    Raises:
        InputError: the file is missing or is no camera path.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; export a camera path from ns-viewer.")
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        cameras = get_path_from_json(content)
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise InputError(f"{path}: is no camera path ({error!r}); export one from ns-viewer.") from error
    return Views("path", cameras, [f"path_{i:03d}" for i in range(len(cameras))])
