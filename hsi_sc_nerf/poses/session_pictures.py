"""The pictures that poses are measured on: for each frame the means of several groups of bands, the best first.

No group of bands is best in every session: noise, saturation and the lens's blur differ along the spectrum, and many
inks are transparent beyond 700 nm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, PixelFlag
from hsi_sc_nerf.poses.turntable import FEWEST_FRAMES
from hsi_sc_nerf.robust_scatter import robust_std
from hsi_sc_nerf.spectra import to_8_bit

GRAY, GRAY_NM = "gray", (450.0, 700.0)
"""The mean over the range in which markers are printed to be seen (many inks are transparent beyond it); it is there
always."""
BAND_GROUPS_NM: Mapping[str, tuple[float, float]] = {
    "blue": (450.0, 500.0),
    "green": (500.0, 600.0),
    "red": (600.0, 680.0),
    "red edge": (680.0, 750.0),
    "near infrared": (750.0, 900.0),
}
"""The other groups of bands that are searched for markers, nm."""

# The broad mean is kept unless another picture is better by this factor: many bands reduce errors outside the score.
_CLEARLY_BETTER = 1.25
# A pixel with more than this fraction of its group's values flagged is not well exposed.
_MOST_FLAGGED = 0.1
# Number of bands by which a group is scored, evenly spread: enough to rank pictures, at a fraction of the cost.
_BANDS_TO_SCORE = 8
# Reflectance at which a pixel is as good as black, and as good as clipped.
_BLACK, _WHITE = 0.004, 0.996
# The strongest edges of a picture, as a fraction of its pixels.
_EDGE_FRACTION = 0.02
# No pixel of a picture of 8 bits is known better than this.
_ROUNDING = 1.0 / (255.0 * np.sqrt(12.0))
# J. Immerkær, "Fast noise variance estimation" (1996): it removes steps and slopes, and multiplies noise by 6.
_NOISE_MASK = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
_NOISE_GAIN = 6.0
# Lines of a cube that are worked on at a time, and frames that are read at the same time.
_BLOCK_LINES = 32
_WORKERS = 2


@dataclass(frozen=True, eq=False)
class FramePictures:
    """Pictures of one frame, all of one size, linear in reflectance.

    Attributes:
        picture: the picture of a name.
        scores: scores of those that are searched for markers, by name, best first (``edge_precision``).
    """

    picture: Callable[[str], UInt8[np.ndarray, "h w"]]
    scores: Mapping[str, float]

    @property
    def ranking(self) -> tuple[str, ...]:
        """Names of the pictures that are searched for markers, best first."""
        return tuple(self.scores)


class SessionPictures(Sequence[UInt8[np.ndarray, "h w"]]):
    """All frames' pictures; as a sequence, of each frame the one in which its edges stand out best."""

    def __init__(self, frames: Sequence[FramePictures]) -> None:
        self.frames = tuple(frames)

    @classmethod
    def of(cls, images: Sequence[UInt8[np.ndarray, "h w"]]) -> SessionPictures:
        """Session pictures as they are; plain images as sessions that show one picture a frame."""
        if isinstance(images, SessionPictures):
            return images
        return cls([FramePictures({GRAY: image}.__getitem__, {GRAY: 1.0}) for image in images])

    def named(self, name: str) -> SessionPictures:
        """The picture of that name of every frame, as the only one in which it is shown."""
        alone = [FramePictures(frame.picture, {name: frame.scores.get(name, 1.0)}) for frame in self.frames]
        return SessionPictures(alone)

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index):
        frame = self.frames[index]
        return frame.picture(frame.ranking[0])


def require_frames(images: Sequence[UInt8[np.ndarray, "h w"]], names: Sequence[str]) -> None:
    """Refuse frames that cannot determine a turntable.

    Raises:
        InputError: too few frames to fix an axis.
        ValueError: images of different sizes, or not one name per image.
    """
    if len(images) != len(names) or len({image.shape for image in images}) > 1:
        raise ValueError("poses need images of one size and one name per image")
    if len(images) < FEWEST_FRAMES:
        raise InputError(
            f"{len(images)} frame(s) ({', '.join(names)}) cannot fix a turntable's axis; "
            f"give {FEWEST_FRAMES} or more frames of one session"
        )


def frame_pictures(cube_path: Path, flags_path: Path, gray: UInt8[np.ndarray, "h w"]) -> FramePictures:
    """Pictures of a packed frame: scored from a few bands of each group, computed from all at the first access.

    Args:
        cube_path: header of the packed cube; it must exist while pictures are accessed.
        flags_path: its pixels' flags (docs/reference/files.md).
    """
    cube = open_cube(cube_path)
    wavelengths_nm = cube.wavelengths_nm
    members = {
        name: (wavelengths_nm >= low) & (wavelengths_nm <= high)
        for name, (low, high) in {GRAY: GRAY_NM, **BAND_GROUPS_NM}.items()
    }
    # If the instrument has no band there, the broad mean was made of all bands.
    members[GRAY] = members[GRAY] if members[GRAY].any() else np.ones(len(wavelengths_nm), bool)
    members = {name: inside for name, inside in members.items() if inside.any()}
    few = {name: _evenly_spread(inside) for name, inside in members.items()}
    means, flagged_fraction = group_means(cube.memmap(), np.stack(list(few.values())))
    well = dict(zip(members, flagged_fraction <= _MOST_FLAGGED, strict=True))
    scores = {
        name: edge_precision(mean, well[name], bands=members[name].sum() / few[name].sum())
        for name, mean in zip(members, means, strict=True)
    }
    best_first = sorted(scores, key=lambda name: -scores[name] * (_CLEARLY_BETTER if name == GRAY else 1.0))

    @cache
    def picture(name: str) -> UInt8[np.ndarray, "h w"]:
        return gray if name == GRAY else _picture(cube.memmap(), flags_path, members[name])

    return FramePictures(picture, {name: scores[name] for name in best_first})


def _evenly_spread(inside: Bool[np.ndarray, "bands"]) -> Bool[np.ndarray, "bands"]:
    """A few of the bands that are inside, evenly spread; all if they are few."""
    bands = np.flatnonzero(inside)
    few = np.zeros_like(inside)
    few[bands[np.linspace(0, len(bands) - 1, min(len(bands), _BANDS_TO_SCORE)).round().astype(int)]] = True
    return few


def _picture(
    packed: UInt16[np.ndarray, "lines samples bands"], flags_path: Path, inside: Bool[np.ndarray, "bands"]
) -> UInt8[np.ndarray, "lines samples"]:
    """The mean of the bands inside; where nothing was measured, white if it is saturated and black else."""
    (mean,), (flagged_fraction,) = group_means(packed, inside[None])
    if (flagged_fraction == 1.0).any():
        flags = np.asarray(cv2.imread(str(flags_path), cv2.IMREAD_UNCHANGED))
        saturated = (flags & np.uint8(PixelFlag.SATURATED)) > 0
        mean = np.where(flagged_fraction == 1.0, saturated, mean)
    return to_8_bit(mean)


def read_pictures(
    cube_paths: Sequence[Path],
    flags_paths: Sequence[Path],
    grays: Sequence[UInt8[np.ndarray, "h w"]],
) -> SessionPictures:
    """``frame_pictures`` of all frames."""
    with ThreadPoolExecutor(_WORKERS) as pool:
        return SessionPictures(list(pool.map(frame_pictures, cube_paths, flags_paths, grays)))


def group_means(
    packed: UInt16[np.ndarray, "lines samples bands"], members: Bool[np.ndarray, "groups bands"]
) -> tuple[Float[np.ndarray, "groups lines samples"], Float[np.ndarray, "groups lines samples"]]:
    """Mean measured reflectance of each group of bands (nan where there is none), and the flagged fraction.

    Args:
        packed: reflectance as 16-bit numbers (``packed_cube``); read a few lines at a time.
        members: which bands belong to each group, one at least; bands that belong to none are not converted.
    """
    lines, samples, bands = packed.shape
    columns = np.flatnonzero(members.any(axis=0))
    weights = np.ascontiguousarray(members.T[columns], np.float32)
    size = weights.sum(axis=0)
    means = np.empty((len(members), lines, samples), np.float32)
    flagged_fraction = np.zeros_like(means)
    for start in range(0, lines, _BLOCK_LINES):
        stop = min(start + _BLOCK_LINES, lines)
        block = np.take(np.asarray(packed[start:stop]).reshape(-1, bands), columns, axis=1)
        values = block.astype(np.float32)
        flagged = block == FLAGGED
        measured: Float[np.ndarray, "*pixels groups"] = size
        if flagged.any():
            values[flagged] = 0.0
            measured = size - flagged.astype(np.float32) @ weights
            flagged_fraction[:, start:stop] = (1.0 - measured / size).T.reshape(-1, stop - start, samples)
        with np.errstate(invalid="ignore"):
            block_means = values @ weights / (measured * REFLECTANCE_SCALE)
        means[:, start:stop] = block_means.T.reshape(-1, stop - start, samples)
    return means, flagged_fraction


def edge_precision(
    reflectance: Float[np.ndarray, "h w"], measured: Bool[np.ndarray, "h w"] | None = None, bands: float = 1.0
) -> float:
    """Precision of a picture's strongest edges: their mean slope over the noise, 1/px.

    Noise of standard deviation s moves an edge of slope g by s/g pixels, so this is one over that error. Blur and
    ink that is hardly visible flatten the slope. An edge does not count where a pixel at it is black, clipped or not
    ``measured``, for its position is lost there. Noise is that of the brighter half of the pixels, where markers'
    paper is (J. Immerkær, "Fast noise variance estimation", 1996, with the median), and at least that of 8 bits.

    Args:
        reflectance: the picture.
        measured: which pixels are well measured; all if not given.
        bands: ratio of the judged picture's number of bands to that of ``reflectance``; noise falls with its root.

    Returns:
        0 where no pixel is exposed well.
    """
    exposed = (reflectance > _BLACK) & (reflectance < _WHITE)
    if measured is not None:
        exposed &= measured
    whole = cv2.erode(exposed.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    if not whole.any():
        return 0.0
    picture = np.asarray(reflectance, np.float32)
    bright = whole & (picture >= np.median(picture[whole]))
    curvature = cv2.filter2D(picture, cv2.CV_32F, _NOISE_MASK)[bright]
    noise = float(robust_std(curvature)) / (_NOISE_GAIN * np.sqrt(bands))
    return edge_slope(picture, whole) / float(np.hypot(noise, _ROUNDING))


def edge_slope(picture: Float[np.ndarray, "h w"], counted: Bool[np.ndarray, "h w"] | bool = True) -> float:
    """Mean slope, per px, of a picture's strongest edges among ``counted`` pixels; 32 bit."""
    across, down = (cv2.Sobel(picture, cv2.CV_32F, x, 1 - x, ksize=3, scale=1.0 / 8.0) for x in (1, 0))
    slope = np.where(counted, cv2.magnitude(across, down), 0.0)
    strongest = max(1, round(_EDGE_FRACTION * slope.size))
    # Of the negative slopes the first: the many zeros at the other end make partition slow.
    return -float(np.partition(-slope.ravel(), strongest - 1)[:strongest].mean())
