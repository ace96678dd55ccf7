"""Options of the cloud export, shared by `ns-export pointcloud` and `hsi-sc-nerf export`."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.formats import CloudFormat
from hsi_sc_nerf.settings_file import between, check_options
from hsi_sc_nerf.spectra import require_bands

_RANGE = re.compile(r"(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)")
_FIXED = {
    "reorient_normals": True,
    "normal_output_name": "normals",
    "depth_output_name": "depth",
    "rgb_output_name": "rgb",
}
"""Options of `ns-export pointcloud` of which one value alone has a meaning: normals point outwards, the surface is
searched around the median depth, and colours are the pseudo-RGB of the spectra."""


@dataclass(frozen=True)
class CloudOptions:
    """How a cloud is made. Options that `ns-export pointcloud` has too keep its names and defaults."""

    num_points: int = between(1, math.inf, default=1_000_000)
    """Number of points, spread evenly over the surface. Removing outliers leaves slightly fewer."""
    bands: tuple[str, ...] = ()
    """Bands to keep: wavelengths in nm, such as 670, or ranges, such as 600-700. By default all."""
    format: CloudFormat = "ply"
    """File format. ply: opens in CloudCompare, MeshLab, Open3D. las: for GIS and laser scanning software. netcdf and
    zarr: tables that xarray opens, with wavelength as a coordinate."""
    roi_box: tuple[float, float, float, float, float, float] | None = between(-100.0, 100.0, default=None)
    """Keep the points in a box: smallest x, y, z, then largest x, y, z, metres in the object frame (z along the
    turntable's axis, 0 on the disc)."""
    roi_masks: Path | None = None
    """Keep the points in painted regions: a folder of pictures named as the dataset's masks, for one or more frames,
    white in the region. A point is kept if it is white in every such frame that sees it, and at least one sees it."""
    keep_turntable: bool = False
    """Keep the container and the turntable, which are cut away by default."""
    remove_outliers: bool = True
    """Remove points that lie unusually far from their neighbours."""
    std_ratio: float = between(1e-6, 1e6, default=10.0)
    """How many standard deviations above the average distance make an outlier."""
    normal_method: Literal["open3d", "model_output"] = "model_output"
    """Normals of the model's surface (model_output), or from neighbouring points (open3d)."""
    obb_center: tuple[float, float, float] | None = between(-1e6, 1e6, default=None)
    """Centre of an oriented box to crop to, in nerfstudio's scene units; needs all three obb options."""
    obb_rotation: tuple[float, float, float] | None = between(-1e6, 1e6, default=None)
    """Rotation of that box: roll, pitch, yaw in radians."""
    obb_scale: tuple[float, float, float] | None = between(1e-9, 1e6, default=None)
    """Sides of that box, scene units."""
    num_rays_per_batch: int = between(1, 2**31, default=32768)
    """Rays rendered at a time; fewer need less memory."""

    def __post_init__(self) -> None:
        oriented_box = (self.obb_center, self.obb_rotation, self.obb_scale)
        if any(part is None for part in oriented_box) and any(part is not None for part in oriented_box):
            raise InputError("--obb-center, --obb-rotation and --obb-scale belong together; give all three or none.")
        check_options(self)
        box = self.roi_box
        if box is not None and any(low >= high for low, high in zip(box[:3], box[3:], strict=True)):
            raise InputError("--roi-box takes the smallest x, y and z first, then the largest; give six numbers so.")

    @classmethod
    def from_nerfstudio(cls, options: Any) -> CloudOptions:
        """The options of nerfstudio's `ExportPointCloud`; all others keep their defaults.

        Raises:
            InputError: options contradict each other, or have no meaning for a spectral cloud.
        """
        for name, value in _FIXED.items():
            if getattr(options, name, value) != value:
                raise InputError(f"--{name.replace('_', '-')} is always {value} for hsi-sc-nerf; leave it out.")
        return cls(
            **{field.name: getattr(options, field.name) for field in fields(cls) if hasattr(options, field.name)}
        )


def select_bands(wavelengths_nm: Float[np.ndarray, "bands"], words: Sequence[str]) -> Int[np.ndarray, "selected"]:
    """Indices, ascending, of the bands that ``--bands`` names; all bands without a word.

    Args:
        words: wavelengths in nm (``"670"``: the nearest band) and ranges (``"600-700"``: every band in it).

    Raises:
        InputError: a word is neither, or there is no such band.

    Example:
        >>> select_bands(np.array([500.0, 600.0, 650.0, 700.0]), ["600-660", "700"])
        array([1, 2, 3])
    """
    if not words:
        return np.arange(len(wavelengths_nm))
    selected: set[int] = set()
    for word in words:
        if match := _RANGE.fullmatch(word):
            low, high = map(float, match.groups())
            inside = np.flatnonzero((wavelengths_nm >= low) & (wavelengths_nm <= high))
            if len(inside) == 0:
                raise InputError(
                    f"--bands {word}: the bands go from {wavelengths_nm.min():g} to {wavelengths_nm.max():g} nm and "
                    "none lies in this range; give another one, the smaller wavelength first."
                )
        elif re.fullmatch(r"\d+(\.\d+)?", word):
            inside = require_bands(wavelengths_nm, [float(word)], f"--bands {word}")
        else:
            raise InputError(
                f"--bands {word}: is neither a wavelength in nm, such as 670, nor a range, such as 600-700."
            )
        selected.update(inside.tolist())
    return np.array(sorted(selected))
