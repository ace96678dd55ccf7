"""Views of a trained model: frames of the session, an orbit or a camera path, rendered and written as ENVI cubes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.camera_paths import get_path_from_json
from nerfstudio.cameras.cameras import Cameras

from hsi_sc_nerf.capture.envi import write_cube
from hsi_sc_nerf.data.datamanager import SpectralDataset
from hsi_sc_nerf.data.dataparser import pinhole_cameras
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import read_json
from hsi_sc_nerf.geometry.camera import turntable_camera_to_world
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, pack
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.spectra import nearest_bands
from hsi_sc_nerf.surface.surface_depth import MIN_OPACITY

CubeType = Literal["float32", "uint16"]
_LARGEST_PX = 2**14
"""Side of the largest picture that a camera path may ask for."""


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
        >>> run = open_trained_run(Path("config.yml"))
        >>> for name, camera in views_of_frames(run, "held-out"):
        ...     view = render_view(run.model, camera)
    """
    manager = run.manager
    dataset = manager.eval_dataset if split == "held-out" else manager.train_dataset
    return Views(split, dataset.cameras, [frame.capture for frame in dataset.frames], dataset)


def views_of_orbit(run: TrainedRun, count: int, size: float = 1.0) -> Views:
    """The session's camera while the object makes one even counter-clockwise turn before the fixed background.

    Args:
        size: factor on the size of the camera's images.

    Raises:
        InputError: no pixel is left.
    """
    cameras = cameras_at(run, np.arange(count) * 360.0 / count, size)
    return Views("orbit", cameras, [f"orbit_{i:03d}" for i in range(count)])


def cameras_at(run: TrainedRun, angles_deg: Float[np.ndarray, "cameras"], size: float = 1.0) -> Cameras:
    """The session's camera with the object turned counter-clockwise by angles from where the first frame saw it.

    Raises:
        InputError: an angle is not finite, or the factor ``size`` on the images' size leaves no pixel.
    """
    camera = run.dataset.intrinsics
    if not (np.isfinite(angles_deg).all() and size * min(camera.w, camera.h) >= 1.0):
        raise InputError(
            f"views need finite angles and images of a pixel at least, not {size:g} times {camera.w} x {camera.h} "
            "pixels; correct them."
        )
    first = run.refined_poses_m()[0]
    poses = np.stack([turntable_camera_to_world(first, angle) for angle in angles_deg])
    poses[:, :3, 3] = run.to_scene(poses[:, :3, 3])
    cameras = pinhole_cameras(poses, camera, run.dataset.distortion)
    cameras.rescale_output_resolution(size)
    return cameras


def views_of_path(path: Path) -> Views:
    """The cameras of a path that nerfstudio's viewer exported (its Render tab).

    Their background is the chamber's median spectrum, since none of them stands where the camera stood.

    Raises:
        InputError: the file is missing or is not a camera path.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; export a camera path from ns-viewer.")
    content = read_json(path, "export a camera path from ns-viewer")
    try:
        for key in ("render_width", "render_height"):
            if not 1 <= content[key] <= _LARGEST_PX:
                raise ValueError(f"{key} is not between 1 and {_LARGEST_PX}")
        cameras = get_path_from_json(content)
        if not cameras.camera_to_worlds.isfinite().all():
            raise ValueError("a camera is at no finite place")
    except (AttributeError, ValueError, KeyError, TypeError, RuntimeError, OverflowError) as error:
        raise InputError(f"{path}: is not a camera path ({error!r}); export one from ns-viewer.") from error
    return Views("path", cameras, [f"path_{i:03d}" for i in range(len(cameras))])


@dataclass(frozen=True, eq=False)
class RenderedView:
    """The model's image from one camera.

    Attributes:
        spectral: reflectance; transparent pixels include the background's.
        opacity: fraction of each pixel that the model's scene covers, in [0, 1].
        depth: distance from the camera along each pixel's ray, scene units.
        model: that rendered it along rays as its pose refinement corrects them; None for rays as they are.
    """

    spectral: Float[torch.Tensor, "h w bands"]
    opacity: Float[torch.Tensor, "h w"]
    depth: Float[torch.Tensor, "h w"]
    model: SpectralModel | None = None

    @property
    def valid(self) -> Bool[torch.Tensor, "h w"]:
        """Pixels that show the model's scene rather than the background."""
        return self.opacity > MIN_OPACITY


def render_view(model: SpectralModel, camera: Cameras) -> RenderedView:
    """Render one camera (scene units) of a model in evaluation mode; the result is on the CPU.

    Example:
        >>> run = open_trained_run(Path("config.yml"))
        >>> view = render_view(run.model, run.manager.eval_dataset.cameras[:1])
    """
    outputs = model.get_outputs_for_camera(camera.to(model.device))
    return RenderedView(
        outputs["spectral"].cpu(), outputs["accumulation"][..., 0].cpu(), outputs["depth"][..., 0].cpu(), model
    )


@torch.no_grad()
def visible_points(camera: Cameras, view: RenderedView) -> Float[np.ndarray, "h w 3"]:
    """Where each pixel's ray ends, scene units; NaN where a pixel is not `RenderedView.valid`."""
    rays = camera.to("cpu" if view.model is None else view.model.device).generate_rays(0)
    if view.model is not None:
        view.model.camera_optimizer.apply_to_raybundle(rays)
    rays = rays.to("cpu")
    points = rays.origins + rays.directions * view.depth[..., None]
    return torch.where(view.valid[..., None], points, torch.nan).numpy()


def write_view(folder: Path, name: str, view: RenderedView, dataset: PackedDataset, kind: CubeType) -> None:
    """Write a cube of reflectance ``NAME``, and ``NAME_valid``, a band that is 1 where valid.

    Each pair of files appears whole or not at all.

    Raises:
        InputError: the files cannot be written.
    """
    write_cube_of_view(folder, name, view.spectral.numpy(), dataset, kind)
    about = {"description": f"1 where the opacity of {name} is above {MIN_OPACITY}", "band names": ["valid"]}
    valid = view.valid.numpy().astype(np.uint8)[..., None]
    write_cube(folder / f"{name}_valid.hdr", valid, wavelengths_nm=None, extra_header=about)


def write_cube_of_view(
    folder: Path, name: str, reflectance: Float[np.ndarray, "h w bands"], dataset: PackedDataset, kind: CubeType
) -> None:
    """Write a BIL cube of reflectance ``NAME.hdr`` and ``.raw``.

    A 16-bit cube holds reflectance times `REFLECTANCE_SCALE`, as its header states, and `FLAGGED` where it is NaN.

    Raises:
        InputError: the files cannot be written.
    """
    wavelengths_nm = dataset.wavelengths_nm
    header = {
        "description": f"{dataset.object_name}, rendered view {name}, reflectance",
        "band names": [f"{wavelength:.2f} nm" for wavelength in wavelengths_nm],
        # ENVI counts bands from 1.
        "default bands": (nearest_bands(wavelengths_nm, dataset.pseudo_rgb_nm) + 1).tolist(),
    }
    if dataset.fwhm_nm is not None:
        header["fwhm"] = dataset.fwhm_nm.tolist()
    if kind == "uint16":
        reflectance = pack(reflectance)
        header |= {"reflectance scale factor": REFLECTANCE_SCALE, "data ignore value": FLAGGED}
    write_cube(folder / f"{name}.hdr", reflectance, wavelengths_nm=wavelengths_nm, extra_header=header)
