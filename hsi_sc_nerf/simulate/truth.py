"""The truth of a simulated session: writing and reading it (layout in docs/reference/files.md)."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from plyfile import PlyData, PlyElement

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.comparison import read_surface
from hsi_sc_nerf.files import read_json
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.geometry.ply_file import ply_vertices
from hsi_sc_nerf.simulate.assemble import MarkerLayout, marker_layout
from hsi_sc_nerf.simulate.frames import SimulatedFrame, Simulation
from hsi_sc_nerf.simulate.light import Light
from hsi_sc_nerf.simulate.render import Part

DETECTOR = "detector.npz"
COVERED = 0.5
"""Fraction of a pixel that the object covers, from which on the pixel is the object's."""


@dataclass(frozen=True)
class Truth:
    """The truth of a simulated session; pixel data are read on demand."""

    session_dir: Path
    object: str
    intrinsics: PinholeIntrinsics
    captures: tuple[str, ...]
    angles_deg: Float[np.ndarray, "n"]
    camera_to_world: Float[np.ndarray, "n 4 4"]
    """OpenGL axes, object frame, metres."""
    marker_layout: MarkerLayout
    """Four corners of each marker in OpenCV's order, metres, object frame."""
    wavelengths_nm: Float[np.ndarray, "bands"]
    materials: tuple[str, ...]
    endmembers: Float[np.ndarray, "materials bands"]
    """Reflectance of each material."""
    area_m2: float
    volume_m3: float
    effects: dict[str, dict[str, Any]]
    """Settings of each effect of the session, by name."""
    distortion: tuple[float, float, float, float]
    """k1, k2, p1, p2 of OpenCV's model; 0 for a pinhole camera."""

    @property
    def mesh_path(self) -> Path:
        """PLY file of the object, object frame, metres."""
        return self.session_dir / "truth" / "mesh.ply"

    def mesh(self) -> Mesh:
        """The object's mesh, object frame, metres."""
        return Mesh(*read_surface(self.mesh_path))

    def material_weights(self, capture: str) -> Float[np.ndarray, "lines samples materials"]:
        """Fraction of each material in each pixel, summing to 1."""
        return self._pixels(capture, "material_weights", (len(self.materials),)).astype(np.float32)

    def object_coverage(self, capture: str) -> Float[np.ndarray, "lines samples"]:
        """Fraction of each pixel that the object covers, in [0, 1]."""
        return self._pixels(capture, "object").astype(np.float32)

    def reflectance(self, capture: str) -> Float[np.ndarray, "lines samples bands"]:
        """Noise-free reflectance, float32, in [0, 1]."""
        return self.material_weights(capture) @ self.endmembers.astype(np.float32)

    def light(self, capture: str) -> Light:
        """Noise-free light on the sensor, rotated as the counts are; `Light.radiance` gives an image."""
        arrays = _read_arrays(pixels_path(self.session_dir, capture))
        factors = [name for name in arrays if name.startswith("illumination_")]
        weights = arrays.get("light_weights")
        return Light(
            weights=self.material_weights(capture) if weights is None else weights.astype(np.float32),
            spectra=arrays.get("light_spectra", self.endmembers),
            illumination=tuple(arrays[name] for name in sorted(factors)),
        )

    def detector_maps(self) -> dict[str, np.ndarray]:
        """Maps (samples, bands) of the detector by name: ``dark_offset`` (counts), ``dead`` and ``hot`` (boolean).

        Maps of effects that the scene does not name are missing.
        """
        path = self.session_dir / "truth" / DETECTOR
        return _read_arrays(path) if path.exists() else {}

    def _pixels(self, capture: str, key: str, each: tuple[int, ...] = ()) -> np.ndarray:
        """An image whose pixels have the shape ``each``."""
        path = pixels_path(self.session_dir, capture)
        image = _read_arrays(path, (key,)).get(key)
        if image is None:
            raise InputError(f"{path}: holds no {key}; simulate the session again.")
        if image.shape[2:] != each or image.ndim < 2:
            raise InputError(f"{path}: its {key} is not an image of the session; simulate the session again.")
        return image


def load_truth(session_dir: str | Path) -> Truth:
    """Read the truth of a simulated session.

    Raises:
        InputError: the folder holds no truth, or its truth cannot be read.

    Example:
        >>> truth = load_truth("pear-session")
        >>> truth.reflectance(truth.captures[0]).shape
        (128, 128, 204)
    """
    session_dir = Path(session_dir)
    path = session_dir / "truth" / "truth.json"
    if not path.is_file():
        raise InputError(f"{session_dir}: has no truth ({path.name} is missing); simulate the session.")
    values = read_json(path, "simulate the session again")
    try:
        with (session_dir / "truth" / "endmembers.csv").open(encoding="utf-8", newline="") as file:
            table = np.array(list(csv.reader(file))[1:], float)
        if table.shape != (len(values["wavelengths_nm"]), 1 + len(values["materials"])):
            raise ValueError("endmembers.csv is not of its bands and materials")
        return Truth(
            session_dir=session_dir,
            object=values["object"],
            intrinsics=PinholeIntrinsics(**values["intrinsics"]),
            captures=tuple(frame["capture"] for frame in values["frames"]),
            angles_deg=np.array([frame["angle_deg"] for frame in values["frames"]]),
            camera_to_world=np.array([frame["camera_to_world"] for frame in values["frames"]]),
            marker_layout={int(number): np.array(c) for number, c in values["marker_layout"].items()},
            wavelengths_nm=np.array(values["wavelengths_nm"]),
            materials=tuple(values["materials"]),
            endmembers=table[:, 1:].T,
            area_m2=values["mesh"]["area_m2"],
            volume_m3=values["mesh"]["volume_m3"],
            effects=values["effects"],
            distortion=tuple(values.get("distortion", (0.0,) * 4)),
        )
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: cannot be read ({error!r}); simulate the session again.") from error


def write_truth(session_dir: Path, simulation: Simulation) -> None:
    """Write the truth except the pixels, which `write_pixels` adds frame by frame."""
    scene, mesh = simulation.scene, simulation.object_part.mesh
    folder = session_dir / "truth"
    folder.mkdir(parents=True, exist_ok=True)
    frames = zip(
        simulation.captures, simulation.plan.angles_deg.tolist(), simulation.camera_to_world.tolist(), strict=True
    )
    wavelengths_nm, materials = simulation.wavelengths_nm, simulation.materials
    values = {
        "object": scene.name,
        "intrinsics": dataclasses.asdict(simulation.intrinsics),
        "frames": [{"capture": name, "angle_deg": angle, "camera_to_world": c2w} for name, angle, c2w in frames],
        "marker_layout": {str(number): c.tolist() for number, c in marker_layout(scene).items()},
        "wavelengths_nm": wavelengths_nm.tolist(),
        "materials": list(materials),
        "effects": {effect.name: dataclasses.asdict(effect) for effect in scene.effects},
        "container": dataclasses.asdict(scene.container),
        "mesh": {"area_m2": mesh.area_m2(), "volume_m3": mesh.volume_m3()},
    }
    if simulation.lens is not None:
        values["distortion"] = simulation.lens.coefficients()
    (folder / "truth.json").write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    with (folder / "endmembers.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(["wavelength_nm", *materials])
        table.writerows(np.column_stack([wavelengths_nm, simulation.endmembers.T]).tolist())
    write_true_mesh(folder / "mesh.ply", simulation.object_part)
    each = simulation.detector_maps.values()
    maps: dict[str, Any] = {name: values for of_effect in each for name, values in of_effect.items()}
    if maps:
        np.savez_compressed(folder / DETECTOR, **maps)


def write_pixels(
    session_dir: Path, capture: str, frame: SimulatedFrame, endmembers: Float[np.ndarray, "materials bands"]
) -> None:
    """Write the pixels of one frame.

    Weights are multiples of 1 / 2048 and exact in float16. The light is written only if it differs from the product
    of material weights and endmembers.
    """
    path = pixels_path(session_dir, capture)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {
        "material_weights": frame.material_weights.astype(np.float16),
        "object": frame.coverage.astype(np.float16),
    }
    if frame.light.weights is not frame.material_weights:
        arrays["light_weights"] = frame.light.weights
    if not np.array_equal(frame.light.spectra, endmembers):
        arrays["light_spectra"] = frame.light.spectra
    arrays |= {f"illumination_{i}": factor for i, factor in enumerate(frame.light.illumination)}
    np.savez_compressed(path, **arrays)


def pixels_path(session_dir: Path, capture: str) -> Path:
    """Path of a frame's pixels."""
    return session_dir / "truth" / "pixels" / f"{capture}.npz"


def _read_arrays(path: Path, only: Collection[str] = ()) -> dict[str, np.ndarray]:
    """The arrays in an NPZ file by name, all or some.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with np.load(path) as arrays:
            found = {name: arrays[name] for name in arrays.files if not only or name in only}
        for name, array in found.items():
            # Of a member that is no array, NumPy gives the bytes.
            if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
                raise ValueError(f"{name} is not an array of numbers")
        return found
    except Exception as error:  # what readers of damaged archives raise has no common class
        raise InputError(f"{path}: cannot be read ({error}); simulate the session again.") from error


def write_true_mesh(path: Path, part: Part) -> None:
    """Write a part as binary PLY with one vertex property ``weight_NAME`` for each material."""
    columns = dict(zip("xyz", part.mesh.vertices.T, strict=True))
    columns |= {f"weight_{n}": w for n, w in zip(part.materials, part.weights.T.astype(np.float32), strict=True)}
    vertices = ply_vertices(columns)
    faces = np.zeros(len(part.mesh.triangles), [("vertex_indices", "<i4", (3,))])
    header = PlyData([vertices, PlyElement.describe(faces, "face")], byte_order="<").header
    # plyfile writes each list by itself, which is most of the time of a small session.
    rows = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", (3,))])
    rows["count"], rows["corners"] = 3, part.mesh.triangles
    path.write_bytes(header.encode("ascii") + b"\n" + vertices.data.tobytes() + rows.tobytes())
