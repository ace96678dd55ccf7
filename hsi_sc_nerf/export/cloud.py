"""Spectral point clouds, whole or in chunks: outliers and normals, what a file says of itself, and PLY files.

Units and attributes in files are those of the CF conventions 1.11. In a PLY file (Turk 1994) the first element,
``vertex``, holds ``x y z nx ny nz`` (float, metres), ``red green blue`` (uchar), one float a band named by its
wavelength (``scalar_397.32nm``; CloudCompare shows properties that begin with ``scalar_`` as scalar fields), and the
extra columns. Comments state the frame, the run, and the unit and meaning of each column. A million points of 204
bands take 843 MB.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.lib.recfunctions import structured_to_unstructured
from scipy.spatial import cKDTree

from hsi_sc_nerf import __version__
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.geometry.ply_file import NO_SCALE, is_metric, read_ply

CHUNK_POINTS = 1 << 15
"""Points of a chunk: 27 MB at 204 bands."""
INCIDENCE = "incidence_deg"
"""Column: the angle between a point's normal and the ray that gave its spectrum."""
LIGHT_COLUMNS = ("irradiance", "irradiance_std")
"""Columns of the light on a point, which `hsi-sc-nerf material` adds."""
GLOSS = "gloss"
"""Column: what a glossy skin mirrors, which `hsi-sc-nerf material` takes off."""
MAX_INCIDENCE_DEG = 70.0
"""At larger angles of incidence a pixel also covers what lies beside the surface (docs/how-to/traits.md)."""
OUTLIER_NEIGHBOURS = 20
"""Neighbours whose mean distance marks an outlier (released settings of the paper)."""
FRAME = (
    "object frame: z points up along the turntable's axis, 0 on the disc; x points from the axis to the camera of "
    "the first frame"
)
REFLECTANCE = ("1", "reflectance factor relative to the white reference in full light")
MATERIAL = ("1", "reflectance factor of the material: as measured without gloss, over the irradiance in the band")
NORMALS = ("nx", "ny", "nz")
COLOURS = ("red", "green", "blue")
COLUMNS: dict[str, tuple[str, str]] = {
    **dict.fromkeys("xyz", ("m", "position in the object frame")),
    **dict.fromkeys(NORMALS, ("1", "outward unit normal")),
    **dict.fromkeys(COLOURS, ("1", "pseudo-RGB of the spectrum, 0 to 255")),
    "opacity": ("1", "opacity that the point's ray collects, 0 to 1"),
    "incidence_deg": ("degree", "angle between the normal and the ray that gave the spectrum"),
    "views": ("1", "number of training frames that see the point"),
    "spectral_std": ("1", "standard deviation of the reflectance measured in these frames, mean over bands"),
    "saturated": ("1", "fraction of these frames in which the pixel is saturated or without data"),
    "sampled_views": ("1", "number of training views that were averaged"),
    "sampled_std": ("1", "standard deviation of the reflectance over these views, mean over bands"),
    "irradiance": ("1", "irradiance relative to that on the white reference, mean over bands"),
    "irradiance_std": ("1", "standard deviation of the irradiance; relative to it, that of the material"),
    "gloss": ("1", "what the skin mirrors, as reflectance, mean over bands"),
}
"""CF unit and meaning of each column that this package writes, the bands' apart."""
UNSCALED = dict.fromkeys("xyz", ("1", "position in the object frame, in distances of the camera from the axis"))
"""Those of columns that have others where nothing gave the scale."""
_GEOMETRY = (*"xyz", *NORMALS)
_MEASURED = {*COLUMNS} - {*_GEOMETRY, *COLOURS}
_BAND_NAME = re.compile(r"scalar_(\d+(?:\.\d+)?)nm")
_MATERIAL_NAME = re.compile(r"material_\d+(?:\.\d+)?nm")


@dataclass(frozen=True)
class SpectralCloud:
    """Points with their spectra."""

    points: Float[np.ndarray, "n 3"]  # metres, where `metric`
    normals: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    spectra: Float[np.ndarray, "n bands"]  # reflectance
    wavelengths_nm: Float[np.ndarray, "bands"]
    extra: dict[str, Float[np.ndarray, "n"]] = field(default_factory=dict)
    metric: bool = True  # whether lengths are metres; else nothing gave the scale

    def __post_init__(self) -> None:
        columns = (self.points, self.normals, self.colours, self.spectra, *self.extra.values())
        lengths = {len(column) for column in columns}
        if len(lengths) != 1 or self.spectra.shape[1] != len(self.wavelengths_nm):
            raise ValueError(f"the columns of a cloud do not fit together: {[column.shape for column in columns]}")

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: np.ndarray | slice) -> SpectralCloud:
        """The points that a slice, an index or a boolean array selects."""
        own = {name: getattr(self, name)[rows] for name in ("points", "normals", "colours", "spectra")}
        return replace(self, **own, extra={name: column[rows] for name, column in self.extra.items()})

    def with_ascending_bands(self) -> SpectralCloud:
        """The same cloud; cameras and other programs have bands in any order."""
        order = np.argsort(self.wavelengths_nm)
        return replace(self, spectra=self.spectra[:, order], wavelengths_nm=self.wavelengths_nm[order])


@dataclass(frozen=True)
class CloudStream:
    """A cloud in chunks, so that a writer does not hold all spectra at once.

    Attributes:
        count: points of all chunks together.
        wavelengths_nm: band centres.
        extra_names: the chunks' extra columns, in order.
        chunks: the chunks, which are iterated over once.
        run: name of the run that made the cloud, which files state.
        metric: whether lengths are metres, which files state as well.
    """

    count: int
    wavelengths_nm: Float[np.ndarray, "bands"]
    extra_names: tuple[str, ...]
    chunks: Iterable[SpectralCloud]
    run: str = ""
    metric: bool = True


def stream(cloud: SpectralCloud, chunk_points: int = CHUNK_POINTS) -> CloudStream:
    """A cloud in memory as a stream of views of it."""
    chunks = (cloud.select(slice(start, start + chunk_points)) for start in range(0, len(cloud), chunk_points))
    return CloudStream(len(cloud), cloud.wavelengths_nm, tuple(cloud.extra), chunks, metric=cloud.metric)


def oblique_note(cloud: SpectralCloud, name: str) -> str:
    """That spectra count at whatever angle they were seen, as the cloud does not tell it; empty where it does.

    Args:
        cloud: the cloud.
        name: what it is called in the sentence.
    """
    if {INCIDENCE, "sampled_views"} & set(cloud.extra):  # `sample` chooses its views by the angle
        return ""
    return (
        f"{name} has no {INCIDENCE}, so that spectra seen obliquely count too; if CloudCompare saved it, open the "
        "original there again with Add all."
    )


def statistical_inliers(points: Float[np.ndarray, "n 3"], std_ratio: float) -> Int[np.ndarray, "inliers"]:
    """Indices of the points whose mean distance to their neighbours is usual for the cloud.

    All points of a cloud with no more than ``OUTLIER_NEIGHBOURS`` points are inliers.

    Args:
        std_ratio: standard deviations above the cloud's mean from which a point is an outlier, above 0.
    """
    if len(points) <= OUTLIER_NEIGHBOURS:
        return np.arange(len(points))
    distances = cKDTree(points).query(points, OUTLIER_NEIGHBOURS, workers=-1)[0].mean(axis=1)
    return np.flatnonzero(distances <= distances.mean() + std_ratio * distances.std(ddof=1))


def estimate_normals(
    points: Float[np.ndarray, "n 3"], orientation: Float[np.ndarray, "n 3"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Unit normals from neighbouring points, on the side of the vectors in ``orientation``, by default on either."""
    from open3d.geometry import PointCloud  # heavy
    from open3d.utility import Vector3dVector

    cloud = PointCloud(Vector3dVector(np.asarray(points, np.float64)))
    cloud.estimate_normals()
    normals = np.asarray(cloud.normals)
    if orientation is None:
        return normals
    return np.where((normals * orientation).sum(axis=1, keepdims=True) < 0, -normals, normals)


def run_name(load_config: Path) -> str:
    """EXPERIMENT/METHOD/TIME of a run, as nerfstudio names its folder; where it lies is nobody else's business."""
    return "/".join(load_config.resolve().parent.parts[-3:])


def cloud_attributes(run: str = "", metric: bool = True) -> dict[str, str]:
    """Global attributes of a file; ``run`` is the name of the run, where one made the cloud.

    Where lengths are not ``metric``, the attribute ``scale`` says what they are.
    """
    attributes = {
        "title": "spectral point cloud",
        "source": f"hsi-sc-nerf {__version__}",
        "references": "https://arxiv.org/abs/2602.16950",
        "comment": FRAME,
    }
    return attributes | ({"run": run} if run else {}) | ({} if metric else {"scale": NO_SCALE})


def comment_lines(columns: Iterable[str], run: str = "", metric: bool = True) -> list[str]:
    """Attributes and the meaning of the columns as lines of text, in ASCII: ``x y z [m]: position ...``.

    Args:
        columns: names of the columns; those that have no stated meaning are left out.
        run: name of the run.
        metric: whether lengths are metres.

    Example:
        >>> comment_lines(["views"])[-1]
        'views [1]: number of training frames that see the point'
    """
    lines = [f"{name}: {value}" for name, value in cloud_attributes(run, metric).items()]
    lines.append("bands [{}]: {}, one column a band, named by its centre in nm".format(*REFLECTANCE))
    columns, meanings = tuple(columns), COLUMNS | ({} if metric else UNSCALED)
    if any(name.startswith("material_") for name in columns):
        lines.append("material_ [{}]: {}".format(*MATERIAL))
    alike: dict[tuple[str, str], list[str]] = {}
    for name in columns:
        if name in meanings:
            alike.setdefault(meanings[name], []).append(name)
    lines += [f"{' '.join(names)} [{unit}]: {meaning}" for (unit, meaning), names in alike.items()]
    return [" ".join(line.encode("ascii", "backslashreplace").decode().split()) for line in lines]


def write_spectral_ply(
    path: Path | str, cloud: SpectralCloud | CloudStream, triangles: Int[np.ndarray, "t 3"] | None = None
) -> None:
    """Write a spectral point cloud, or a mesh with spectra at its vertices, whole or not at all.

    A stream is written chunk by chunk; plyfile would need all points at once.

    Args:
        triangles: indices of three points each, counter-clockwise seen from outside.

    Raises:
        InputError: the file cannot be written, for instance because the disk is full.
        ValueError: the arrays' shapes do not fit together, two wavelengths are equal, or the name of an extra column
            is taken or has several words.

    Example:
        >>> cloud = read_spectral_ply("point_cloud.ply")
        >>> write_spectral_ply("copy.ply", cloud)
    """
    if isinstance(cloud, SpectralCloud):
        cloud = stream(cloud)
    band_names = band_property_names(cloud.wavelengths_nm)
    names = [*_GEOMETRY, *COLOURS, *band_names, *cloud.extra_names]
    if len(set(names)) != len(names) or any(len(name.split()) != 1 for name in cloud.extra_names):
        raise ValueError(f"extra columns need one-word names that are not taken: {list(cloud.extra_names)}")
    properties = (f"property {'uchar' if name in COLOURS else 'float'} {name}" for name in names)
    comments = (f"comment {line}" for line in comment_lines(names, cloud.run, cloud.metric))
    header = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {cloud.count}", *properties]
    faces = np.empty(0 if triangles is None else len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    if triangles is not None:
        faces["count"], faces["corners"] = 3, triangles
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    layout = np.dtype(
        [
            ("points", "<f4", 3),
            ("normals", "<f4", 3),
            ("colours", "u1", 3),
            ("spectra", "<f4", len(band_names)),
            ("extra", "<f4", len(cloud.extra_names)),
        ]
    )
    with atomic_write(Path(path)) as (temporary,), temporary.open("wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        for chunk in cloud.chunks:
            rows = np.empty(len(chunk), layout)
            rows["points"], rows["normals"], rows["colours"] = chunk.points, chunk.normals, chunk.colours
            rows["spectra"] = chunk.spectra
            for index, values in enumerate(chunk.extra.values()):
                rows["extra"][:, index] = values
            rows.tofile(file)
        faces.tofile(file)


def band_property_names(wavelengths_nm: Float[np.ndarray, "bands"], kind: str = "scalar") -> list[str]:
    """``scalar_397.32nm`` a band: two decimals, or as many as it takes to distinguish all bands.

    Args:
        kind: ``scalar`` for reflectance as measured, ``material`` for that of the material.

    Raises:
        ValueError: two wavelengths are equal.
    """
    wavelengths = [float(wavelength) for wavelength in wavelengths_nm]
    for decimals in range(2, 16):
        names = [f"{kind}_{wavelength:.{decimals}f}nm" for wavelength in wavelengths]
        if len(set(names)) == len(names):
            return names
    raise ValueError("two bands have the same wavelength")


def material_spectra(cloud: SpectralCloud) -> Float[np.ndarray, "n bands"] | None:
    """Reflectance of the material, from the columns that `hsi-sc-nerf material` adds; None without all of them."""
    names = material_names(cloud.wavelengths_nm, cloud.extra)
    return np.stack([cloud.extra[name] for name in names], axis=1) if names else None


def material_names(wavelengths_nm: Float[np.ndarray, "bands"], extra_names: Iterable[str]) -> list[str]:
    """Names of the columns that hold the material's reflectance, one a band; none if any is missing."""
    names = band_property_names(wavelengths_nm, "material")
    return names if set(names) <= set(extra_names) else []


def own_name(name: str) -> str:
    """The name by which this package wrote a column; CloudCompare saves ``views`` as ``scalar_views``."""
    short = name.removeprefix("scalar_")
    return short if short in _MEASURED or _MATERIAL_NAME.fullmatch(short) else name


def is_of_a_run(name: str) -> bool:
    """Whether a PLY file's property holds what a run measured; positions, normals and colours may be a scanner's."""
    name = own_name(name)
    return name in _MEASURED or any(pattern.fullmatch(name) for pattern in (_BAND_NAME, _MATERIAL_NAME))


def read_spectral_ply(path: Path | str) -> SpectralCloud:
    """Read a cloud of `write_spectral_ply`, its properties in any order and as CloudCompare names them; bands ascend.

    Raises:
        InputError: the file is missing, is no readable PLY, or lacks positions, normals, colours or spectral bands.

    Example:
        >>> cloud = read_spectral_ply("point_cloud.ply")
        >>> len(cloud.wavelengths_nm)
        204
    """
    path = Path(path)
    content = read_ply(path)
    vertices = content["vertex"].data
    names = vertices.dtype.names
    found = {name: float(match[1]) for name in names if (match := _BAND_NAME.fullmatch(name))}
    bands = {name: found[name] for name in sorted(found, key=found.__getitem__)}
    missing = [name for name in (*_GEOMETRY, *COLOURS) if name not in names]
    if missing or not bands:
        lacking = ", ".join(missing) or "spectral bands (scalar_...nm)"
        raise InputError(f"{path}: has no {lacking}; give a cloud that ns-export wrote from an hsi-sc-nerf run.")

    def columns(group: tuple[str, ...], dtype: type) -> np.ndarray:
        # A copy, in one pass: where it can, NumPy gives a view of the file.
        return np.array(structured_to_unstructured(vertices[list(group)], dtype))

    return SpectralCloud(
        points=columns(tuple("xyz"), np.float32),
        normals=columns(NORMALS, np.float32),
        colours=columns(COLOURS, np.uint8),
        spectra=columns(tuple(bands), np.float32),
        wavelengths_nm=np.array(list(bands.values())),
        extra={
            own_name(name): np.array(vertices[name], np.float32)
            for name in names
            if name not in bands and name not in (*_GEOMETRY, *COLOURS)
        },
        metric=is_metric(content),
    )
