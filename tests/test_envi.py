from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from spectral.io import envi as spy

from hsi_sc_nerf.data.envi import open_cube, write_cube
from hsi_sc_nerf.errors import InputError

MAIZE = Path(__file__).parent / "data" / "maize_kernel"
WAVELENGTHS_NM = np.array([450.25, 550.5, 650.75, 851.0])
DTYPES = ["uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"]


def some_cube(dtype="uint16", shape=(3, 5, 4)) -> np.ndarray:
    return (np.arange(np.prod(shape)) % 251).reshape(shape).astype(dtype)


@pytest.fixture
def header(tmp_path) -> Path:
    path = tmp_path / "cube.hdr"
    write_cube(path, some_cube(), wavelengths_nm=WAVELENGTHS_NM)
    return path


def edit(header: Path, old: str, new: str) -> None:
    text = header.read_text()
    assert old in text
    header.write_text(text.replace(old, new))


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["bil", "bip", "bsq"]),
    st.sampled_from(DTYPES),
    st.sampled_from(["little", "big"]),
    st.sampled_from([".raw", ".dat", ".img", ".bip", ""]),
    st.tuples(st.integers(1, 4), st.integers(1, 4), st.integers(1, 4)),
)
def test_round_trip(tmp_path_factory, interleave, dtype, byte_order, suffix, shape):
    path = tmp_path_factory.mktemp("cube") / "a.b.hdr"
    cube = some_cube(dtype, shape)
    wavelengths = 400.0 + np.arange(shape[2])
    write_cube(
        path, cube, wavelengths_nm=wavelengths, interleave=interleave, data_suffix=suffix, byte_order=byte_order
    )
    opened = open_cube(path)
    assert opened.shape == shape
    assert opened.interleave == interleave
    assert opened.read().dtype == np.dtype(dtype)
    np.testing.assert_array_equal(opened.read(), cube)
    np.testing.assert_array_equal(opened.memmap(), cube)
    np.testing.assert_array_equal(opened.wavelengths_nm, wavelengths)
    assert sorted(p.name for p in path.parent.iterdir()) == sorted([path.name, f"a.b{suffix}"])


def test_spy_reads_what_we_write_and_the_map_loads_nothing(header):
    np.testing.assert_array_equal(np.asarray(spy.open(str(header)).load(dtype=np.uint16)), some_cube())
    assert isinstance(open_cube(header).memmap(), np.memmap)
    assert not open_cube(header).memmap().flags.writeable


def test_reflectance_scale(tmp_path):
    path = tmp_path / "r.hdr"
    write_cube(path, some_cube(), wavelengths_nm=WAVELENGTHS_NM, extra_header={"reflectance scale factor": 200})
    np.testing.assert_allclose(open_cube(path).reflectance(), some_cube() / 200.0, rtol=1e-6)


def test_header_offset_comment_and_case(header):
    data = header.with_suffix(".raw")
    data.write_bytes(b"12345678" + data.read_bytes())
    edit(header, "header offset = 0", "; a comment = 3\nHeader Offset = 8")
    edit(header, "interleave = bil", "interleave = BIL")
    np.testing.assert_array_equal(open_cube(header).read(), some_cube())


def test_missing_byte_order_is_little_endian(header):
    edit(header, "byte order = 0\n", "")
    np.testing.assert_array_equal(open_cube(header).read(), some_cube())


@pytest.mark.parametrize("unit", ["micrometers", "um", "µm", "", "Unknown"])
def test_micrometres_become_nm(header, unit):
    edit(header, "wavelength units = nm", f"wavelength units = {unit}")
    listed = ", ".join(str(w / 1000.0) for w in WAVELENGTHS_NM)
    text = header.read_text()
    header.write_text(text[: text.index("wavelength = {")] + f"wavelength = {{{listed}}}\n")
    np.testing.assert_allclose(open_cube(header).wavelengths_nm, WAVELENGTHS_NM)


def test_real_maize_kernel_opens():
    cube = open_cube(MAIZE / "4-22-22_right_same_B73_top_00.hdr")
    assert cube.shape == (31, 43, 580)
    assert cube.wavelengths_nm[[0, -1]].tolist() == [366.551, 1048.421]
    assert cube.dtype == np.dtype("<u2")
    stored = np.fromfile(cube.data_path, "<u2").reshape(31, 580, 43)
    np.testing.assert_array_equal(cube.memmap()[7, 11], stored[7, :, 11])


def test_header_without_data(header):
    header.with_suffix(".raw").unlink()
    with pytest.raises(InputError, match=r"cube\.hdr.*data file cube\.raw"):
        open_cube(header)


@pytest.mark.parametrize(("change", "word"), [(lambda b: b[:-1], "fewer"), (lambda b: b + b"x", "more")])
def test_data_of_another_length(header, change, word):
    data = header.with_suffix(".raw")
    data.write_bytes(change(data.read_bytes()))
    with pytest.raises(InputError, match=rf"cube\.raw.*{word}.*cube\.hdr"):
        open_cube(header)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("wavelength = {", "not wavelength = {", "no wavelengths"),
        ("wavelength = { 450.25 ,", "wavelength = {", "wavelength lists 3 numbers for 4 bands"),
        ("450.25", "blue", "what is not a number"),
        ("450.25", "-450.25", "negative"),
        ("interleave = bil", "interleave = bix", "none of bil, bip, bsq"),
        ("lines = 3\n", "", "does not give lines"),
        ("lines = 3", "lines = three", "cannot be read"),
        ("lines = 3", "lines = 0", "no spectral image"),
        ("data type = 12", "data type = 77", "cannot be read"),
        ("data type = 12", "data type = 6", "no spectral image"),
        ("ENVI\n", "ENVY\n", "no readable ENVI header"),
    ],
)
def test_headers_that_cannot_be_used(header, old, new, message):
    edit(header, old, new)
    with pytest.raises(InputError, match=rf"cube\.hdr.*{message}"):
        open_cube(header)


def test_no_header(tmp_path):
    with pytest.raises(InputError, match="no such ENVI header"):
        open_cube(tmp_path / "absent.hdr")


def test_full_disk_leaves_the_old_cube(header, monkeypatch):
    def fill_the_disk(temporary_header, *_, **__):
        Path(temporary_header).write_text("ENVI\n")
        Path(temporary_header).with_suffix(".raw").write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    before = sorted(header.parent.iterdir())
    monkeypatch.setattr(spy, "save_image", fill_the_disk)
    with pytest.raises(InputError, match=r"cube\.raw: cannot be written \(No space left on device\)"):
        write_cube(header, some_cube() + 1, wavelengths_nm=WAVELENGTHS_NM)
    assert sorted(header.parent.iterdir()) == before
    np.testing.assert_array_equal(open_cube(header).read(), some_cube())


def test_one_wavelength_a_band(tmp_path):
    with pytest.raises(ValueError, match="4 wavelengths for 3 bands"):
        write_cube(tmp_path / "c.hdr", some_cube(shape=(2, 2, 3)), wavelengths_nm=WAVELENGTHS_NM)
