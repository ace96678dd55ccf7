import errno
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from spectral.io import envi as spy

from hsi_sc_nerf.capture.envi import open_cube, write_cube
from hsi_sc_nerf.capture.envi_header import read_header
from hsi_sc_nerf.errors import InputError

MAIZE = Path(__file__).parents[1] / "real_cubes" / "maize_kernel"
WAVELENGTHS_NM = np.array([450.25, 550.5, 650.75, 851.0])


def some_cube(dtype="uint16", shape=(3, 5, 4)) -> np.ndarray:
    return (np.arange(np.prod(shape)) % 251).reshape(shape).astype(dtype)


@pytest.fixture
def header(tmp_path) -> Path:
    path = tmp_path / "cube.hdr"
    write_cube(path, some_cube(), wavelengths_nm=WAVELENGTHS_NM)
    return path


def add(header: Path, *fields: str) -> None:
    header.write_text("\n".join([header.read_text(), *fields, ""]))


def edit(header: Path, old: str, new: str) -> None:
    text = header.read_text()
    assert old in text
    header.write_text(text.replace(old, new))


def test_spy_reads_what_we_write_and_the_map_loads_nothing(header):
    np.testing.assert_array_equal(np.asarray(spy.open(str(header)).load(dtype=np.uint16)), some_cube())
    assert isinstance(open_cube(header).memmap(), np.memmap)
    assert not open_cube(header).memmap().flags.writeable


def test_bands_that_are_bad_and_how_wide_they_are(header):
    add(header, "bbl = {1, 1.0, 0, 1,}", "fwhm = { 2, 2.5, 3, 3.5 }", "tint = 12.500000")
    cube = open_cube(header)
    assert cube.good_bands.tolist() == [True, True, False, True]
    assert cube.fwhm_nm.tolist() == [2.0, 2.5, 3.0, 3.5]
    assert cube.integration_time_ms == 12.5


@pytest.mark.parametrize("empty", ["", "tint = ", "tint = 0", "bbl = {}", "fwhm = { }", "data ignore value ="])
def test_empty_fields_are_missing_fields(header, empty):
    add(header, empty)
    cube = open_cube(header)
    assert cube.good_bands.all()
    assert (cube.fwhm_nm, cube.ignore_value, cube.integration_time_ms) == (None, None, None)


@pytest.mark.parametrize("listed", [None, "wavelength = {}", "wavelength units = Index\nwavelength = {1, 2, 3, 4}"])
def test_wavelengths_from_elsewhere(header, listed):
    text = header.read_text()
    header.write_text(text[: text.index("wavelength = {")] + (listed or ""))
    assert read_header(header).wavelengths_nm is None
    np.testing.assert_array_equal(open_cube(header, WAVELENGTHS_NM).wavelengths_nm, WAVELENGTHS_NM)
    with pytest.raises(InputError, match=r"cube\.hdr: gives no wavelengths; .*band_centres"):
        open_cube(header)
    with pytest.raises(InputError, match=r"3 band centres do not fit"):
        open_cube(header, WAVELENGTHS_NM[:3])


def test_of_two_data_files_the_one_that_fits(header):
    header.with_suffix("").write_bytes(b"a note")
    assert open_cube(header).data_path == header.with_suffix(".raw")


def test_a_letter_that_only_latin_1_has(header):
    header.write_bytes(header.read_text().replace("ENVI\n", "ENVI\nremark = Wei\xdfreferenz\n").encode("latin-1"))
    np.testing.assert_array_equal(open_cube(header).read(), some_cube())


@pytest.mark.parametrize("unit", ["Micrometers", "um", "\N{GREEK SMALL LETTER MU}m", "", "Unknown"])
def test_micrometres_become_nm(header, unit):
    edit(header, "wavelength units = nm", f"wavelength units = {unit}\nfwhm = {{0.002, 0.002, 0.002, 0.003}}")
    edit(header, " , ".join(map(str, WAVELENGTHS_NM)), ", ".join(map(str, WAVELENGTHS_NM / 1000.0)))
    cube = open_cube(header)
    np.testing.assert_allclose(cube.wavelengths_nm, WAVELENGTHS_NM)
    np.testing.assert_allclose(cube.fwhm_nm, [2.0, 2.0, 2.0, 3.0])


def test_header_without_data(header):
    header.with_suffix(".raw").unlink()
    with pytest.raises(InputError, match=r"cube\.hdr.*data file cube\.raw"):
        open_cube(header)


@pytest.mark.parametrize(
    ("change", "word"),
    [(lambda b: b[:-1], "fewer"), (lambda b: b + b"x", "more"), (lambda b: b"", "has 0 bytes, fewer than the 120")],
)
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
        ("450.25", "blue", "wavelength lists 'blue', which is not a number"),
        ("450.25", "-450.25", "negative"),
        ("interleave = bil", "interleave = bix", "not bil, bip or bsq"),
        ("lines = 3\n", "", "does not give lines"),
        ("bands = 4", "bands = 3", "lists 4 numbers for 3 bands"),
        ("lines = 3", "lines = three", "lines is 'three'"),
        ("lines = 3", "lines = 0", "not a spectral image"),
        ("header offset = 0", "header offset = -8", "not a spectral image"),
        ("header offset = 0", "header offset = 0\nmajor frame offsets = {0, 4}", "major frame offsets"),
        ("header offset = 0", "header offset = 0\nminor frame offsets = 2", "minor frame offsets"),
        ("header offset = 0", "header offset = 0\nfile compression = 1", "file compression"),
        ("header offset = 0", "header offset = 0\nreflectance scale factor = 0", "scale factor 0 is not positive"),
        ("header offset = 0", "header offset = 0\nreflectance scale factor = many", "not a number"),
        (
            "header offset = 0",
            "header offset = 0\ndata ignore value = none",
            "data ignore value is 'none', which is not a number",
        ),
        ("header offset = 0", "header offset = 0\ntint = 10 ms", "tint is '10 ms', which is not a number; write"),
        ("header offset = 0", "header offset = 0\nbbl = {1, 1, 0}", "bbl lists 3 numbers for 4 bands"),
        ("header offset = 0", "header offset = 0\nfwhm = {1, 1, 2, 2, 2}", "fwhm lists 5 numbers for 4 bands"),
        ("header offset = 0", "header offset = 0\nfwhm = {1, 1, 2, nan}", "fwhm .* not finite"),
        ("}", "", "not a readable ENVI header"),
        ("byte order = 0", "byte order = 2", "byte order 2"),
        ("file type = ENVI Standard", "file type = ENVI Spectral Library", "spectral library"),
        ("units = nm", "units = Wavenumber", "wavenumber, not as wavelengths"),
        ("units = nm", "units = Micrometers", "not those of an imaging spectrometer"),
        ("450.25", "0.45", "not those of an imaging spectrometer"),
        ("data type = 12", "data type = 77", "data type is '77'"),
        ("data type = 12", "data type = 6", "complex numbers"),
        ("data type = 12\n", "data type =\n", "does not give data type"),
        ("ENVI\n", "ENVY\n", "not a readable ENVI header"),
    ],
)
def test_headers_that_cannot_be_used(header, old, new, message):
    edit(header, old, new)
    with pytest.raises(InputError, match=rf"cube\.hdr.*{message}"):
        open_cube(header)


@pytest.mark.parametrize("content", [b"", b"\n\n", b"\x00\x01\xff" * 50, b"ENVI\x00\x00", bytes(range(256)) * 9])
def test_a_header_that_is_none(header, content):
    header.write_bytes(content)
    with pytest.raises(InputError, match=r"cube\.hdr: is not a readable ENVI header"):
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
    monkeypatch.setattr(spy, "write_envi_header", fill_the_disk)
    with pytest.raises(InputError, match=r"cube\.raw: .*\(No space left on device\)"):
        write_cube(header, some_cube() + 1, wavelengths_nm=WAVELENGTHS_NM)
    assert sorted(header.parent.iterdir()) == before
    np.testing.assert_array_equal(open_cube(header).read(), some_cube())


def test_one_wavelength_a_band(tmp_path):
    with pytest.raises(ValueError, match="4 wavelengths for 3 bands"):
        write_cube(tmp_path / "c.hdr", some_cube(shape=(2, 2, 3)), wavelengths_nm=WAVELENGTHS_NM)


@pytest.mark.parametrize("bands", ["4294967296", "9" * 14, "9" * 5000])
def test_a_header_that_claims_more_than_there_can_be_takes_no_memory(header, bands):
    edit(header, "bands = 4", f"bands = {bands}")
    header.write_text(header.read_text().split("wavelength")[0])
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"cube\.hdr"):
            open_cube(header)
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()
