"""Calibrations against scikit-learn's regressions, on simulated spectra."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import savgol_filter
from sklearn.cross_decomposition import PLSRegression

from hsi_sc_nerf.analysis.calibrations import calibration_map, read_calibration
from hsi_sc_nerf.analysis.report import trait_content, trait_tables
from hsi_sc_nerf.analysis.size import size_of
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.analysis.traits import analyse
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate.mesh import cylinder

NM = np.linspace(400.0, 1000.0, 61)
MODELS = Path(__file__).parent / "calibrations_onnx"


def simulated(count, seed=0):
    """Spectra of a line whose absorption at 680 and 970 nm grows with what a calibration tells, at any brightness."""
    rng = np.random.default_rng(seed)
    content, water, brightness = rng.uniform(0.0, 1.0, (3, count, 1))
    depth = 0.5 * content * np.exp(-(((NM - 680) / 40) ** 2)) + 0.3 * water * np.exp(-(((NM - 970) / 30) ** 2))
    noise = 0.0005 * rng.standard_normal((count, len(NM)))
    return (0.4 + 0.5 * brightness) * 10.0**-depth + noise, 8.0 + 6.0 * content[:, 0]


def table(path, head, columns):
    lines = [f"# {key}: {value}" for key, value in head.items()]
    rows = [",".join(f"{value:.17g}" for value in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join([*lines, ",".join(columns), *rows]) + "\n")
    return path


def pretreated(spectra):
    filtered = savgol_filter(-np.log10(spectra), 7, 2, deriv=1)
    return (filtered - filtered.mean(axis=1, keepdims=True)) / filtered.std(axis=1, ddof=1, keepdims=True)


@pytest.fixture(scope="module")
def pls():
    spectra, content = simulated(200)
    return PLSRegression(3).fit(pretreated(spectra), content)


@pytest.fixture
def fitted(pls, tmp_path):
    """The table of a regression, as docs/how-to/calibrations.md writes it."""
    inside = pretreated(simulated(200)[0])
    scores = pls.transform(inside)
    scaled = (inside - inside.mean(axis=0)) / inside.std(axis=0, ddof=1)
    t2 = (scores**2 / scores.var(axis=0, ddof=1)).sum(axis=1)
    q = ((scaled - scores @ pls.x_loadings_.T) ** 2).sum(axis=1)
    head = {
        "name": "sugar content",
        "unit": "°Brix",
        "preprocessing": "absorbance, savgol 7 2 1, snv",
        "intercept": pls.predict(np.zeros((1, len(NM)))).item(),
        "error": 0.3,
        "t2_limit": t2.max(),
        "q_limit": q.max(),
        "score_variances": ", ".join(map(str, scores.var(axis=0, ddof=1))),
    }
    columns = {"wavelength_nm": NM, "coefficient": pls.coef_.ravel(), "mean": inside.mean(axis=0)}
    columns["scale"] = inside.std(axis=0, ddof=1)
    columns |= {f"weight_{k + 1}": column for k, column in enumerate(pls.x_rotations_.T)}
    columns |= {f"loading_{k + 1}": column for k, column in enumerate(pls.x_loadings_.T)}
    return table(tmp_path / "sugar.csv", head, columns)


def surface_of(spectra, nm=NM):
    mesh = cylinder(0.04, 0.04, segments=64, spacing_m=0.002)
    count = len(mesh.vertices)
    return SpectralMesh(mesh, np.resize(spectra, (count, len(nm))), nm, np.ones(count, bool))


def test_predictions_are_those_of_scikit_learn(pls, fitted):
    calibration = read_calibration(fitted)
    spectra, _ = simulated(100, seed=1)
    found = calibration.of(spectra, NM)
    np.testing.assert_allclose(found, pls.predict(pretreated(spectra)).ravel(), rtol=1e-9)
    assert (calibration.name, calibration.unit, calibration.error) == ("sugar content", "°Brix", 0.3)


def test_spectra_that_the_calibration_does_not_know_have_no_value(fitted):
    calibration = read_calibration(fitted)
    inside, outside = simulated(100, seed=0)[0], simulated(20, seed=1)[0]
    outside += 0.1 * np.exp(-(((NM - 500) / 10) ** 2))
    assert np.isfinite(calibration.of(inside, NM, only_inside=True)).mean() > 0.9
    assert np.isnan(calibration.of(outside, NM, only_inside=True)).all()
    assert np.isfinite(calibration.of(outside, NM)).all()


@pytest.mark.parametrize("scaled", [False, True])
def test_the_code_of_the_page_writes_limits_that_hold_its_own_spectra(tmp_path, monkeypatch, scaled):
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "calibrations.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    if scaled:
        code = code.replace("scale=False", "scale=True").replace("np.ones(101)", "spectra.std(axis=0, ddof=1)")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(code, names)
    calibration = read_calibration(tmp_path / "sugar.csv")
    spectra, nm = names["spectra"], names["nm"]
    found = calibration.of(spectra, nm, only_inside=True)
    assert 0.95 < np.isfinite(found).mean() < 1.0
    np.testing.assert_allclose(calibration.of(spectra, nm), names["pls"].predict(spectra).ravel())
    strange = spectra.mean(axis=0) + 0.03 * np.sin(nm / 20.0)
    assert np.isnan(calibration.of(strange[None], nm, only_inside=True)).all()


def test_the_components_of_the_limits_go_by_their_numbers_in_whatever_order_their_columns_stand(fitted):
    domain, (*head, titles) = read_calibration(fitted).domain, fitted.read_text().split("\nwavelength_nm,", 1)
    titles, *rows = f"wavelength_nm,{titles}".splitlines()
    order = np.argsort(titles.split(","))[::-1]
    lines = [",".join(np.array(row.split(","))[order]) for row in (titles, *rows)]
    fitted.write_text("\n".join([*head, *lines]))
    again = read_calibration(fitted).domain
    np.testing.assert_array_equal(again.weights, domain.weights)
    np.testing.assert_array_equal(again.loadings, domain.loadings)


def test_each_limit_counts_alone(fitted):
    text = fitted.read_text()
    extreme = simulated(200)[0]
    for key in ("t2_limit", "q_limit"):
        lines = [f"# {key}: 1e-9" if line.startswith(f"# {key}") else line for line in text.splitlines()]
        other = {"t2_limit": "q_limit", "q_limit": "t2_limit"}[key]
        fitted.write_text("\n".join(line for line in lines if not line.startswith(f"# {other}")))
        assert np.isnan(read_calibration(fitted).of(extreme, NM, only_inside=True)).all()


def test_the_table_says_where_no_limits_are_stated(fitted):
    limits = ("# t2_limit", "# q_limit")
    free = fitted.with_name("free.csv")
    free.write_text("\n".join(line for line in fitted.read_text().splitlines() if not line.startswith(limits)))
    surface = surface_of(simulated(50)[0])
    shown = []
    for path in (fitted, free):
        traits = analyse(surface, maps=[calibration_map(surface, read_calibration(path))])
        content = trait_content(size_of(surface.mesh), {}, True, traits, {})
        shown += [row[-1] for one in trait_tables(content) if one.heading == "Calibrations" for row in one.rows]
    assert shown == ["4.0%", "0.0% (no limits stated)"]


def test_a_surface_that_the_calibration_does_not_know_has_no_value_in_the_table_and_null_in_json(fitted):
    strange = simulated(20)[0] + 0.1 * np.exp(-(((NM - 500) / 10) ** 2))
    surface = surface_of(strange[:, ::2], NM[::2])
    traits = analyse(surface, maps=[calibration_map(surface, read_calibration(fitted))])
    content = trait_content(size_of(surface.mesh), {}, True, traits, {})
    json.dumps(content["calibrations"], allow_nan=False)
    (shown,) = (one for one in trait_tables(content) if one.heading == "Calibrations")
    assert [row[-2:] for row in shown.rows] == [["no value", "100.0%"]]
    assert "nan" not in shown.note


def test_a_map_of_the_same_bands_is_not_resampled(fitted):
    spectra, _ = simulated(50)
    calibration = read_calibration(fitted)
    found = calibration_map(surface_of(spectra, NM + 0.004), calibration)
    assert found.resampling_error == 0.0
    np.testing.assert_allclose(found.values[:50], calibration.of(spectra, NM, only_inside=True))
    assert found.column == "calibration_sugar_content"


def test_other_bands_are_resampled_with_the_error_of_linear_interpolation(tmp_path):
    """Between bands h apart, a line errs by a h² / 4 in the middle of a parabola a nm²; here two such bands."""
    head = {"name": "sum", "preprocessing": "", "intercept": 0}
    path = table(tmp_path / "sum.csv", head, {"wavelength_nm": [505.0, 905.0], "coefficient": [1.0, 1.0]})
    curve = 2e-6
    parabola = 0.2 + curve * (NM - 700.0) ** 2
    found = calibration_map(surface_of(parabola[None]), read_calibration(path))
    true = 2 * 0.2 + curve * (195.0**2 + 205.0**2)
    assert found.values[0] - true == pytest.approx(2 * curve * 10.0**2 / 4)
    assert found.resampling_error == pytest.approx(2 * curve * 10.0**2 / 4, rel=0.35)
    np.testing.assert_allclose(found.of(parabola[None]), found.values[:1])


def test_a_calibration_beyond_the_bands_is_refused(fitted):
    spectra, _ = simulated(5)
    with pytest.raises(InputError, match=r"needs 400 to 1000 nm.* 400 to 900 nm"):
        calibration_map(surface_of(spectra[:, :51], NM[:51]), read_calibration(fitted))


def test_a_classifier_that_gives_dictionaries_is_refused_with_the_way_to_export_it(tmp_path):
    """As skl2onnx writes it by default."""
    pytest.importorskip("onnxruntime")
    (tmp_path / "zipmap.onnx").write_bytes((MODELS / "zipmap.onnx").read_bytes())
    head = {"model": "zipmap.onnx", "classes": "sound, bruised"}
    with pytest.raises(InputError, match=r"zipmap.onnx: gives dictionaries .*'zipmap': False"):
        read_calibration(table(tmp_path / "own.csv", head, {"wavelength_nm": NM[:6]}))


@pytest.mark.parametrize(("model", "column", "rtol"), [("pls.onnx", 6, 1e-5), ("classes.onnx", 7, 1e-5)])
def test_models_of_scikit_learn_as_onnx(tmp_path, capfd, model, column, rtol):
    pytest.importorskip("onnxruntime")
    expected = np.loadtxt(MODELS / "expected.csv", delimiter=",")
    (tmp_path / model).write_bytes((MODELS / model).read_bytes())
    head = {"model": model, "column": column - 6}
    calibration = read_calibration(table(tmp_path / "own.csv", head, {"wavelength_nm": NM[:6]}))
    np.testing.assert_allclose(calibration.of(expected[:, :6], NM[:6]), expected[:, column], rtol=rtol)
    assert calibration.name == "own"
    with pytest.raises(InputError, match=r"no ONNX model .* 7 bands"):
        read_calibration(table(tmp_path / "own.csv", head, {"wavelength_nm": NM[:7]}))
    names_in_latin_1 = (
        (MODELS / model).read_bytes().replace(b"variable", b"variabl\xe9").replace(b"label", b"lab\xe9l")
    )
    for damaged in (b"no model", names_in_latin_1):
        (tmp_path / model).write_bytes(damaged)
        with pytest.raises(InputError, match=f"{model}: is no ONNX model"):
            read_calibration(table(tmp_path / "own.csv", head, {"wavelength_nm": NM[:6]}))
    assert capfd.readouterr() == ("", "")  # one sentence, and nothing of onnxruntime's beside it


def test_a_key_that_is_left_empty_is_not_given(tmp_path):
    path = tmp_path / "brix.csv"
    path.write_text("# name:\n# model:\n# intercept: 1\nwavelength_nm,coefficient\n400,1\n")
    assert read_calibration(path).name == "brix"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "needs a column wavelength_nm and has none"),
        ("X,B (Brix)\nB0,3\n400,1\n", "needs a column wavelength_nm and has x, coefficient"),
        ("400,1\n410,2\n", "first line holds numbers and not the columns' titles"),
        ("wavelength_nm,coefficient\n", "in ascending order"),
        ("wavelength_nm,coefficient\n,3\n500,1\n400,2\n", "in ascending order"),
        ("wavelength_nm,coefficient\n400,1\n410,2\nB0,3\n", "in ascending order"),
        ("# intercept: 2\nwavelength_nm,coefficient\nB0,3\n400,1\n", "two intercepts"),
        ("wavelength_nm,coefficient\n400,1\n", "no '# intercept:'; add the model's"),
        ("wavelength_nm,coefficient\n400,one\n", "line 2: 'one' is not a number"),
        ("wavelength_nm,coefficient\n400,0,5\n", "decimal commas there must be semicolons"),
        ("wavelength (1/cm),coefficient\n25000,1\n", "needs a column wavelength_nm and has wavelength_1/cm"),
        ("wavelength_nm,coefficient\n400,1,2\n", "same number of columns"),
        ("wavelength_nm,1_comps,2_comps\n400,1,2\n", "neither a column coefficient nor .* but 1_comps, 2_comps"),
        ("# intercept: 0\nwavelength_nm,coefficient\n400,\n", "has no coefficient"),
        ("# slope: 2\nwavelength_nm,coefficient\n400,1\n", "slope is no known key"),
        ("# intercept: 0\n# error: -1\nwavelength_nm,coefficient\n400,1\n", "no finite numbers"),
        ("# preprocessing: blur\nwavelength_nm,coefficient\n400,1\n", "'blur' is not absorbance"),
        ("# preprocessing: savgol 3,1,1\nwavelength_nm,coefficient\n400,1\n", "spaces between the numbers"),
        ("# preprocessing: msc\nwavelength_nm,coefficient\n400,1\n", "msc needs a column reference"),
        ("# intercept: 0\n# t2_limit: 3\nwavelength_nm,coefficient\n400,1\n", "need the columns mean, weight_1"),
        (
            "# intercept: 0\n# t2_limit: 3\nwavelength_nm,coefficient,mean,weight_1,loading_1\n400,1,1,1,1\n",
            "needs score_variances",
        ),
        (
            "# intercept: 0\n# q_limit: 1\n# t2_limit: NA\nwavelength_nm,coefficient,mean,weight_1,loading_1\n"
            "400,1,1,1,1\n",
            "must be numbers",
        ),
        ("# model: none.onnx\nwavelength_nm\n400\n", "none.onnx: is missing, but own.csv names it"),
    ],
)
def test_what_is_no_calibration_is_refused_in_a_sentence(tmp_path, text, why):
    path = tmp_path / "own.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=why):
        read_calibration(path)
