"""A trained run as a notebook has it: its cloud, spectra at points, views, and the light on the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.api.clouds import Cloud
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import SpectralCloud, run_name
from hsi_sc_nerf.export.cloud_material import require_bands_of_run, with_material
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.export.sample_points import PointSpectra, sample_points
from hsi_sc_nerf.export.spectral_export import render_cloud
from hsi_sc_nerf.geometry.camera import unit_vectors
from hsi_sc_nerf.indices.catalogue import find_indices
from hsi_sc_nerf.indices.formula import index_values
from hsi_sc_nerf.light.known_light import read_light
from hsi_sc_nerf.light.of_run import light_of_run
from hsi_sc_nerf.models import trained_run
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.rendering.views import (
    CubeType,
    RenderedView,
    cameras_at,
    render_view,
    views_of_frames,
    write_view,
)

_TO_CAMERA = np.array([0.0, 0.0, 1.0])
_CONFIGS = ("config.yml", "training/hsi-sc-nerf/run/config.yml")
"""Where a run's settings lie in its folder, and in that of `hsi-sc-nerf run`."""


@dataclass(frozen=True, eq=False)
class View:
    """A rendered view: a cube of reflectance.

    Attributes:
        name: name of its files.
        rendered: what the model shows.
        dataset: dataset of the run.
    """

    name: str
    rendered: RenderedView
    dataset: PackedDataset

    def __repr__(self) -> str:
        lines, samples, bands = self.rendered.spectral.shape
        return f"<View {self.name}: {lines} lines, {samples} samples, {bands} bands>"

    @property
    def reflectance(self) -> Float[np.ndarray, "lines samples bands"]:
        """The cube; before the background, transparent pixels include its reflectance."""
        return self.rendered.spectral.numpy()

    @property
    def valid(self) -> Bool[np.ndarray, "lines samples"]:
        """Pixels that show the object or what turns with it."""
        return self.rendered.valid.numpy()

    def index(self, word: str) -> Float[np.ndarray, "lines samples"]:
        """An index of each pixel, by its name or as a formula; NaN on the background.

        Raises:
            InputError: it is neither, or a wavelength has no band near it.
        """
        nm = self.dataset.wavelengths_nm
        (index,) = find_indices([word], nm)
        return np.where(self.valid, index_values(index, self.reflectance.astype(float), nm), np.nan)

    def save(self, folder: Path | str, kind: CubeType = "float32") -> Path:
        """Write the ENVI cubes ``NAME`` and ``NAME_valid``, as `hsi-sc-nerf render` does, and return the header.

        SPy and PlantCV read them.

        Raises:
            InputError: the files cannot be written.
        """
        write_view(Path(folder), self.name, self.rendered, self.dataset, kind)
        return Path(folder) / f"{self.name}.hdr"


@dataclass(frozen=True, eq=False)
class Run:
    """A trained run.

    Attributes:
        trained: its model and data.
        name: that files state.
    """

    trained: trained_run.TrainedRun
    name: str

    def __repr__(self) -> str:
        return f"<Run {self.name} on {self.dataset}>"

    @property
    def dataset(self) -> PackedDataset:
        """That it was trained on."""
        return self.trained.dataset

    @property
    def wavelengths_nm(self) -> Float[np.ndarray, "bands"]:
        """Band centres."""
        return self.trained.model.wavelengths_nm

    def point_cloud(self, num_points: int = 100_000, **options: Any) -> Cloud:
        """The cloud that `hsi-sc-nerf export` writes, in memory: metres, object frame.

        Args:
            num_points: spread evenly over the surface.
            options: those of `CloudOptions`, such as ``bands=("600-700",)`` or ``keep_turntable=True``.

        Raises:
            InputError: the model holds no object, or an option cannot be met.
        """
        found = render_cloud(self.trained, CloudOptions(num_points=num_points, **options), self.name)
        chunks = list(found.chunks)
        points, normals, colours, spectra = (
            np.concatenate([getattr(chunk, name) for chunk in chunks])
            for name in ("points", "normals", "colours", "spectra")
        )
        extra = {name: np.concatenate([chunk.extra[name] for chunk in chunks]) for name in found.extra_names}
        return Cloud(points, normals, colours, spectra, found.wavelengths_nm, extra, found.metric)

    def spectra_at(
        self,
        points_m: Float[np.ndarray, "n 3"] | Sequence[Sequence[float]],
        normals: Float[np.ndarray, "n 3"] | None = None,
        max_distance_m: float = 0.003,
        views: int = 4,
    ) -> PointSpectra:
        """Spectra of points, as `hsi-sc-nerf sample` finds them: the mean over the training cameras that see them.

        Args:
            points_m: object frame.
            normals: normals of any length, to either side. Default: those of the density around each point.
            max_distance_m: largest distance of a point from the model's surface; points further away get NaN.
            views: cameras to average over, at most.

        Raises:
            InputError: the points are not finite numbers in threes.
        """
        points_m = np.asarray(points_m, float)
        if points_m.ndim != 2 or points_m.shape[1] != 3 or not np.isfinite(points_m).all():
            raise InputError("spectra_at takes points as rows of x, y, z in metres, all finite; correct them.")
        directions = None if normals is None else unit_vectors(np.asarray(normals, float))
        return sample_points(self.trained, points_m, directions, max_distance_m, views)

    def render(self, frame: str | None = None, angle_deg: float = 0.0, size: float = 1.0) -> View:
        """Render a view as a cube: a frame of the session, or the object turned before the session's camera.

        Args:
            frame: name of the frame's capture. Default: none of them, but the view at ``angle_deg``.
            angle_deg: the object's turn from the first frame, counter-clockwise seen from above.
            size: factor on the size of the image, of a view at an angle.

        Raises:
            InputError: the session has no such frame, the angle is not finite, or the size leaves no pixel.
        """
        model = self.trained.model
        if frame is None:
            camera = cameras_at(self.trained, np.array([angle_deg]), size)
            return View(f"angle_{angle_deg:g}", render_view(model, camera), self.dataset)
        splits: tuple[Literal["held-out", "training"], ...] = ("held-out", "training")
        for views in (views_of_frames(self.trained, split) for split in splits):
            for name, camera in views:
                if name == frame:
                    return View(name, render_view(model, camera), self.dataset)
        names = ", ".join(one.capture for one in self.dataset.frames)
        raise InputError(f"the session has no frame {frame}; it has {names}.")

    def with_material(
        self, cloud: SpectralCloud, correct: bool | None = None, light: Path | str | None = None
    ) -> Cloud:
        """The cloud with the material's reflectance and the irradiance, as `hsi-sc-nerf material` finds them.

        Args:
            cloud: cloud of this run.
            correct: whether the light is taken out. Default: where shading is found beyond noise. The white reference
                is taken to face the camera.
            light: NAME-material.json of another object in the same chamber, whose light is taken.

        Raises:
            InputError: the cloud or the light has other bands, or the light cannot be told.
        """
        require_bands_of_run(cloud, self.wavelengths_nm, "the cloud")  # before the work
        known = None if light is None else read_light(Path(light))
        found = light_of_run(self.trained, _TO_CAMERA, known)
        corrected = found.evidence.shaded if correct is None else correct
        return Cloud.of(with_material(cloud, found, self.wavelengths_nm, corrected=corrected))


def open_run(folder: Path | str) -> Run:
    """Open a trained run: its folder, its ``config.yml``, or the folder of `hsi-sc-nerf run`.

    Raises:
        InputError: there is no run, it is none of this version of hsi-sc-nerf, or it has no checkpoint.

    Example:
        >>> run = open_run("OUT")
        >>> cloud = run.point_cloud(num_points=50_000)
        >>> run.spectra_at(cloud.points[:10]).spectra.shape
        (10, 204)
        >>> run.render(angle_deg=90.0).save("views")
        PosixPath('views/angle_90.hdr')
    """
    folder = Path(folder)
    found = [folder / name for name in _CONFIGS if (folder / name).is_file()] if folder.is_dir() else [folder]
    if not found:
        below = sorted(folder.rglob("config.yml"))
        give = below[-1].parent if below else "the folder of a trained run"
        raise InputError(f"{folder}: holds no config.yml; give {give}.")
    return Run(trained_run.open_trained_run(found[0]), run_name(found[0]))
