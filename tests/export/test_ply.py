from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from random_cloud import BAND_NAMES, WAVELENGTHS_NM, assert_equal, random_cloud

from hsi_sc_nerf import __version__
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import (
    INCIDENCE,
    LIGHT_COLUMNS,
    band_property_names,
    material_spectra,
    read_spectral_ply,
    stream,
    write_spectral_ply,
)


@pytest.mark.parametrize(("count", "chunk"), [(50, 7), (50, 1000), (0, 7)])
def test_round_trip(tmp_path: Path, count: int, chunk: int) -> None:
    written, path = random_cloud(count), tmp_path / "cloud.ply"
    write_spectral_ply(path, stream(written, chunk))
    assert_equal(read_spectral_ply(path), written)
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.ply"]


def test_the_header_is_what_cloudcompare_expects(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    write_spectral_ply(path, random_cloud())
    header = path.read_bytes().split(b"end_header\n")[0].decode()
    lines = [line for line in header.splitlines() if not line.startswith("comment ")]
    assert lines == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 50",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        *(f"property float scalar_{name}" for name in BAND_NAMES),
        *(f"property float {name}" for name in ("opacity", "views")),
    ]
    assert path.stat().st_size == len(header) + len("end_header\n") + 50 * (6 * 4 + 3 + 6 * 4)


def test_comments_state_frame_run_and_the_unit_of_every_column(tmp_path: Path) -> None:
    path, given = tmp_path / "cloud.ply", stream(random_cloud())
    write_spectral_ply(path, replace(given, run="b\u00e4r/hsi-sc-nerf/now\nend_header"))
    comments = PlyData.read(str(path)).comments
    assert f"source: hsi-sc-nerf {__version__}" in comments
    assert "run: b\\xe4r/hsi-sc-nerf/now end_header" in comments
    assert any(line.startswith("comment: object frame: z points up") for line in comments)
    described = {name: line for line in comments for name in line.split(" [")[0].split()}
    for name in ("x", "nz", "blue", "opacity", "views", "bands"):
        assert " [m]: " in described[name] if name == "x" else " [1]: " in described[name]
    assert_equal(read_spectral_ply(path), random_cloud())
    write_spectral_ply(path, random_cloud(metric=False))
    comments = PlyData.read(str(path)).comments
    assert any(line.startswith("scale: unknown; lengths are in distances of the camera") for line in comments)
    assert any(line.startswith("x y z [1]: position") for line in comments)
    assert not any("[m]" in line for line in comments)
    assert not read_spectral_ply(path).select(slice(3)).metric


def test_open3d_reads_it_and_its_copy_reads_back(tmp_path: Path) -> None:
    import open3d

    written, path, copy = random_cloud(), tmp_path / "cloud.ply", tmp_path / "copy.ply"
    write_spectral_ply(path, written)
    legacy = open3d.io.read_point_cloud(str(path))
    np.testing.assert_allclose(np.asarray(legacy.points), written.points)
    np.testing.assert_allclose(np.asarray(legacy.normals), written.normals)
    np.testing.assert_allclose(np.asarray(legacy.colors) * 255, written.colours)
    tensor = open3d.t.io.read_point_cloud(str(path))
    np.testing.assert_array_equal(tensor.point["scalar_650.00nm"].numpy()[:, 0], written.spectra[:, 2])
    open3d.t.io.write_point_cloud(str(copy), tensor)  # in another order
    assert_equal(read_spectral_ply(copy), written)


def test_bands_ascend_whatever_the_order_of_the_columns(tmp_path: Path) -> None:
    """Open3D's copies have them in none, others may put them in order by name: 1003.58nm before 397.32nm."""
    written, path = random_cloud(), tmp_path / "cloud.ply"
    write_spectral_ply(path, written)
    rows = PlyData.read(str(path))["vertex"].data
    by_name = np.empty(len(rows), [(name, rows.dtype[name]) for name in sorted(rows.dtype.names)])
    for name in rows.dtype.names:
        by_name[name] = rows[name]
    PlyData([PlyElement.describe(by_name, "vertex")]).write(str(path))
    read = read_spectral_ply(path)
    np.testing.assert_array_equal(read.wavelengths_nm, written.wavelengths_nm)
    np.testing.assert_array_equal(read.spectra, written.spectra)


def test_a_copy_by_cloudcompare_keeps_material_and_incidence(tmp_path: Path) -> None:
    """It saves each scalar field as ``scalar_`` and its name."""
    columns = (INCIDENCE, *LIGHT_COLUMNS, *band_property_names(WAVELENGTHS_NM, "material"))
    extra = {name: np.full(50, number, np.float32) for number, name in enumerate(columns)}
    written, path = random_cloud(extra=extra), tmp_path / "cloud.ply"
    write_spectral_ply(path, replace(written, extra=extra | {"quality": np.ones(50, np.float32)}))
    content = path.read_bytes()
    for name in (*columns, "quality"):
        content = content.replace(f" {name}\n".encode(), f" scalar_{name}\n".encode())
    path.write_bytes(content)
    read = read_spectral_ply(path)
    assert set(read.extra) == {*columns, "scalar_quality"}
    np.testing.assert_array_equal(material_spectra(read), material_spectra(written))


@pytest.mark.slow
def test_pyvista_reads_what_it_knows_of(tmp_path: Path) -> None:
    """VTK's reader takes positions, normals and colours of a PLY file, and no other columns."""
    pyvista = pytest.importorskip("pyvista")
    written = random_cloud()
    write_spectral_ply(tmp_path / "cloud.ply", written)
    read = pyvista.read(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(read.points, written.points)
    np.testing.assert_array_equal(read.point_data["Normals"], written.normals)
    np.testing.assert_array_equal(read.point_data["RGB"], written.colours)


def test_bands_closer_than_two_decimals_get_more(tmp_path: Path) -> None:
    wavelengths = np.array([500.001, 500.004, 500.0041, 600.0])
    assert band_property_names(wavelengths[[0, 3]]) == ["scalar_500.00nm", "scalar_600.00nm"]
    assert band_property_names(wavelengths)[2] == "scalar_500.0041nm"
    written = random_cloud(wavelengths_nm=wavelengths)
    write_spectral_ply(tmp_path / "cloud.ply", written)
    assert_equal(read_spectral_ply(tmp_path / "cloud.ply"), written)
    with pytest.raises(ValueError, match="same wavelength"):
        band_property_names(np.array([500.0, 500.0]))


@pytest.mark.parametrize(
    "change",
    [
        {"normals": np.zeros((49, 3))},
        {"spectra": np.zeros((50, 3))},
        {"colours": np.zeros((50, 4), np.uint8)},
        {"extra": {"opacity": np.zeros(49)}},
        {"extra": {"red": np.zeros(50)}},
        {"extra": {"two words": np.zeros(50)}},
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path: Path, change: dict) -> None:
    with pytest.raises(ValueError):  # noqa: PT011
        write_spectral_ply(tmp_path / "cloud.ply", random_cloud(**change))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda content: content[:-1], "early end-of-file"),
        (lambda content: b"PK" + content, "cannot be read as a PLY"),
        (lambda content: content.replace(b"binary_little_endian", b"ascii"), "cannot be read as a PLY"),
        (lambda content: content.replace(b"float nz", b"float curvature"), "no nz"),
        (lambda content: content.replace(b"scalar_", b"band_"), "spectral bands"),
        (lambda content: content.replace(b"float nx", b"list uchar int nx"), "cannot be read as a PLY"),
        (lambda content: content.split(b"end_header")[0], "cannot be read as a PLY"),
        (lambda content: b"", "cannot be read as a PLY"),
        (None, "no such file"),
    ],
)
def test_bad_files_are_refused_in_one_sentence(tmp_path: Path, spoil, message: str) -> None:
    path = tmp_path / "cloud.ply"
    if spoil:
        write_spectral_ply(path, random_cloud())
        path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(InputError, match=message) as caught:
        read_spectral_ply(path)
    assert str(path) in str(caught.value)
