"""Libraries of reference spectra: CSV tables and what is found as ENVI libraries."""

import numpy as np
import pytest
from spectral.io import envi

from hsi_sc_nerf.analysis.library import SpectralLibrary, read_library, write_library
from hsi_sc_nerf.errors import InputError

NM = np.linspace(400.0, 1000.0, 31)
SPECTRA = np.stack([np.linspace(0.1, 0.6, 31), np.linspace(0.4, 0.3, 31)])


def envi_library(folder, old="", new="", spectra=SPECTRA):
    """``library.sli`` and ``library.hdr`` as SPy writes them, one text of the header replaced."""
    header = {"wavelength": [f"{nm / 1000:.5f}" for nm in NM], "wavelength units": "Micrometers"}
    header |= {"spectra names": ["green", "brown"]}
    envi.SpectralLibrary(spectra.astype(np.float32), header).save(str(folder / "library"))
    text = (folder / "library.hdr").read_text()
    assert old in text
    (folder / "library.hdr").write_text(text.replace(old, new))
    return folder / "library.sli", folder / "library.hdr"


def test_library_from_csv(tmp_path):
    path = tmp_path / "library.csv"
    path.write_text("wavelength_um,green,brown\n0.4,0.1,0.4\n1.0,0.6,0.3\n")
    library = read_library(path)
    np.testing.assert_allclose(library.at(NM).spectra, SPECTRA, atol=1e-12)
    assert library.only(("brown",)).names == ("brown",)
    with pytest.raises(InputError, match=r"no moss; it has green, brown"):
        library.only(("moss",))
    with pytest.raises(InputError, match="covers the cloud"):
        library.at(np.array([390.0, 500.0]))
    with pytest.raises(InputError, match="one band"):
        library.at(np.array([500.0]))


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ("", "", ("green", "brown")),
        ("ENVI Spectral Library", "envi spectral library", ("green", "brown")),
        ("byte order = 0\n", "", ("green", "brown")),
        ("Micrometers", "Unknown", ("green", "brown")),
        ("spectra names", "other names", ("1", "2")),
    ],
)
def test_library_from_envi(tmp_path, old, new, names):
    for path in envi_library(tmp_path, old, new):
        read = read_library(path)
        assert read.names == names
        np.testing.assert_allclose(read.wavelengths_nm, NM, atol=0.01)
        np.testing.assert_allclose(read.spectra, SPECTRA, rtol=1e-6)


@pytest.mark.parametrize(
    ("data_name", "header_name"),
    [("A.SLI", "A.HDR"), ("a.sli", "a.sli.hdr"), ("a", "a.hdr"), ("s06.v18", "s06.v18.hdr"), ("A.sli", "A.HDR")],
)
def test_envi_libraries_have_names_of_many_kinds(tmp_path, data_name, header_name):
    for path, name in zip(envi_library(tmp_path), (data_name, header_name), strict=True):
        path.rename(tmp_path / name)
    for name in (data_name, header_name):
        np.testing.assert_allclose(read_library(tmp_path / name).spectra, SPECTRA, rtol=1e-6)


def test_scaled_numbers_are_reflectance_and_ignored_ones_none(tmp_path):
    numbers = np.where(NM == 500.0, -999.9, 1e4 * SPECTRA)
    header = "reflectance scale factor = 10000\ndata ignore value = -999.9"
    read = read_library(envi_library(tmp_path, "data ignore value = NaN", header, numbers)[0])
    np.testing.assert_allclose(read.spectra, np.where(NM == 500.0, np.nan, SPECTRA), rtol=1e-6)


def test_a_spectrum_is_refused_only_where_what_it_lacks_is_needed(tmp_path):
    """A deleted channel of the USGS library is no reflectance, but the others are."""
    numbers = np.stack([np.where(NM == 500.0, -1.23e34, SPECTRA[0]), SPECTRA[1]])
    table = tmp_path / "library.csv"
    rows = [f"{nm},{green},{brown}" for nm, green, brown in zip(NM, *numbers, strict=True)]
    table.write_text("\n".join(["nm,green,brown", *rows]))
    for path in (table, envi_library(tmp_path, spectra=numbers)[0]):
        library = read_library(path)
        for needed in (NM, np.array([450.0, 510.0])):
            with pytest.raises(InputError, match=r"no reflectance of green at 5\d0 nm; leave"):
                library.at(needed)
        np.testing.assert_allclose(library.at(NM[6:]).spectra, SPECTRA[:, 6:], rtol=1e-6)
        np.testing.assert_allclose(library.only(("brown",)).at(NM).spectra, SPECTRA[1:], rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("wavelength = ", "centres = ", "lists no wavelengths"),
        ("Micrometers", "Index", "lists no wavelengths"),
        ("data type = 4", "data type = 99", "data type is"),
        ("data type = 4", "data type = 6", "complex numbers"),
        ("ENVI Spectral Library", "ENVI Standard", "its file type is not a spectral library"),
        ("{ green , brown }", "{ green }", "holds 2 spectra and names 1"),
        ("lines = 2", "lines = 3", r"library\.sli: is smaller than its header"),
        ("lines = 2", "lines = 5000000000", r"library\.sli: is smaller than its header"),
        ("samples = ", "samples = 999999", "more than 100000 bands"),
    ],
)
def test_envi_libraries_that_cannot_be_used_are_refused(tmp_path, old, new, says):
    with pytest.raises(InputError, match=says):
        read_library(envi_library(tmp_path, old, new)[0])


@pytest.mark.parametrize(
    ("given", "files", "says"),
    [
        ("a.sli", {}, "no such file"),
        ("a.sli", {"a.sli": ""}, r"a\.hdr is missing"),
        ("a.sli", {"a.sli": "", "a.hdr": "no header"}, "not a readable ENVI header"),
        ("a.hdr", {"a.hdr": "no header"}, r"a\.sli is missing"),
        ("a.csv", {"a.csv": ""}, r"a\.csv"),
        ("a.csv", {"a.csv": "wavelength_nm\n400\n"}, r"a\.csv"),
        ("a.csv", {"a.csv": "nm,a\n400,x\n"}, r"a\.csv"),
        ("a.csv", {"a.csv": "nm,a\n400,0.1,0.2\n"}, r"a\.csv"),
        ("a.csv", {"a.csv": "nm,a\n400,nan\n"}, r"a\.csv"),
    ],
)
def test_missing_or_broken_libraries_are_refused(tmp_path, given, files, says):
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=says):
        read_library(tmp_path / given)


@pytest.mark.parametrize("name", ["library.sli", "library.csv"])
def test_what_is_written_is_read_here_and_by_spy(tmp_path, name):
    library = SpectralLibrary(("green", "brown"), NM, SPECTRA)
    write_library(tmp_path / name, library)
    read = read_library(tmp_path / name)
    assert read.names == library.names
    np.testing.assert_allclose(read.wavelengths_nm, NM)
    np.testing.assert_allclose(read.spectra, SPECTRA, rtol=1e-5)
    if name.endswith(".sli"):
        by_spy = envi.open(str(tmp_path / "library.hdr"))
        assert by_spy.names == ["green", "brown"]
        np.testing.assert_allclose(by_spy.bands.centers, NM)
        np.testing.assert_allclose(by_spy.spectra, SPECTRA, rtol=1e-6)


def test_names_that_a_header_cannot_hold_are_mended_and_other_endings_refused(tmp_path):
    library = SpectralLibrary(("a, {b}", "brown"), NM, SPECTRA)
    write_library(tmp_path / "library.sli", library)
    assert read_library(tmp_path / "library.sli").names == ("a_ _b_", "brown")
    with pytest.raises(InputError, match=r"library\.txt: .* \.sli or \.csv"):
        write_library(tmp_path / "library.txt", library)
