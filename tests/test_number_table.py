"""Tables of numbers as programs in several languages export them."""

import numpy as np
import pytest

from hsi_sc_nerf.analysis.calibrations import read_calibration
from hsi_sc_nerf.analysis.library import read_library
from hsi_sc_nerf.calibration.white_source import read_panel
from hsi_sc_nerf.capture.session_info import read_band_centres
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.number_table import number_in, numbers_in, read_number_table
from hsi_sc_nerf.simulate.materials import read_spectrum

NM, SLOPES = [450.0, 453.5, 457.0], [0.013, -0.021, np.nan]
EXPORTS = {
    "plain": "# unit: %\nwavelength_nm,coefficient\n450,0.013\n453.5,-0.021\n457,NA\n",
    "German Excel": "# unit: %;\nwavelength_nm;coefficient\r\n450;0,013\r\n453,5;-0,021\r\n457;\r\n;\r\n",
    "tabs": "# unit: %\nWavelength (nm)\tCoefficient\n4,5e2\t0,013\n453,5\t-0,021\n457\t\n",
    "quoted titles": '"# unit: %",\n"Wavelength [nm]","Coefficient (-)"\n"450,0","0,013"\n"453,5","-0,021"\n457,\n',
    "trailing separators": "# unit: %;;;\nWavelength/nm;Coefficient;;\n450;0.013;;\n453.5;-0.021;;\n457;;;\n;;;\n",
    "micrometres": "# unit: %\nwavelength (µm);coefficient\n0,45;0,013\n0,4535;-0,021\n0,457;\n",
    "minus sign": "# unit: %\nwavelength_nm;coefficient\n450;0,013\n453,5;\N{MINUS SIGN}0,021\n457;\n",
}


def write(folder, text, encoding="utf-8", name="own.csv"):
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize("text", EXPORTS.values(), ids=EXPORTS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_exports_hold_the_same_numbers(tmp_path, text, encoding):
    if encoding == "cp1252":
        text = text.replace("\N{MINUS SIGN}", "-")
    path = write(tmp_path, "# intercept: 14,2\n" + text, encoding)
    columns = read_number_table(path).by_title()
    np.testing.assert_allclose(columns["wavelength_nm"], NM)
    np.testing.assert_allclose(columns["coefficient"], SLOPES)
    calibration = read_calibration(path)
    assert calibration.unit == "%"
    found = calibration.of(np.array([[0.5, 0.25, 9.0]]), calibration.wavelengths_nm)
    np.testing.assert_allclose(found, [14.2 + 0.0065 - 0.00525])


def test_heads_of_a_calibration_that_a_spreadsheet_saved(tmp_path):
    """Commas may have become semicolons, a value a cell of its own."""
    head = "# intercept:;14,2;;\n# preprocessing: absorbance; savgol 3 1 1\n"
    limits = "# t2_limit: 5,5\n# score_variances: 0,5; 2\n"
    titles = "wavelength_nm;coefficient;mean;weight_1;weight_2;loading_1;loading_2\n"
    rows = "".join(f"{nm};0,5;0,1;1;0;1;0\n" for nm in (450, 460, 470))
    calibration = read_calibration(write(tmp_path, head + limits + titles + rows))
    assert [name for name, _ in calibration.steps] == ["absorbance", "savgol"]
    assert calibration.predict(np.zeros((1, 3))).item() == 14.2
    assert calibration.domain.t2_limit == 5.5
    np.testing.assert_array_equal(calibration.domain.variances, [0.5, 2.0])


@pytest.mark.parametrize(
    "text",
    [
        "Wavelength (nm);B\nB0;14,2\n450;0,5\n460;\n",
        '"Wavelength [nm]","Regression Coefficients"\n"(Intercept)","14,2"\n"450,0","0,5"\n"460,0",\n',
        "wavelength\tcoefficients\nIntercept\t14.2\n450\t0.5\n460\tNA\n",
        "wavelength_nm,coefficient\n,14.2\n450,0.5\n460,\n",
    ],
)
def test_an_intercept_in_the_first_line_as_software_writes_it(tmp_path, text):
    calibration = read_calibration(write(tmp_path, text))
    found = calibration.of(np.array([[0.5, 9.0]]), calibration.wavelengths_nm)
    np.testing.assert_allclose(found, [14.2 + 0.25])


def test_other_tables_of_the_same_exports(tmp_path):
    text = '"Wellenlänge";"Schale; grün";Stiel\n450;0,1;0,4\n900;0,6;0,3\n'
    library = read_library(write(tmp_path, text, "cp1252"))
    assert library.names == ("Schale; grün", "Stiel")
    np.testing.assert_allclose(library.spectra, [[0.1, 0.6], [0.4, 0.3]])
    panel = read_panel(write(tmp_path, "nm\tR (%)\n400\t97,5\n1000\t98,5\n", "utf-16"), np.array([700.0]))
    np.testing.assert_allclose(panel, [0.98])
    for text in ("450,5;blau\n460;rot\n", "nm;Farbe\r\n450,5;blau\r\n460;rot\r\n", "450.5\n460\n"):
        np.testing.assert_allclose(read_band_centres(write(tmp_path, text, "utf-8-sig")), [450.5, 460.0])
    spectrum = read_spectrum(write(tmp_path, "Reflectance;Wavelength (nm)\n0,5;390\n0,6;1010\n"))
    assert spectrum.reflectance == (0.5, 0.6)


@pytest.mark.parametrize("title", ["", "nm\r\n", "Wellenlänge (nm)\r\n"])
def test_a_single_column_with_decimal_commas_is_not_cut(tmp_path, title):
    """As German Excel saves it: nothing tells the commas from those between columns."""
    with pytest.raises(InputError, match=r"own\.csv: .*decimal commas"):
        read_band_centres(write(tmp_path, title + "397,32\r\n400,20\r\n403,09\r\n"))
    quoted = write(tmp_path, title + '"397,32"\r\n"400,20"\r\n"403,09"\r\n')
    np.testing.assert_allclose(read_band_centres(quoted), [397.32, 400.20, 403.09])


@pytest.mark.parametrize(
    ("text", "centres_nm"),
    [
        ("wavelength_nm,fwhm,comment\n397.3,7\n400.2,7,first\n", [397.3, 400.2]),
        ("wavelength_nm,note\n397.3\n400.2,see a, b\n", [397.3, 400.2]),
        ("wavelength_nm,note\n397,\n400,see a, 2\n", [397.0, 400.0]),
        ("wavelength_nm,fwhm\n397,7.5\n400,7,5\n", [397.0, 400.0]),
        ("397.3,7,a\n400.2\n", [397.3, 400.2]),
        ("nm;Anmerkung\n397,3\n400,2;siehe a; b\n", [397.3, 400.2]),
    ],
)
def test_columns_beside_band_centres_hold_anything(tmp_path, text, centres_nm):
    np.testing.assert_array_equal(read_band_centres(write(tmp_path, text)), centres_nm)


@pytest.mark.parametrize("text", ["nm,note\n397,3\n400,2,b\n", "nm\n397\n400,2 nm\n", "397,3,a\n400,2,b\n"])
def test_digits_that_may_be_decimals_are_not_cut(tmp_path, text):
    with pytest.raises(InputError, match=r"own\.csv: .*decimal commas"):
        read_band_centres(write(tmp_path, text))


@pytest.mark.parametrize("text", ["nm,band\n400,1\n403,2\n", "400,1.5\n403,1.5\n", "400;1\n403;2\n", "400\n403\n"])
def test_columns_beside_whole_band_centres(tmp_path, text):
    np.testing.assert_array_equal(read_band_centres(write(tmp_path, text)), [400.0, 403.0])


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"nm,R\n400,0,9\n", "line 2 has 3 and not 2; between numbers with decimal commas"),
        (b"nm;R\n400;1.234,5\n", r"line 2: '1\.234,5' is not a number"),
        (b"nm;R\n400;1,234,5\n", "line 2: '1,234,5' is not a number"),
        (b'nm,R\n400,"0.9\n', "quotation marks"),
        (b"\xff\xfe\x00", "no text"),
        (b"PK\x03\x04\0\0\0\n1,2\n", "no text"),
    ],
)
def test_what_is_no_table_of_numbers(tmp_path, content, why):
    path = tmp_path / "own.csv"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=why):
        read_number_table(path)


def test_lists_of_numbers():
    assert numbers_in("0.5, 2,1e-3,") == [0.5, 2.0, 0.001]
    assert numbers_in("0,5; 2") == [0.5, 2.0]
    assert numbers_in("") == []
    assert np.isnan(number_in(" NA "))
