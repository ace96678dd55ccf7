import numpy as np
import pytest

from hsi_sc_nerf.calibration.white_source import read_panel
from hsi_sc_nerf.errors import InputError

BANDS_NM = np.array([400.0, 410.0, 455.0, 500.0])
LINES = {400: 0.9, 450: 0.95, 500: 0.97}
EXPECTED = [0.9, 0.91, 0.952, 0.97]


def write(folder, text, encoding="utf-8"):
    path = folder / "panel.csv"
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize(
    "text",
    [
        "wavelength_nm,reflectance\n400,0.9\n450,0.95\n500,0.97\n",
        "400,0.9\n450,0.95\n500,0.97",
        "# certificate 17\n\nnm\treflectance\r\n500\t97\r\n400\t90\r\n# middle\n450\t95\n",
        "400; 90,0\n450; 95,0\n500; 97,0\n",
        "wavelength (nm), reflectance (fraction)\n  450.0 , 0.95\n5e2,9.7e-1\n400,0.9\n\n",
        "reflectance;wavelength (µm)\n0,9;0,4\n0,95;0,45\n0,97;0,5\n",
    ],
    ids=["header", "plain", "percent, tabs, any order", "semicolons, decimal commas", "spaces", "other order, µm"],
)
def test_panel_between_its_lines(tmp_path, text):
    for encoding in ("utf-8", "utf-8-sig"):
        np.testing.assert_allclose(read_panel(write(tmp_path, text, encoding), BANDS_NM), EXPECTED, rtol=1e-12)


def test_panel_of_bands_in_any_order(tmp_path):
    path = write(tmp_path, "\n".join(f"{nm},{r}" for nm, r in LINES.items()))
    np.testing.assert_allclose(read_panel(path, BANDS_NM[::-1]), EXPECTED[::-1], rtol=1e-12)


def test_panel_may_end_one_band_short(tmp_path):
    path = write(tmp_path, "409,0.8\n456,0.9\n")
    np.testing.assert_allclose(read_panel(path, BANDS_NM)[[0, 3]], [0.8, 0.9])
    for text, short in (
        ("411,0.8\n500,0.9\n", "411 to 500"),
        ("400,0.8\n454,0.9", "400 to 454"),
        ("450,0.9", "450 to"),
    ):
        with pytest.raises(
            InputError, match=rf"panel\.csv: .*from {short}.* nm, but the bands lie from 400 to 500 nm"
        ):
            read_panel(write(tmp_path, text), BANDS_NM)
    np.testing.assert_allclose(read_panel(write(tmp_path, "450,0.9"), np.array([450.0])), [0.9])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "holds no reflectance; write two columns"),
        ("wavelength_nm,reflectance\n", "holds no reflectance"),
        ("nm,names\nagain,names\n400,0.9", "line 2: 'again' is not a number.*; write two columns"),
        ("400,0.9\n500,high\n", "line 2: 'high' is not a number"),
        ("400,0.9\n500,nan\n", "line 2 is not two numbers"),
        ("nm,R\n400,0.9\n500,\n", "line 3 is not two numbers"),
        ("400\n500\n", "line 1 is not two numbers"),
        ("400,0.9\n500,0.9,0.01\n", "line 2 has 3 and not 2"),
        ("400,0,9\n500,0,9\n", "line 1 is not two numbers"),
        ("400 0.9\n500 0.9\n", "line 2: '500 0.9' is not a number"),
        ("400,0.9\n450,0\n500,0.9\n", "a reflectance of 0 at 450 nm"),
        ("400,0.9\n450,-0.9\n500,0.9\n", "a reflectance of -0.9 at 450 nm"),
        ("400,90\n450,900\n500,90\n", "a reflectance of 900 at 450 nm"),
        ("400,0.9\n500,0.9\n400,0.8\n", "gives 400 nm twice"),
        ("0.4,0.9\n0.5,0.9\n", "gives 0.4 as a wavelength; write wavelengths in nm"),
    ],
)
def test_panel_that_cannot_be_used(tmp_path, text, sentence):
    with pytest.raises(InputError, match=r"panel\.csv: .*" + sentence):
        read_panel(write(tmp_path, text), BANDS_NM)


def test_panel_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"panel\.csv: .* cannot be read .* path"):
        read_panel(tmp_path / "panel.csv", BANDS_NM)
    (tmp_path / "panel.csv").write_bytes(b"\xff\xfe\x00\x01\x80")
    with pytest.raises(InputError, match=r"panel\.csv: .* \(it is no text\)"):
        read_panel(tmp_path / "panel.csv", BANDS_NM)
