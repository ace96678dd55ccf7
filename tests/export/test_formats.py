import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_cloud import BAND_NAMES, WAVELENGTHS_NM, random_cloud

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import CloudStream, stream
from hsi_sc_nerf.export.formats import format_of, require_format, write_cloud

COUNT = 50


def test_las_holds_everything_as_extra_bytes(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    written = random_cloud(COUNT)
    path = write_cloud(tmp_path / "cloud", replace(stream(written, 7), run="pear/hsi-sc-nerf/now"), "las")
    read = laspy.read(path)
    assert path.name == "cloud.las"
    (text,) = (vlr.record_data.decode().splitlines() for vlr in read.header.vlrs if vlr.record_id == 3)
    assert "run: pear/hsi-sc-nerf/now" in text
    for described in ("x y z [m]: ", "nx ny nz [1]: ", "views [1]: "):
        assert any(line.startswith(described) for line in text)
    assert not any("0 to 255" in line for line in text)
    assert read.header.generating_software.startswith("hsi-sc-nerf")
    np.testing.assert_allclose(read.xyz, written.points, atol=1e-6)
    assert set(read.return_number) == set(read.number_of_returns) == {1}
    assert read.header.number_of_points_by_return[0] == COUNT
    assert read.header.global_encoding.wkt
    np.testing.assert_array_equal(np.stack([read.red, read.green, read.blue], 1) // 257, written.colours)
    for band, name in enumerate(BAND_NAMES):
        np.testing.assert_array_equal(read[name], written.spectra[:, band])
    np.testing.assert_array_equal(read["NormalY"], written.normals[:, 1])
    np.testing.assert_array_equal(read["views"], np.arange(COUNT))
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.las"]


def test_las_refuses_more_bands_than_it_holds(tmp_path: Path) -> None:
    pytest.importorskip("laspy")
    write_cloud(tmp_path / "fits", stream(random_cloud(2, np.linspace(400.0, 1000.0, 336))), "las")
    with pytest.raises(InputError, match=r"cloud\.las: .* 336 bands.* 337.*--bands"):
        require_format(tmp_path / "cloud", "las", 337, 2)
    require_format(tmp_path / "cloud", "las", 166, 166 + 6)
    with pytest.raises(InputError, match=r"166 bands.* 167 .*material.*--bands"):
        require_format(tmp_path / "cloud", "las", 167, 167 + 6)


@pytest.mark.parametrize(("file_format", "package"), [("las", "laspy"), ("netcdf", "h5netcdf"), ("zarr", "zarr")])
def test_a_missing_package_is_one_sentence(tmp_path: Path, monkeypatch, file_format, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"needs the package {package}.*pip install 'hsi-sc-nerf\[formats\]'"):
        write_cloud(tmp_path / "cloud", stream(random_cloud()), file_format)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("file_format", ["ply", "las", "netcdf", "zarr"])
def test_what_breaks_off_leaves_what_was_there(tmp_path: Path, file_format) -> None:
    before = write_cloud(tmp_path / "cloud", stream(random_cloud(COUNT)), file_format)
    size = sum(file.stat().st_size for file in tmp_path.rglob("*"))

    def breaking_off():
        yield random_cloud(20)
        raise RuntimeError("broken off")

    with pytest.raises(RuntimeError, match="broken off"):
        write_cloud(
            tmp_path / "cloud", CloudStream(40, WAVELENGTHS_NM, ("opacity", "views"), breaking_off()), file_format
        )
    assert list(tmp_path.iterdir()) == [before]
    assert sum(file.stat().st_size for file in tmp_path.rglob("*")) == size


@pytest.mark.slow
@pytest.mark.parametrize("room_bytes", [0, 5000])
@pytest.mark.parametrize("file_format", ["ply", "las", "netcdf", "zarr"])
def test_a_full_disk_is_one_sentence_and_leaves_what_was_there(tmp_path, file_format, room_bytes, limit_of_files):
    before = write_cloud(tmp_path / "cloud", stream(random_cloud(COUNT)), file_format)
    size = sum(file.stat().st_size for file in tmp_path.rglob("*"))
    told = r"cannot be written \(.*\); free some space"
    with limit_of_files(room_bytes), pytest.raises(InputError, match=told):
        write_cloud(tmp_path / "cloud", stream(random_cloud(9000)), file_format)
    assert list(tmp_path.iterdir()) == [before]
    assert sum(file.stat().st_size for file in tmp_path.rglob("*")) == size


@pytest.mark.parametrize("name", ["R550/R670", "reflectance", "wavelength"])
@pytest.mark.parametrize("file_format", ["netcdf", "zarr"])
def test_tables_refuse_a_column_that_would_not_come_back(tmp_path: Path, file_format, name: str) -> None:
    pytest.importorskip({"netcdf": "h5netcdf", "zarr": "zarr"}[file_format])
    with pytest.raises(InputError, match=rf"cloud\..* cannot hold a column named {name};"):
        write_cloud(tmp_path / "cloud", stream(random_cloud(extra={name: np.ones(50)})), file_format)
    assert not list(tmp_path.iterdir())


def test_zarr_replaces_nothing_that_is_not_its_own(tmp_path: Path) -> None:
    pytest.importorskip("zarr")
    (tmp_path / "cloud.zarr").mkdir()
    (tmp_path / "cloud.zarr" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"cloud\.zarr: is not a Zarr folder"):
        write_cloud(tmp_path / "cloud", stream(random_cloud()), "zarr")
    assert (tmp_path / "cloud.zarr" / "notes.txt").read_text() == "mine"


def test_the_name_of_a_file_tells_its_format() -> None:
    expected = {"a.ply": "ply", "b.LAS": "las", "c.d.nc": "netcdf", "e.zarr": "zarr"}
    assert {name: format_of(Path(name)) for name in expected} == expected
    with pytest.raises(InputError):
        format_of(Path("cloud.csv"))
