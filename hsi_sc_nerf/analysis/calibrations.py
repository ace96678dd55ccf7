"""Calibrations that were fitted elsewhere: regressions and classifiers, applied to a surface.

They are read from a table, which may name an ONNX model. It is described in docs/how-to/calibrations.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.analysis.maps import SurfaceMap
from hsi_sc_nerf.analysis.preprocessing import Step, preprocessed, read_steps
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import names_in_short
from hsi_sc_nerf.number_table import keyed, number_in, numbers_in, read_number_table
from hsi_sc_nerf.spectra import nearest_bands

_KEYS = {
    *("name", "unit", "preprocessing", "intercept", "error"),
    *("t2_limit", "q_limit", "score_variances", "model", "column", "classes"),
}
_COEFFICIENTS = ("coefficients", "regression_coefficient", "regression_coefficients", "b")
"""Titles that software gives the column ``coefficient``."""
_INTERCEPTS = ("b0", "intercept", "(intercept)")
"""What it writes in place of a wavelength before the intercept."""
_SAME_BAND_NM = 0.05
"""Tables round wavelengths."""
_CHUNK_SPECTRA = 1 << 13
_FATAL = 4  # of onnxruntime's levels; it logs past Python, beside our sentences
_REMEDY = "docs/how-to/calibrations.md shows such a table"


@dataclass(frozen=True)
class Domain:
    """The spectra that a calibration was fitted on: a mean and a few directions of pre-processed spectra.

    Attributes:
        mean: subtracted first.
        scale: divided by then.
        weights: give the scores.
        loadings: give a spectrum back from its scores.
        variances: variances of the scores.
        t2_limit: largest Hotelling T², the scores' squares by their variances; infinite for none.
        q_limit: largest Q, the sum of squares that the scores do not give back; infinite for none.
    """

    mean: Float[np.ndarray, "used"]
    scale: Float[np.ndarray, "used"]
    weights: Float[np.ndarray, "used components"]
    loadings: Float[np.ndarray, "used components"]
    variances: Float[np.ndarray, "components"]
    t2_limit: float
    q_limit: float

    def holds(self, spectra: Float[np.ndarray, "n used"]) -> Bool[np.ndarray, "n"]:
        """Whether pre-processed spectra are within both limits."""
        scaled = (spectra - self.mean) / self.scale
        scores = scaled @ self.weights
        t2 = (scores**2 / self.variances).sum(axis=1)
        q = ((scaled - scores @ self.loadings.T) ** 2).sum(axis=1)
        return (t2 <= self.t2_limit) & (q <= self.q_limit)


@dataclass(frozen=True)
class Calibration:
    """A regression on spectra, or a classifier of them.

    Attributes:
        name: name of what it tells.
        unit: unit of its values.
        error: standard deviation of its predictions (RMSEP); 0 if it is not known.
        wavelengths_nm: wavelengths of the spectra that it takes.
        steps: steps of the pre-processing.
        used: bands that the model takes after it.
        reference: spectrum of the scatter correction.
        predict: the model, from pre-processed spectra; of a classifier the probability of each class.
        domain: what it was fitted on; None if that is not known.
        classes: classes of a classifier, in the order of its probabilities; empty for a regression.
    """

    name: str
    unit: str
    error: float
    wavelengths_nm: Float[np.ndarray, "bands"]
    steps: tuple[Step, ...]
    used: Bool[np.ndarray, "bands"]
    reference: Float[np.ndarray, "bands"]
    predict: Callable[[Float[np.ndarray, "n used"]], Float[np.ndarray, "n outputs"]]
    domain: Domain | None = None
    classes: tuple[str, ...] = ()

    def predictions(
        self, spectra: Float[np.ndarray, "n others"], nm: Float[np.ndarray, "others"], only_inside: bool = False
    ) -> Float[np.ndarray, "n outputs"]:
        """What the model says of spectra, interpolated linearly to its wavelengths: one number, or the probability of
        each class.

        NaN where it says nothing.

        Args:
            spectra: reflectance.
            nm: their wavelengths.
            only_inside: nothing outside the domain either.

        Raises:
            InputError: its own wavelengths reach beyond.
        """
        resampled = spectra.astype(float) @ self.interpolation(nm)
        found = np.full((len(spectra), max(1, len(self.classes))), np.nan)
        for start in range(0, len(spectra), _CHUNK_SPECTRA):
            chunk = preprocessed(resampled[start : start + _CHUNK_SPECTRA], self.steps, self.used, self.reference)
            known = np.isfinite(chunk).all(axis=1)
            if only_inside and self.domain is not None:
                known[known] = self.domain.holds(chunk[known])
            if known.any():
                found[start + np.flatnonzero(known)] = self.predict(chunk[known])
        return found

    def of(
        self, spectra: Float[np.ndarray, "n others"], nm: Float[np.ndarray, "others"], only_inside: bool = False
    ) -> Float[np.ndarray, "n"]:
        """Predictions of a regression, numbers of the most probable classes of a classifier (`predictions`)."""
        found = self.predictions(spectra, nm, only_inside)
        return np.where(np.isnan(found[:, 0]), np.nan, found.argmax(axis=1)) if self.classes else found[:, 0]

    def interpolation(self, nm: Float[np.ndarray, "others"]) -> Float[np.ndarray, "others bands"]:
        """The matrix that interpolates spectra at wavelengths ``nm`` to its own.

        Raises:
            InputError: its own reach beyond.
        """
        nearest = nm[nearest_bands(nm, self.wavelengths_nm)]
        needed = np.where(np.abs(nearest - self.wavelengths_nm) <= _SAME_BAND_NM, nearest, self.wavelengths_nm)
        if needed.min() < nm.min() or needed.max() > nm.max():
            raise InputError(
                f"the calibration {self.name} needs {needed.min():g} to {needed.max():g} nm, and the cloud has "
                f"{nm.min():g} to {nm.max():g} nm; give a cloud with more bands, or a calibration that needs fewer."
            )
        order = np.argsort(nm)
        return np.stack([np.interp(needed, nm[order], row[order]) for row in np.eye(len(nm))])

    def coarser(self, nm: Float[np.ndarray, "others"]) -> Int[np.ndarray, "half"] | None:
        """Every second of the bands ``nm``, and the last; None where its own are among them.

        What a prediction changes if it is interpolated from these tells the error of interpolation: linear
        interpolation errs four times as much over twice the distance, so that the change is three times the error.
        """
        if np.isin(self.interpolation(nm), (0.0, 1.0)).all():
            return None
        order = np.argsort(nm)
        return np.union1d(order[::2], order[-1:])


def calibration_map(surface: SpectralMesh, calibration: Calibration) -> SurfaceMap:
    """A regression's value at each vertex; NaN outside its domain.

    Raises:
        InputError: the calibration needs wavelengths that the surface's bands do not reach.

    Example:
        >>> dry_matter = calibration_map(surface, read_calibration("dry_matter.csv"))
        >>> np.nanmean(dry_matter.values)
    """
    nm = surface.wavelengths_nm
    of = partial(calibration.of, nm=nm)
    values, resampling_error = of(surface.spectra, only_inside=True), 0.0
    if (coarse := calibration.coarser(nm)) is not None:
        other = calibration.of(surface.spectra[:, coarse], nm[coarse])
        change = (other - values)[surface.seen & np.isfinite(other - values)]
        resampling_error = float(np.sqrt(np.mean(change**2))) / 3.0 if len(change) else math.nan
    return SurfaceMap(
        calibration.name,
        calibration.unit,
        values,
        of,
        calibration.error,
        resampling_error=resampling_error,
        limited=calibration.domain is not None,
    )


def read_calibration(path: Path | str) -> Calibration:
    """Read a calibration from a CSV table, whose header may name an ONNX model beside it.

    Raises:
        InputError: the table or the model cannot be read, or does not hold what it needs.

    Example:
        >>> text = "# intercept: 2\\nwavelength_nm,coefficient\\n500,1\\n700,10\\n"
        >>> _ = Path("dry_matter.csv").write_text(text)
        >>> read_calibration("dry_matter.csv").predict(np.array([[0.1, 0.3]])).round(3)
        array([[5.1]])
    """
    path = Path(path)
    try:
        head, columns = _read_table(path)
        if unknown := head.keys() - _KEYS:
            raise ValueError(f"{', '.join(sorted(unknown))} is no known key; known are {', '.join(sorted(_KEYS))}")
        if "wavelength_nm" not in columns:
            raise ValueError(f"it needs a column wavelength_nm and has {names_in_short([*columns]) or 'none'}")
        nm = columns.pop("wavelength_nm")
        if not (len(nm) and np.isfinite(nm).all() and (np.diff(nm) > 0).all()):
            raise ValueError("its column wavelength_nm needs a number in each line, in ascending order")
        coefficients = columns.get("coefficient", np.ones(len(nm)))
        used = np.isfinite(coefficients)
        steps = read_steps(head.get("preprocessing", "").replace(";", ","), used)
        reference = columns.get("reference", np.full(len(nm), np.nan))
        if any(name == "msc" for name, _ in steps) and not np.isfinite(reference).all():
            raise ValueError("msc needs a column reference")
        if "coefficient" in columns and "model" not in head and "intercept" not in head:
            raise ValueError("it has no '# intercept:'; add the model's, which is 0 if it has none")
        numbers = {key: number_in(head.get(key, "0")) for key in ("intercept", "error")}
        if not (all(map(math.isfinite, numbers.values())) and numbers["error"] >= 0.0 and used.any()):
            raise ValueError("its intercept and error are no finite numbers, or it has no coefficient")
        domain = _domain(head, {name: column[used] for name, column in columns.items()})
        column = int(head.get("column", 0))
        classes = tuple(word.strip() for word in re.split("[,;]", head.get("classes", "")) if word.strip())
        if classes and (len(classes) < 2 or len(set(classes)) < len(classes) or "model" not in head):
            raise ValueError("classes needs two names or more, each once, and a model that gives their probabilities")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {_REMEDY}.") from error
    except ValueError as error:
        raise InputError(f"{path}: is no table of a calibration ({error}); {_REMEDY}.") from error
    if "model" in head:
        predict = _onnx_model(path, head["model"], int(used.sum()), slice(column, column + max(1, len(classes))))
    elif "coefficient" in columns:
        slopes, intercept = coefficients[used], numbers["intercept"]

        def predict(spectra: np.ndarray) -> np.ndarray:
            return spectra @ slopes[:, None] + intercept
    else:
        raise InputError(
            f"{path}: has neither a column coefficient nor a '# model:', but {names_in_short([*columns]) or 'none'}; "
            f"{_REMEDY}."
        )
    name, unit = head.get("name", path.stem), head.get("unit", "")
    return Calibration(name, unit, numbers["error"], nm, steps, used, reference, predict, domain, classes)


def _read_table(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """``# key: value`` lines, and the columns by name; empty cells are NaN.

    An intercept in the first line moves to the others.

    Raises:
        ValueError: it is no table, or has two intercepts.
    """
    table = read_number_table(path, blanks=_INTERCEPTS)
    head, columns = {key: value for key, value in keyed(table.notes).items() if value}, table.by_title()
    for title in _COEFFICIENTS:
        if title in columns and "coefficient" not in columns:
            columns["coefficient"] = columns.pop(title)
    if "coefficient" in columns and math.isnan(columns.get("wavelength_nm", np.zeros(1))[:1].sum()):
        if "intercept" in head:
            raise ValueError("it has two intercepts, one as '# intercept:' and one in its first line")
        head["intercept"] = str(columns["coefficient"][0])
        columns = {name: column[1:] for name, column in columns.items()}
    return head, columns


def _domain(head: dict[str, str], columns: dict[str, np.ndarray]) -> Domain | None:
    """The domain, where the table has a limit.

    Raises:
        ValueError: the table lacks what the limit needs.
    """
    limits = [number_in(head.get(key, "inf")) for key in ("t2_limit", "q_limit")]
    if any(map(math.isnan, limits)):
        raise ValueError("t2_limit and q_limit must be numbers")
    if not (limits[0] < math.inf or limits[1] < math.inf):
        return None
    # By their numbers, as the variances are: programs also order columns by the alphabet.
    ordered = sorted(columns, key=lambda name: (len(name), name))
    weights, loadings = (
        np.stack(found, axis=1) if (found := [columns[name] for name in ordered if name.startswith(kind)]) else None
        for kind in ("weight", "loading")
    )
    if "mean" not in columns or weights is None or loadings is None or weights.shape != loadings.shape:
        raise ValueError("t2_limit and q_limit need the columns mean, weight_1 ... and as many of loading_1 ...")
    variances = np.array(numbers_in(head.get("score_variances", "")))
    if limits[0] < math.inf and not (len(variances) == weights.shape[1] and (variances > 0.0).all()):
        raise ValueError("t2_limit needs score_variances, one above 0 for each weight")
    scale = columns.get("scale", np.ones(len(weights)))
    if not all(np.isfinite(part).all() for part in (columns["mean"], scale, weights, loadings)):
        raise ValueError("mean, scale, weight and loading must be numbers where there is a coefficient")
    variances = variances if len(variances) else np.full(weights.shape[1], math.inf)
    return Domain(columns["mean"], scale, weights, loadings, variances, *limits)


def _onnx_model(table: Path, name: str, bands: int, columns: slice) -> Callable[[np.ndarray], np.ndarray]:
    """Columns of the last output of an ONNX model in the folder of the table.

    Raises:
        InputError: onnxruntime is not installed, or the model cannot be used.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise InputError(f"{name} needs onnxruntime; install it: pip install 'hsi-sc-nerf[calibrations]'.") from error
    path, expected = table.with_name(Path(name).name), columns.stop - columns.start
    if not path.is_file():
        raise InputError(f"{path}: is missing, but {table.name} names it; put the model beside the table.")
    try:
        options = onnxruntime.SessionOptions()
        options.log_severity_level = _FATAL
        # Its second try would print what went wrong in the first.
        session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"], enable_fallback=0
        )
        takes, last = session.get_inputs()[0], session.get_outputs()[-1]
        if last.type.startswith("seq"):
            raise InputError(
                f"{path}: gives dictionaries of classes, not columns; export it with options={{'zipmap': False}}."
            )
        kind = {"tensor(float)": np.float32, "tensor(double)": np.float64}[takes.type]

        def predict(spectra: np.ndarray) -> np.ndarray:
            (found,) = session.run([last.name], {takes.name: spectra.astype(kind)})
            return np.asarray(found, float).reshape(len(spectra), -1)[:, columns]

        if (given := predict(np.zeros((2, bands))).shape[1]) != expected:
            raise ValueError(f"it gives {given} of {expected}")
    except InputError:
        raise
    except Exception as error:  # onnxruntime's exceptions have no common class
        raise InputError(
            f"{path}: is no ONNX model of spectra of {bands} bands whose last output has {expected} columns from "
            f"column {columns.start} on ({error}); {_REMEDY}."
        ) from error
    return predict
