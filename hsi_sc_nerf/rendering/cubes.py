"""Render views of a trained model and write them as ENVI cubes, each with a map of valid pixels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras

from hsi_sc_nerf.capture.envi import write_cube
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, pack
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.spectra.bands import nearest_bands
from hsi_sc_nerf.surface.surface_depth import MIN_OPACITY

CubeType = Literal["float32", "uint16"]


@dataclass(frozen=True, eq=False)
class RenderedView:
    """What the model shows from one camera.

    Attributes:
        spectral: reflectance; transparent pixels include the background's.
        opacity: fraction of each pixel that the model's scene covers, in [0, 1].
    """

    spectral: Float[torch.Tensor, "h w bands"]
    opacity: Float[torch.Tensor, "h w"]

    @property
    def valid(self) -> Bool[torch.Tensor, "h w"]:
        """Pixels that show the model's scene rather than the background."""
        return self.opacity > MIN_OPACITY


def render_view(model: SpectralModel, camera: Cameras) -> RenderedView:
    """Render one camera (scene units) of a model in evaluation mode; the result is on the CPU.

    Example:
        >>> run = open_run(Path("config.yml"))
        >>> view = render_view(run.model, run.manager.eval_dataset.cameras[:1])
    """
    outputs = model.get_outputs_for_camera(camera.to(model.device))
    return RenderedView(outputs["spectral"].cpu(), outputs["accumulation"][..., 0].cpu())


def write_view(folder: Path, name: str, view: RenderedView, dataset: PackedDataset, kind: CubeType) -> None:
    """Write a BIL cube of reflectance ``NAME.hdr`` and ``.raw``, and ``NAME_valid``, a band that is 1 where valid.

    A 16-bit cube holds reflectance times `REFLECTANCE_SCALE`, as its header says. Each pair of files appears whole or
    not at all.

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
    cube = view.spectral.numpy()
    if kind == "uint16":
        cube = pack(cube)
        header |= {"reflectance scale factor": REFLECTANCE_SCALE, "data ignore value": FLAGGED}
    write_cube(folder / f"{name}.hdr", cube, wavelengths_nm=wavelengths_nm, extra_header=header)
    about = {"description": f"1 where the opacity of {name} is above {MIN_OPACITY}", "band names": ["valid"]}
    valid = view.valid.numpy().astype(np.uint8)[..., None]
    write_cube(folder / f"{name}_valid.hdr", valid, wavelengths_nm=None, extra_header=about)
