"""Makes the models of this folder, away from this project's packages, which need an older protobuf:

uv run --no-project --with skl2onnx --with scikit-learn python tests/analysis/calibrations_onnx/make_models.py
"""

from pathlib import Path

import numpy as np
from skl2onnx import to_onnx
from sklearn.cross_decomposition import PLSRegression
from sklearn.linear_model import LogisticRegression

folder = Path(__file__).parent
spectra = np.random.default_rng(0).uniform(0.1, 0.9, (40, 6)).astype(np.float32)
values = spectra @ np.array([1.0, 2.0, -1.0, 0.5, 0.0, 3.0]) + 5.0
pls = PLSRegression(3).fit(spectra, values)
classes = LogisticRegression().fit(spectra, (values > np.median(values)).astype(int))
(folder / "pls.onnx").write_bytes(to_onnx(pls, spectra[:1]).SerializeToString())
(folder / "classes.onnx").write_bytes(to_onnx(classes, spectra[:1], options={"zipmap": False}).SerializeToString())
(folder / "zipmap.onnx").write_bytes(to_onnx(classes, spectra[:1]).SerializeToString())
some = spectra[:5]
table = np.column_stack([some, pls.predict(some).ravel(), classes.predict_proba(some)[:, 1]])
title = "six bands, then what PLSRegression and LogisticRegression give"
np.savetxt(folder / "expected.csv", table, "%.7g", ",", header=title)
