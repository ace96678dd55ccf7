"""What can be chosen when a cloud is exported, by `ns-export pointcloud` and by `hsi-sc-nerf export` alike."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.formats import CloudFormat

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class CloudOptions:
    """How a cloud is made. Names and defaults that `ns-export pointcloud` has too are its own."""

    num_points: int = 1_000_000
    """Number of points, spread evenly over the surface. Removing outliers leaves a few less."""
    bands: tuple[str, ...] = ()
    """Bands to keep: wavelengths in nm, such as 670, or ranges, such as 600-700. All without this option."""
    format: CloudFormat = "ply"
    """Kind of file. ply: opens in CloudCompare, MeshLab, Open3D. las: for GIS and laser scanning software. netcdf and
    zarr: tables that xarray opens, with wavelength as a coordinate."""
    roi_box: tuple[float, float, float, float, float, float] | None = None
    """Keep what lies in a box: smallest x, y, z, then largest x, y, z, metres in the object's frame (z along the
    turntable's axis, 0 on the disc)."""
    roi_cylinder: tuple[float, float, float, float, float] | None = None
    """Keep what lies in an upright cylinder: x and y of its axis, radius, lowest and highest z, metres."""
    roi_masks: Path | None = None
    """Keep what you painted: a folder of pictures named as the dataset's masks, for one or more frames, white where
    the region is. A point stays that lies in white in every such frame that sees it, and is seen in one."""
    keep_turntable: bool = False
    """Keep the container and the turntable, which are cut away otherwise."""
    remove_outliers: bool = True
    """Remove points that lie unusually far from their neighbours."""
    std_ratio: float = 10.0
    """How many standard deviations above the average distance make an outlier."""
    reorient_normals: bool = True
    """Turn the normals to the side that cameras look at."""
    normal_method: Literal["open3d", "model_output"] = "model_output"
    """Where normals come from: the slope of the model's density, or a plane through neighbouring points (open3d)."""
    normal_output_name: str = "normals"
    """Which of the model's normals: normals is the slope of the density, which every model has; pred_normals only a
    model trained to predict them."""
    depth_output_name: str = "depth"
    """Which of the model's depths the surface is sought around: depth (the median) or expected_depth."""
    rgb_output_name: str = "rgb"
    """Which of the model's outputs is shown as red, green, blue: rgb is the pseudo-RGB of the spectra."""
    obb_center: Vector | None = None
    """Centre of an oriented box to crop to, in nerfstudio's scene units; it takes all three of these options."""
    obb_rotation: Vector | None = None
    """Rotation of that box: roll, pitch, yaw in radians."""
    obb_scale: Vector | None = None
    """Sides of that box, scene units."""
    num_rays_per_batch: int = 32768
    """Rays rendered at a time; fewer need less memory."""

    def __post_init__(self) -> None:
        crop = (self.obb_center, self.obb_rotation, self.obb_scale)
        if any(part is None for part in crop) and any(part is not None for part in crop):
            raise InputError("--obb-center, --obb-rotation and --obb-scale belong together; give all three or none.")
        if self.num_points < 1 or self.num_rays_per_batch < 1:
            raise InputError("--num-points and --num-rays-per-batch must be at least 1.")
        if not self.std_ratio > 0.0:
            raise InputError("--std-ratio must be greater than 0.")
        box, cylinder = self.roi_box, self.roi_cylinder
        if box is not None and any(low >= high for low, high in zip(box[:3], box[3:], strict=True)):
            raise InputError("--roi-box takes the smallest x, y and z first, then the largest; give six numbers so.")
        if cylinder is not None and (cylinder[2] <= 0 or cylinder[3] >= cylinder[4]):
            raise InputError(
                "--roi-cylinder takes x, y, a radius above 0, the lowest and the highest z, in this order."
            )

    @classmethod
    def from_nerfstudio(cls, options: Any) -> CloudOptions:
        """The same choices as nerfstudio's `ExportPointCloud` holds; what it does not know keeps its default.

        Raises:
            InputError: they contradict each other.
        """
        shared = (field.name for field in fields(cls) if hasattr(options, field.name))
        return cls(**{name: getattr(options, name) for name in shared})
