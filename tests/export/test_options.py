from types import SimpleNamespace

import numpy as np
import pytest

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import OUTLIER_NEIGHBOURS, statistical_inliers
from hsi_sc_nerf.export.options import CloudOptions, select_bands

WAVELENGTHS_NM = np.linspace(400.0, 1000.0, 204)


def test_bands_by_wavelength_and_by_range() -> None:
    np.testing.assert_array_equal(select_bands(WAVELENGTHS_NM, ()), np.arange(204))
    chosen = WAVELENGTHS_NM[select_bands(WAVELENGTHS_NM, ("670", "500-510", "505"))]
    assert np.abs(chosen[-1] - 670) < 1.5
    inside = (WAVELENGTHS_NM >= 500) & (WAVELENGTHS_NM <= 510)
    np.testing.assert_array_equal(chosen[:-1], WAVELENGTHS_NM[inside])
    assert (np.diff(chosen) > 0).all()


@pytest.mark.parametrize(
    ("word", "message"),
    [("red", "neither a wavelength"), ("1200", "--bands 1200 needs a band"), ("700-600", "none lies")],
)
def test_bands_that_are_not_there(word: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        select_bands(WAVELENGTHS_NM, (word,))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--num-points", "0"], "--num-points is 0; it must be at least 1."),
        (["--std-ratio", "0"], "--std-ratio is"),
        (["--std-ratio", "nan"], "--std-ratio is"),
        (["--roi-box", "0", "0", "1", "1", "1", "0"], "--roi-box takes the smallest x, y and z first"),
        (["--obb-center", "0", "0", "0"], "belong together"),
        ([], "config.yml: there is no such file"),
    ],
)
def test_bad_input_on_the_command_line_is_one_sentence(command, capsys, tmp_path, words, message) -> None:
    given = ["export", "--load-config", str(tmp_path / "config.yml"), "--output-dir", str(tmp_path), *words]
    assert command(*given) == 2
    last_line = capsys.readouterr().err.splitlines()[-1]
    assert last_line.startswith("Error: ")
    assert message in last_line


def test_a_point_far_from_its_neighbours_is_an_outlier_unless_points_are_too_few() -> None:
    points = np.random.default_rng(0).random((OUTLIER_NEIGHBOURS + 1, 3))
    points[0] = 50.0
    np.testing.assert_array_equal(statistical_inliers(points, 0.1), np.arange(1, OUTLIER_NEIGHBOURS + 1))
    np.testing.assert_array_equal(statistical_inliers(points[:-1], 0.1), np.arange(OUTLIER_NEIGHBOURS))


def test_nerfstudios_options_become_ours() -> None:
    stock = {
        "num_points": 7,
        "std_ratio": 2.0,
        "normal_method": "open3d",
        "rgb_output_name": "rgb",
        "load_config": "x",
    }
    options = CloudOptions.from_nerfstudio(SimpleNamespace(**stock))
    assert (options.num_points, options.std_ratio, options.normal_method) == (7, 2.0, "open3d")
    assert options.keep_turntable is False
    with pytest.raises(InputError, match="--rgb-output-name is always rgb"):
        CloudOptions.from_nerfstudio(SimpleNamespace(**stock | {"rgb_output_name": "depth"}))
