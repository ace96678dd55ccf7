"""nerfstudio data parser of packed datasets and of raw sessions, which are processed first.

nerfstudio imports this module while its own data managers are still being imported: it must not import them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from jaxtyping import Float, Int
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.data.utils.dataparsers_utils import get_train_eval_split_fraction
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from nerfstudio.utils.rich_utils import CONSOLE

from hsi_sc_nerf import paper
from hsi_sc_nerf.capture.session import is_session
from hsi_sc_nerf.errors import InputError, one_sentence
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.packed.dataset import PackedDataset, open_packed, transforms_path
from hsi_sc_nerf.processing.painted_masks import painted_box, with_object_box
from hsi_sc_nerf.processing.process import ProcessConfig, is_processed, process_session
from hsi_sc_nerf.processing.visual_hull import size_in_words
from hsi_sc_nerf.spectra import nearest_bands
from hsi_sc_nerf.terminal import ignore_library_warnings

# Of all that nerfstudio discovers this is imported first, and most of its own modules come after it.
ignore_library_warnings()

FRAME_INDEX = "frame_index"
"""Camera metadata: index of the session's frame that a ray belongs to."""
CAMERA_ROTATION = "camera_rotation"
"""Camera metadata: the nine elements of the camera-to-world rotation of a ray, row by row."""


@dataclass
class SpectralDataParserConfig(DataParserConfig):
    """Hyperspectral turntable data."""

    _target: type = field(default_factory=lambda: SpectralDataParser)
    data: Path = Path()
    """A dataset made by `hsi-sc-nerf process`, or a capture session, which is processed into a folder beside it."""
    train_split_fraction: float = paper.TRAIN_SPLIT_FRACTION
    """Fraction of the frames to train on; the others, evenly spread, are held out for evaluation."""
    scene: Literal["box", "cameras"] = "box"
    """What fills the unit cube of the scene. box: everything that turns, and nothing else. cameras: the camera's
    positions around the object, as nerfstudio scales scenes without bounds (the paper's preset)."""
    process: ProcessConfig = field(default_factory=ProcessConfig)
    """How to process a session."""
    object_box_m: tyro.conf.Suppress[tuple[tuple[float, float, float], tuple[float, float, float]] | None] = None
    """Box of the object in this run, found when training starts, where painted masks show more than the dataset's box
    holds."""


class SpectralDataparserOutputs(DataparserOutputs):
    """nerfstudio's, whose transform is written whole or not at all."""

    def save_dataparser_transform(self, path: Path) -> None:
        """Write what brings metres in the object frame into the scene: a shift, then a scale."""
        write_json(path, {"transform": self.dataparser_transform.tolist(), "scale": float(self.dataparser_scale)})


@dataclass
class SpectralDataParser(DataParser):
    """Converts a packed dataset into nerfstudio's cameras, boxes and file lists."""

    config: SpectralDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        data, box_m = self.config.data, self.config.object_box_m
        with one_sentence():
            if is_unprocessed(data):
                data = process_session(data, processed_dir(data.resolve()), self.config.process)
            dataset = open_packed(data)
            return self._outputs(dataset if box_m is None else with_object_box(dataset, np.array(box_m)), split)

    def _outputs(self, dataset: PackedDataset, split: str) -> DataparserOutputs:
        num_frames = len(dataset.frames)
        train, held_out = split_frames(num_frames, self.config.train_split_fraction)
        indices = train if split == "train" else held_out
        poses = dataset.camera_to_worlds
        if self.config.scene == "box":
            centre, scale = scene_scaling(dataset.scene_box_m)
            aabb = (dataset.scene_box_m - centre) * scale
        else:
            centre, scale = scene_scaling(np.stack([f(poses[:, :3, 3], axis=0) for f in (np.min, np.max)]))
            aabb = np.array([[-1.0] * 3, [1.0] * 3])
        poses[:, :3, 3] = (poses[:, :3, 3] - centre) * scale

        cameras = pinhole_cameras(poses[indices], dataset.intrinsics, dataset.distortion, indices)
        transform = torch.eye(4)[:3]
        transform[:, 3] = -torch.from_numpy(centre)
        return SpectralDataparserOutputs(
            image_filenames=[dataset.frames[i].image_path for i in indices],
            mask_filenames=[dataset.frames[i].mask_path for i in indices],
            cameras=cameras,
            scene_box=SceneBox(aabb=torch.from_numpy(aabb).float()),
            dataparser_transform=transform,
            dataparser_scale=scale,
            metadata={
                "dataset": dataset,
                "frames": [dataset.frames[i] for i in indices],
                "wavelengths_nm": dataset.wavelengths_nm,
                "rgb_bands": nearest_bands(dataset.wavelengths_nm, dataset.pseudo_rgb_nm).tolist(),
                "object_box": torch.from_numpy((dataset.object_box_m - centre) * scale).float(),
                # For the pose refinement.
                "turntable": {
                    "camera_to_world": poses[0],
                    "frame_indices": train,
                    "num_frames": num_frames,
                    "axis_origin": -centre * scale,
                },
            },
        )


def pinhole_cameras(
    poses: Float[np.ndarray, "n 4 4"],
    intrinsics: PinholeIntrinsics,
    distortion: Float[np.ndarray, "4"],
    frames: Int[np.ndarray, "n"] | None = None,
) -> Cameras:
    """Cameras at poses in scene units.

    Args:
        poses: camera-to-world, OpenGL axes.
        distortion: k1, k2, p1, p2 (OpenCV).
        frames: indices of the session's frames that were taken at these poses, which the model refines; None for
            poses that belong to no frame and are not refined.
    """
    k1, k2, p1, p2 = distortion
    metadata = {CAMERA_ROTATION: torch.from_numpy(poses[:, :3, :3].reshape(-1, 9)).float()}
    if frames is not None:
        metadata[FRAME_INDEX] = torch.from_numpy(frames)[:, None].float()
    return Cameras(
        camera_to_worlds=torch.from_numpy(poses[:, :3]).float(),
        fx=intrinsics.fl_x,
        fy=intrinsics.fl_y,
        cx=intrinsics.cx,
        cy=intrinsics.cy,
        width=intrinsics.w,
        height=intrinsics.h,
        distortion_params=torch.tensor([k1, k2, 0.0, 0.0, p1, p2]).float() if np.any(distortion) else None,
        camera_type=CameraType.PERSPECTIVE,
        metadata=metadata,
    )


def require_data(manager: Any) -> None:
    """Refuse, before a run's folder is made, data that are neither a dataset nor a session; read painted masks.

    Args:
        manager: configuration of the data manager; it gets the object's box of painted masks, which evaluation and
            export use as well, whatever becomes of the dataset.

    Raises:
        InputError: they are neither, or a dataset that cannot be read, or a session that cannot be used.
    """
    data = manager.data or manager.dataparser.data
    dataset: PackedDataset | None = None
    if not is_unprocessed(data):
        dataset = open_packed(data)
    # Of a dataset that is made anew, masks, poses and scale are others.
    elif is_processed(data, made := processed_dir(data.resolve()), manager.dataparser.process):
        dataset = open_packed(made)
    box_m = None if dataset is None else painted_box(dataset)
    found = None if box_m is None else tuple(map(tuple, box_m.tolist()))
    if dataset is not None and box_m is not None and found != manager.dataparser.object_box_m:
        size = size_in_words(box_m, dataset.metric)
        CONSOLE.print(f"{dataset.root}: painted masks show more; the box of the object is {size}.", markup=False)
    manager.dataparser.object_box_m = found


def is_unprocessed(data: Path) -> bool:
    """Whether ``--data`` is a session; a dataset holds cubes as well, and is none even if it is damaged."""
    return is_session(data) and not transforms_path(data).is_file()


def processed_dir(session_dir: Path) -> Path:
    """Folder that a session given as ``--data`` is processed into."""
    return session_dir.with_name(session_dir.name + "-processed")


def split_frames(
    num_frames: int, train_fraction: float
) -> tuple[Int[np.ndarray, "train"], Int[np.ndarray, "held_out"]]:
    """Indices of training and held-out frames, the latter evenly spread (nerfstudio's "fraction" split).

    At least one frame is held out.

    Raises:
        InputError: the fraction is not between 0 and 1, or there would be no training or no held-out frame.
    """
    if not 0.0 < train_fraction < 1.0:
        raise InputError(
            f"--train-split-fraction is {train_fraction}; it has to be more than 0, and less than 1 to hold some out."
        )
    if num_frames < 2:
        raise InputError("The dataset has one frame; training needs at least one more, to be held out.")
    train_fraction = min(train_fraction, (num_frames - 1) / num_frames)
    train, held_out = get_train_eval_split_fraction([Path(str(i)) for i in range(num_frames)], train_fraction)
    if len(train) == 0 or len(held_out) == 0:
        raise InputError(
            f"--train-split-fraction {train_fraction} leaves {len(train)} of {num_frames} frames to train on and "
            f"{len(held_out)} to evaluate; choose a fraction that leaves at least one of each."
        )
    return train, held_out


def scene_scaling(box_m: Float[np.ndarray, "2 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Centre (metres) and scale that bring a box into [-1, 1]^3, as nerfstudio's models expect."""
    low, high = box_m
    return (low + high) / 2.0, float(2.0 / (high - low).max())


hsi_sc_nerf_dataparser = DataParserSpecification(
    config=SpectralDataParserConfig(),
    description="Hyperspectral turntable session: raw ENVI cubes, or the dataset that `hsi-sc-nerf process` made.",
)
