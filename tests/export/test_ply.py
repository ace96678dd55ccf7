from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import SpectralCloud, stream
from hsi_sc_nerf.export.ply import band_property_names, read_spectral_ply, write_spectral_ply
from hsi_sc_nerf.meshes.mesh import ply_triangles

WAVELENGTHS = np.array([397.32, 400.2, 650.0, 1003.58])


def cloud(count: int = 50, **changes: object) -> SpectralCloud:
    random = np.random.default_rng(0)
    normals = random.normal(size=(count, 3))
    arrays = {
        "points": random.normal(0, 0.05, (count, 3)).astype(np.float32),
        "normals": (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        "colours": random.integers(0, 256, (count, 3), dtype=np.uint8),
        "spectra": random.random((count, 4), dtype=np.float32),
        "wavelengths_nm": WAVELENGTHS,
    }
    return SpectralCloud(**arrays | changes)


def header(path: Path) -> list[str]:
    return path.read_bytes().split(b"end_header\n")[0].decode().splitlines()


@pytest.mark.parametrize("chunk", [7, 50, 1000])
def test_round_trip(tmp_path: Path, chunk: int) -> None:
    extra = {"opacity": np.linspace(0, 1, 50, dtype=np.float32), "views": np.arange(50)}
    written, path = cloud(extra=extra), tmp_path / "cloud.ply"
    write_spectral_ply(path, stream(written, chunk))
    read = read_spectral_ply(path)
    np.testing.assert_array_equal(read.points, written.points)
    np.testing.assert_array_equal(read.normals, written.normals)
    np.testing.assert_array_equal(read.colours, written.colours)
    np.testing.assert_array_equal(read.spectra, written.spectra)
    np.testing.assert_array_equal(read.wavelengths_nm, WAVELENGTHS)
    assert list(read.extra) == ["opacity", "views"]
    np.testing.assert_array_equal(read.extra["opacity"], extra["opacity"])
    np.testing.assert_array_equal(read.extra["views"], extra["views"])
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.ply"]


def test_the_header_is_what_cloudcompare_expects(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    write_spectral_ply(path, cloud())
    assert header(path) == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 50",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        *(f"property float scalar_{name}nm" for name in ("397.32", "400.20", "650.00", "1003.58")),
    ]
    assert path.stat().st_size == len("\n".join(header(path))) + len("\nend_header\n") + 50 * (6 * 4 + 3 + 4 * 4)


def test_open3d_reads_it(tmp_path: Path) -> None:
    import open3d

    written, path = cloud(), tmp_path / "cloud.ply"
    write_spectral_ply(path, written)
    legacy = open3d.io.read_point_cloud(str(path))
    np.testing.assert_allclose(np.asarray(legacy.points), written.points)
    np.testing.assert_allclose(np.asarray(legacy.normals), written.normals)
    np.testing.assert_allclose(np.asarray(legacy.colors) * 255, written.colours)
    tensor = open3d.t.io.read_point_cloud(str(path))
    np.testing.assert_array_equal(tensor.point["scalar_650.00nm"].numpy()[:, 0], written.spectra[:, 2])


def test_an_open3d_copy_with_its_properties_reordered_reads_back(tmp_path: Path) -> None:
    import open3d

    written, path, copy = cloud(), tmp_path / "cloud.ply", tmp_path / "copy.ply"
    write_spectral_ply(path, written)
    open3d.t.io.write_point_cloud(str(copy), open3d.t.io.read_point_cloud(str(path)))
    read = read_spectral_ply(copy)
    order = np.argsort(read.wavelengths_nm)
    np.testing.assert_array_equal(read.wavelengths_nm[order], WAVELENGTHS)
    np.testing.assert_array_equal(read.spectra[:, order], written.spectra)
    np.testing.assert_array_equal(read.points, written.points)


def test_bands_closer_than_two_decimals_get_more(tmp_path: Path) -> None:
    wavelengths = np.array([500.001, 500.004, 500.0041, 600.0])
    assert band_property_names(wavelengths[[0, 3]]) == ["scalar_500.00nm", "scalar_600.00nm"]
    assert band_property_names(wavelengths)[2] == "scalar_500.0041nm"
    write_spectral_ply(tmp_path / "cloud.ply", cloud(wavelengths_nm=wavelengths))
    np.testing.assert_allclose(read_spectral_ply(tmp_path / "cloud.ply").wavelengths_nm, wavelengths, atol=1e-9)
    with pytest.raises(ValueError, match="same wavelength"):
        band_property_names(np.array([500.0, 500.0]))


def test_no_points(tmp_path: Path) -> None:
    write_spectral_ply(tmp_path / "cloud.ply", cloud(0))
    assert read_spectral_ply(tmp_path / "cloud.ply").spectra.shape == (0, 4)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_leaves_the_earlier_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"earlier file")
    opened = Path.open
    monkeypatch.setattr(Path, "open", lambda self, mode="r": opened(Path("/dev/full"), mode))
    with pytest.raises(InputError, match=r"cloud\.ply.*cannot be written.*No space left"):
        write_spectral_ply(path, cloud(5000))
    monkeypatch.undo()
    assert path.read_bytes() == b"earlier file"
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.ply"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"normals": np.zeros((49, 3))}, "normals"),
        ({"spectra": np.zeros((50, 3))}, "spectra"),
        ({"colours": np.zeros((50, 4), np.uint8)}, "colours"),
        ({"extra": {"opacity": np.zeros(49)}}, "opacity"),
        ({"extra": {"red": np.zeros(50)}}, "taken"),
        ({"extra": {"two words": np.zeros(50)}}, "one-word"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_spectral_ply(tmp_path / "cloud.ply", cloud(**change))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda content: content[:-1], "early end-of-file"),
        (lambda content: b"PK" + content, "no readable PLY"),
        (lambda content: content.replace(b"binary_little_endian", b"ascii"), "no readable PLY"),
        (lambda content: content.replace(b"float nz", b"float curvature"), "no nz"),
        (lambda content: content.replace(b"scalar_", b"band_"), "spectral bands"),
        (lambda content: content.replace(b"float nx", b"list uchar int nx"), "no readable PLY"),
        (lambda content: content.split(b"end_header")[0], "no readable PLY"),
        (lambda content: b"", "no readable PLY"),
    ],
)
def test_bad_files_are_refused_in_one_sentence(tmp_path: Path, spoil, message: str) -> None:
    path = tmp_path / "cloud.ply"
    write_spectral_ply(path, cloud())
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(InputError, match=message) as caught:
        read_spectral_ply(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_spectral_ply(tmp_path / "none.ply")


def test_a_mesh_keeps_its_triangles_and_its_spectra(tmp_path: Path) -> None:
    triangles = np.array([[0, 1, 2], [3, 2, 1]])
    write_spectral_ply(tmp_path / "mesh.ply", cloud(4), triangles)
    np.testing.assert_array_equal(ply_triangles(PlyData.read(str(tmp_path / "mesh.ply"))), triangles)
    np.testing.assert_array_equal(read_spectral_ply(tmp_path / "mesh.ply").spectra, cloud(4).spectra)
