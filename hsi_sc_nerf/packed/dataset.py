"""The packed dataset on disk (docs/reference/files.md): frames, masks and poses, described by ``transforms.json``."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path, PurePosixPath
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import read_json, read_picture, write_json
from hsi_sc_nerf.findings import EffectEvidence
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.packed.cube import ReflectanceUncertainty
from hsi_sc_nerf.settings_file import read_dataclass

TRANSFORMS_NAME = "transforms.json"
_DISTORTION = ("k1", "k2", "p1", "p2")
# A frame's files and their keys; nerfstudio knows the first two.
_FRAME_FILES = {
    "image_path": "file_path",
    "mask_path": "mask_path",
    "cube_path": "cube_path",
    "flags_path": "flags_path",
}
_AGAIN = "process the session again"
_MAY_BE_UNKNOWN = ("fwhm_nm", "typical_uncertainty")
_MAY_BE_MISSING = ("pose_method", "fingerprint", "image_rotation_deg", "origin_on_disc")
_Array = TypeVar("_Array", bound=np.ndarray)
_ROTATION_TOLERANCE = 1e-3  # of digits that somebody rounded


@dataclass(frozen=True)
class Container:
    """The upright cylinder that the object stands on, metres."""

    diameter_m: float
    height_m: float


@dataclass(frozen=True, eq=False)
class PackedFrame:
    """One frame: its files and its pose.

    Attributes:
        capture: name of the capture it was made from.
        image_path: pseudo-RGB picture.
        mask_path: foreground mask.
        cube_path: header of the reflectance cube.
        flags_path: picture of the pixels' flags.
        angle_deg: the turntable's angle relative to the first frame, counter-clockwise seen from above.
        reprojection_error_px: root mean square over the frame's markers or features; None for given poses.
        camera_to_world: pose in the object frame, OpenGL axes, metres.
    """

    capture: str
    image_path: Path
    mask_path: Path
    cube_path: Path
    flags_path: Path
    angle_deg: float
    reprojection_error_px: float | None
    camera_to_world: Float[np.ndarray, "4 4"]

    def cube(self) -> UInt16[np.memmap, "lines samples bands"]:
        """Memory map of the packed reflectance (`unpack`).

        Raises:
            InputError: the file is no packed cube.
        """
        counts = open_cube(self.cube_path).memmap()
        if not (isinstance(counts, np.memmap) and counts.flags.c_contiguous and counts.dtype.str[1:] == "u2"):
            raise InputError(f"{self.cube_path}: is not a BIP cube of 16-bit numbers; process the session again.")
        return counts

    def mask(self) -> Bool[np.ndarray, "lines samples"]:
        """True on the object."""
        return _picture(self.mask_path, 1) > 127

    def flags(self) -> UInt8[np.ndarray, "lines samples"]:
        """`PixelFlag`s of each pixel."""
        return _picture(self.flags_path, 1)

    def pseudo_rgb(self) -> UInt8[np.ndarray, "lines samples 3"]:
        """The pseudo-RGB picture."""
        return _picture(self.image_path, 3)


@dataclass(frozen=True, eq=False)
class PackedDataset:
    """The content of ``transforms.json``.

    Attributes:
        root: the dataset's folder.
        intrinsics: intrinsics of the one camera.
        distortion: k1, k2, p1, p2 (OpenCV).
        wavelengths_nm: band centres.
        pseudo_rgb_nm: the three bands of the pictures.
        object_name: what was on the turntable.
        scene_box_m: minimum and maximum of everything that turns, object frame.
        object_box_m: minimum and maximum of the object alone, object frame.
        background_reflectance: median spectrum of the chamber behind the object.
        container: what the object stands on, if its size is known.
        frames: in capture order.
        flagged_values: number of values that are ``FLAGGED``, in all cubes.
        bad_bands_nm: centres of the bands that were left out because they measure nothing.
        fwhm_nm: full widths at half maximum of the bands; None if they are unknown.
        uncertainty: uncertainty of the reflectance; None if it is unknown (finished reflectance, unmeasured noise).
        typical_uncertainty: standard deviation by band at the object's mean reflectance; None likewise.
        pose_method: how the poses were estimated ("markers", "colmap", "angles"); None if that is unknown.
        metric: whether lengths are metres; else nothing gave the scale: the camera's distance from the axis is 1.
        image_rotation_deg: rotation of the raw images from upright, counter-clockwise; None in older datasets.
        origin_on_disc: whether the origin is on the disc, else its height is not known; None in older datasets.
        fingerprint: fingerprint of the session and the settings that the dataset was made from.
        effects: present in the session or not, by their evidence; empty in datasets of older versions.
    """

    root: Path
    intrinsics: PinholeIntrinsics
    distortion: Float[np.ndarray, "4"]
    wavelengths_nm: Float[np.ndarray, "bands"]
    pseudo_rgb_nm: Float[np.ndarray, "3"]
    object_name: str
    scene_box_m: Float[np.ndarray, "2 3"]
    object_box_m: Float[np.ndarray, "2 3"]
    background_reflectance: Float[np.ndarray, "bands"]
    container: Container | None
    frames: tuple[PackedFrame, ...]
    flagged_values: int = 0
    bad_bands_nm: Float[np.ndarray, "bad"] = field(default_factory=lambda: np.zeros(0))
    fwhm_nm: Float[np.ndarray, "bands"] | None = None
    uncertainty: ReflectanceUncertainty | None = None
    typical_uncertainty: Float[np.ndarray, "bands"] | None = None
    pose_method: str | None = None
    metric: bool = True
    image_rotation_deg: int | None = None
    origin_on_disc: bool | None = None
    fingerprint: str | None = None
    effects: tuple[EffectEvidence, ...] = ()

    def __repr__(self) -> str:
        camera, nm = self.intrinsics, self.wavelengths_nm
        bands = f"{len(nm)} bands from {nm[0]:g} to {nm[-1]:g} nm"
        of = f"{len(self.frames)} frames of {camera.w} x {camera.h} pixels, {bands}"
        return f"<PackedDataset {self.root}: {self.object_name}, {of}>"

    def cube_of(self, frame: PackedFrame) -> UInt16[np.memmap, "lines samples bands"]:
        """`PackedFrame.cube`, of the size that ``transforms.json`` states.

        Raises:
            InputError: the file is no packed cube, or of another size.
        """
        return self._of_stated_size(frame.cube_path, frame.cube())

    def mask_of(self, frame: PackedFrame) -> Bool[np.ndarray, "lines samples"]:
        """`PackedFrame.mask`, of the size that ``transforms.json`` states.

        Raises:
            InputError: the file is no picture, or of another size.
        """
        return self._of_stated_size(frame.mask_path, frame.mask())

    def _of_stated_size(self, path: Path, values: _Array) -> _Array:
        stated = (self.intrinsics.h, self.intrinsics.w, len(self.wavelengths_nm))
        if values.shape != stated[: values.ndim]:
            found, expected = (" x ".join(map(str, size)) for size in (values.shape, stated))
            of = f"the dataset's transforms.json states {expected} (lines, samples, bands)"
            raise InputError(f"{path}: has {found} values, but {of}; {_AGAIN}.")
        return values

    @property
    def camera_to_worlds(self) -> Float[np.ndarray, "frames 4 4"]:
        """All poses, in frame order."""
        return np.stack([frame.camera_to_world for frame in self.frames])


def transforms_path(path: Path) -> Path:
    """The ``transforms.json`` of a dataset given by its folder or by that file."""
    path = Path(path)
    return path if path.name == TRANSFORMS_NAME else path / TRANSFORMS_NAME


def is_packed(path: Path) -> bool:
    """Whether ``path`` is the folder (or the ``transforms.json``) of a packed hyperspectral dataset."""
    try:
        return "wavelengths_nm" in read_json(transforms_path(path), _AGAIN)
    except InputError:
        return False


def open_packed(path: Path) -> PackedDataset:
    """Open a packed dataset by its folder or its ``transforms.json``.

    Raises:
        InputError: ``transforms.json`` is missing, is no JSON, lacks a key, has one that cannot be read, or lists no
            frames; or a frame's file is missing.

    Example:
        >>> dataset = open_packed(Path("dataset"))
        >>> reflectance, valid = unpack(dataset.frames[0].cube()[256])  # one line: (samples, bands)
    """
    path = transforms_path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no packed dataset here; make one with `hsi-sc-nerf process`.")
    content = read_json(path, _AGAIN)
    try:
        dataset = _parse_transforms(path.parent, content, str(path))
    except KeyError as error:
        raise InputError(f"{path}: lacks the key {error}; process the session again.") from error
    except (AttributeError, OverflowError, TypeError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); process the session again.") from error
    if not dataset.frames:
        raise InputError(f"{path}: lists no frames; process the session again.")
    for file in (getattr(frame, name) for frame in dataset.frames for name in _FRAME_FILES):
        if not os.path.isfile(file):
            raise InputError(f"{file}: is missing, but {path} lists it; process the session again.")
    return dataset


def write_transforms(dataset: PackedDataset) -> Path:
    """Write ``transforms.json`` into the dataset's folder and return its path.

    Raises:
        InputError: the operating system refused to write.
    """
    arrays, noise = {name: getattr(dataset, name) for name in _shapes(0)}, dataset.uncertainty
    content: dict[str, Any] = {
        "camera_model": "OPENCV",
        **asdict(dataset.intrinsics),
        **dict(zip(_DISTORTION, map(float, dataset.distortion), strict=True)),
        "object": dataset.object_name,
        "container": None if dataset.container is None else asdict(dataset.container),
        "uncertainty": None if noise is None else {name: values.tolist() for name, values in asdict(noise).items()},
        **{name: None if array is None else array.tolist() for name, array in arrays.items()},
        **{name: getattr(dataset, name) for name in ("flagged_values", "metric", *_MAY_BE_MISSING)},
        "effects": [asdict(effect) for effect in dataset.effects],
        "frames": [
            {
                **{
                    key: getattr(frame, name).relative_to(dataset.root).as_posix()
                    for name, key in _FRAME_FILES.items()
                },
                "capture": frame.capture,
                "angle_deg": float(frame.angle_deg),
                "reprojection_error_px": frame.reprojection_error_px,
                "transform_matrix": frame.camera_to_world.tolist(),
            }
            for frame in dataset.frames
        ],
    }
    path = transforms_path(dataset.root)
    write_json(path, content)
    return path


def _shapes(bands: int) -> dict[str, tuple[int, ...]]:
    """Shapes of a dataset's arrays by their keys (-1: however many there are)."""
    return {
        "wavelengths_nm": (-1,),
        "pseudo_rgb_nm": (3,),
        "scene_box_m": (2, 3),
        "object_box_m": (2, 3),
        "background_reflectance": (bands,),
        "bad_bands_nm": (-1,),
        "fwhm_nm": (bands,),
        "typical_uncertainty": (bands,),
    }


def _numbers(content: dict[str, Any], key: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """The numbers under ``key``; None for those that may be unknown and are."""
    if content[key] is None and key in _MAY_BE_UNKNOWN:
        return None
    try:
        array = np.array(content[key], dtype=float).reshape(shape)
        if not np.isfinite(array).all():
            raise ValueError
        return array
    except (OverflowError, TypeError, ValueError) as error:
        expected = " x ".join(str(size) for size in shape if size >= 0)
        raise ValueError(f"{key} is no list of {expected} numbers".replace("  ", " ")) from error


def _parse_transforms(root: Path, content: dict[str, Any], source: str) -> PackedDataset:
    container, uncertainty = content["container"], content["uncertainty"]
    lens = {field.name: content[field.name] for field in fields(PinholeIntrinsics)}
    intrinsics = read_dataclass(PinholeIntrinsics, lens, source, "")
    if min(intrinsics.w, intrinsics.h, intrinsics.fl_x, intrinsics.fl_y) <= 0:
        raise ValueError("its pictures have no size or no focal length")
    bands = len(content["wavelengths_nm"])
    arrays: dict[str, Any] = {key: _numbers(content, key, shape) for key, shape in _shapes(bands).items()}
    for key in ("scene_box_m", "object_box_m"):
        if not (arrays[key][0] < arrays[key][1]).all():
            raise ValueError(f"{key} has no volume")
    arrays |= {key: content.get(key) for key in _MAY_BE_MISSING}
    parts = () if uncertainty is None else fields(ReflectanceUncertainty)
    terms: dict[str, Any] = {part.name: _numbers(uncertainty, part.name, (bands,)) for part in parts}
    return PackedDataset(
        root=root,
        intrinsics=intrinsics,
        distortion=np.array([content[key] for key in _DISTORTION], dtype=float),
        object_name=str(content["object"]),
        container=None if container is None else read_dataclass(Container, container, source, "container."),
        flagged_values=int(content["flagged_values"]),
        uncertainty=ReflectanceUncertainty(**terms) if terms else None,
        frames=tuple(_parse_frame(root, frame) for frame in content["frames"]),
        metric=bool(content.get("metric", True)),  # older versions do not say
        effects=tuple(_parse_effect(effect) for effect in content.get("effects", ())),
        **arrays,
    )


def _parse_effect(content: dict[str, Any]) -> EffectEvidence:
    values: dict[str, Any] = {key: str(content[key]) for key in ("name", "unit", "sentence")}
    for key in ("evidence", "noise", "threshold"):
        values[key] = None if content[key] is None else float(content[key])
    return EffectEvidence(present=bool(content["present"]), **values)


def _parse_frame(root: Path, frame: dict[str, Any]) -> PackedFrame:
    error_px, pose = frame["reprojection_error_px"], _numbers(frame, "transform_matrix", (4, 4))
    assert pose is not None
    rotation = pose[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise ValueError("a transform_matrix holds no rotation")
    capture, files = frame["capture"], {name: PurePosixPath(frame[key]) for name, key in _FRAME_FILES.items()}
    # A dataset may come from somebody else: what it names lies inside of it, as do files that are named after it.
    if any(file.is_absolute() or ".." in file.parts for file in files.values()):
        raise ValueError("a frame names a file outside of the dataset")
    if not isinstance(capture, str) or capture in ("", ".", "..") or {*capture} & {"/", "\\", "\0"}:
        raise ValueError("the name of a frame's capture is none of a file")
    return PackedFrame(
        capture=capture,
        angle_deg=float(frame["angle_deg"]),
        reprojection_error_px=None if error_px is None else float(error_px),
        camera_to_world=pose,
        **{name: root / file for name, file in files.items()},
    )


def _picture(path: Path, channels: Literal[1, 3]) -> UInt8[np.ndarray, "lines samples *channels"]:
    image = read_picture(path, channels)
    if image is None:
        raise InputError(f"{path}: is not a readable picture; {_AGAIN}.")
    return image
