import os
import signal

import numpy as np
import pytest
from random_cloud import BAND_NAMES, assert_equal, random_cloud

import hsi_sc_nerf as hsn
from hsi_sc_nerf.api.clouds import Cloud, read_cloud
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export import trial_reading


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cloud.ply", "cloud.nc", "cloud.zarr"])
def test_a_saved_cloud_is_read_again(tmp_path, name):
    for package in ("xarray", "h5netcdf", "zarr"):
        pytest.importorskip(package)
    cloud = Cloud.of(random_cloud())
    assert cloud.save(tmp_path / name) == tmp_path / name
    assert_equal(hsn.read_cloud(str(tmp_path / name)), cloud)
    assert isinstance(read_cloud(tmp_path / name).select(slice(3)), Cloud)


def test_what_a_notebook_shows_of_a_cloud_is_one_line():
    columns = "points, normals, colours, spectra, opacity, views"
    shown = f"<Cloud of 1,500 points, 4 bands from 397.32 to 1003.58 nm; {columns}>"
    assert repr(Cloud.of(random_cloud(1500))) == shown


def test_indices_and_calibrations_are_of_the_material_where_it_is_known(tmp_path):
    table = tmp_path / "sugar.csv"
    table.write_text("# intercept: 2\nwavelength_nm,coefficient\n397.32,1\n525.1,10\n650,100\n")
    cloud = Cloud.of(random_cloud())
    of_material = 0.5 * cloud.spectra
    columns = dict(zip((f"material_{name}" for name in BAND_NAMES), of_material.T, strict=True))
    for spectra, one in ((cloud.spectra, cloud), (of_material, Cloud.of(random_cloud(extra=columns)))):
        spectra = spectra.astype(float)
        np.testing.assert_allclose(one.index("x = R650 - R400"), spectra[:, 2] - spectra[:, 1])
        half = spectra[:, 1:3].mean(axis=1)  # 525.1 nm lies between 400.2 and 650 nm
        expected = 2 + spectra[:, 0] + 10 * half + 100 * spectra[:, 2]
        np.testing.assert_allclose(one.calibration(str(table)), expected, rtol=1e-6)
    assert cloud.material is None


@pytest.mark.parametrize("name", ["cloud.las", "cloud.nc", "cloud.zarr", "cloud.ply", "cloud.txt"])
def test_what_is_no_cloud_is_one_sentence(tmp_path, name):
    pytest.importorskip("xarray")
    with pytest.raises(InputError, match=rf"{name}: "):
        read_cloud(tmp_path / name)
    (tmp_path / name).write_text("no cloud")
    with pytest.raises(InputError, match=rf"{name}: "):
        read_cloud(tmp_path / name)


def test_a_table_of_something_else_names_the_file(tmp_path):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    xarray.Dataset({"a": ("point", np.zeros(3))}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(InputError, match=r"other\.nc: the table has no reflectance"):
        read_cloud(tmp_path / "other.nc")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes with names")
def test_a_file_that_cannot_be_read_to_its_end_is_one_sentence(tmp_path, monkeypatch):
    """As some damaged ones; nothing ever writes to this pipe."""
    pytest.importorskip("h5netcdf")
    os.mkfifo(tmp_path / "cloud.nc")
    monkeypatch.setattr(trial_reading, "_STUCK_S", -4.8)
    with pytest.raises(InputError, match=r"cloud\.nc: [^\n]*no end"):
        read_cloud(tmp_path / "cloud.nc")


@pytest.mark.skipif(not hasattr(signal, "SIGXCPU"), reason="the system has no limit of processor time")
@pytest.mark.parametrize(
    ("does", "told"),
    [
        ("trial.limit_processor_time(int(sys.argv[2]))\nwhile True: pass", "no end"),
        ("trial.limit_memory(10**8)\nbytearray(10**10)", "cannot be read"),
    ],
)
def test_a_file_that_takes_all_of_the_processor_or_memory_is_one_sentence(tmp_path, monkeypatch, does, told):
    (tmp_path / "trial.py").write_text(f"import sys\nfrom hsi_sc_nerf.export import trial_reading as trial\n{does}\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(trial_reading, "__name__", "trial")
    monkeypatch.setattr(trial_reading, "_STARTS_S", 1.0)
    (tmp_path / "cloud.nc").write_bytes(b"")
    with pytest.raises(InputError, match=rf"cloud\.nc: [^\n]*{told}"):
        read_cloud(tmp_path / "cloud.nc")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cloud.nc", "cloud.zarr"])
def test_a_cloud_that_claims_more_than_its_file_can_hold_is_refused(tmp_path, name):
    path, shape, chunks = tmp_path / name, (10**10, 3), (1000, 3)
    if name == "cloud.zarr":
        group = pytest.importorskip("zarr").open_group(str(path), mode="w", zarr_format=3)
        group.create_array("reflectance", shape=shape, chunks=chunks, dtype="<f4", dimension_names=("point", "band"))
    else:
        with pytest.importorskip("h5netcdf").File(path, "w") as file:
            file.dimensions = {"point": shape[0], "band": shape[1]}
            file.create_variable("reflectance", ("point", "band"), "<f4", chunks=chunks)
    with pytest.raises(InputError, match=rf"{name}: [^\n]*claims 1200000000"):
        read_cloud(path)
