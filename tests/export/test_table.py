from dataclasses import replace

import numpy as np
import pytest
from random_cloud import BAND_NAMES, assert_equal, random_cloud

from hsi_sc_nerf.api.clouds import read_cloud
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import stream
from hsi_sc_nerf.export.formats import write_cloud
from hsi_sc_nerf.export.table import from_xarray, to_xarray

xarray = pytest.importorskip("xarray")


def full_cloud():
    """A cloud with the columns of views, material and light."""
    names = ["views", "spectral_std", "irradiance", "irradiance_std", *(f"material_{name}" for name in BAND_NAMES)]
    columns = np.random.default_rng(0).random((len(names), 50), dtype=np.float32)
    return random_cloud(extra=dict(zip(names, columns, strict=True)))


@pytest.mark.slow
@pytest.mark.parametrize("metric", [True, False])
@pytest.mark.parametrize(("file_format", "engine"), [("netcdf", "h5netcdf"), ("zarr", "zarr")])
def test_a_table_in_memory_is_that_of_the_exported_file_and_comes_back_from_its_own(
    tmp_path, file_format, engine, metric
):
    pytest.importorskip(engine)
    cloud = replace(full_cloud(), metric=metric)
    table = to_xarray(cloud, "pear/hsi-sc-nerf/now")
    for _ in range(2):  # the second replaces the first
        exported = write_cloud(tmp_path / "cloud", replace(stream(cloud, 7), run="pear/hsi-sc-nerf/now"), file_format)
    assert list(tmp_path.iterdir()) == [exported]
    table.to_netcdf(tmp_path / "own.nc", engine="h5netcdf")
    options = {"backend_kwargs": {"consolidated": False}} if engine == "zarr" else {}
    for path, opened in ((exported, {"engine": engine} | options), (tmp_path / "own.nc", {"engine": "h5netcdf"})):
        with xarray.open_dataset(path, **opened) as read:
            xarray.testing.assert_identical(read.load(), table)
            assert_equal(from_xarray(read), cloud)


@pytest.mark.parametrize("metric", [True, False])
def test_names_units_and_attributes_are_those_of_cf(metric):
    cloud = replace(full_cloud(), metric=metric)
    table = to_xarray(cloud, "pear/hsi-sc-nerf/now")
    assert table.attrs["Conventions"].startswith("CF-")
    assert table.attrs["run"] == "pear/hsi-sc-nerf/now"
    assert table.attrs["comment"].startswith("object frame")
    assert ("scale" in table.attrs) != metric
    assert all(table[name].long_name for name in table.variables)
    assert set(table.coords) == {"wavelength", "x", "y", "z"}
    assert (table.wavelength.units, table.wavelength.standard_name) == ("nm", "radiation_wavelength")
    np.testing.assert_array_equal(table.reflectance.sel(wavelength=640.0, method="nearest"), cloud.spectra[:, 2])
    assert {table[name].units for name in "xyz"} == {"m" if metric else "1"}
    assert {table[name].units for name in ("reflectance", "material", "irradiance", "spectral_std")} == {"1"}
    assert table.reflectance.ancillary_variables == "spectral_std"
    assert table.irradiance.ancillary_variables == "irradiance_std"
    assert "ancillary_variables" not in to_xarray(random_cloud()).reflectance.attrs
    assert not any("grid_mapping" in table[name].attrs for name in table.variables)


@pytest.mark.parametrize("file_format", [None, "netcdf", "zarr"])
def test_wavelengths_ascend_whatever_the_order_of_the_camera_s_bands(tmp_path, file_format):
    ordered = full_cloud()
    turned = replace(
        ordered, wavelengths_nm=ordered.wavelengths_nm[[1, 3, 0, 2]], spectra=ordered.spectra[:, [1, 3, 0, 2]]
    )
    expected = to_xarray(ordered)
    if file_format is None:
        xarray.testing.assert_identical(to_xarray(turned), expected)
    else:
        pytest.importorskip({"netcdf": "h5netcdf"}.get(file_format, file_format))
        assert_equal(read_cloud(write_cloud(tmp_path / "cloud", stream(turned, 7), file_format)), ordered)
    table = to_xarray(turned)
    np.testing.assert_array_equal(table.material.sel(wavelength=640.0, method="nearest"), expected.material[:, 2])


def test_a_table_of_something_else_is_refused():
    table = to_xarray(random_cloud())
    with pytest.raises(InputError, match=r"has no nx;"):
        from_xarray(table.drop_vars("nx"))
    with pytest.raises(InputError, match=r"reflectance \(point, wavelength\)"):
        from_xarray(table.transpose())


def test_columns_of_points_are_numbers_or_truth():
    table = to_xarray(random_cloud())
    table["good"] = ("point", np.arange(50) % 2 == 0)
    np.testing.assert_array_equal(from_xarray(table).extra["good"], table["good"])
    for texts in (np.array(["stem", "body"] * 25), np.array(["stem", "body"] * 25, object)):
        table["organ"] = ("point", texts)
        with pytest.raises(InputError, match="organ holds no numbers"):
            from_xarray(table)
