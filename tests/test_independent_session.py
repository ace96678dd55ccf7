"""The path-traced session: what is mixed and stated without rendering."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mitsuba", reason="Mitsuba is not installed")

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))


@pytest.mark.slow
def test_nine_wavelengths_give_all_spectra_and_the_drift_ends_where_it_is_said():
    import independent_session
    import path_traced_scene

    nodes_nm, bands_nm = independent_session.NODES_NM.ravel(), independent_session.BANDS
    mixing = independent_session.mixing_matrix()
    for name, spectrum in path_traced_scene.MATERIALS.items():
        np.testing.assert_allclose(spectrum(nodes_nm) @ mixing, spectrum(bands_nm), atol=0.016, err_msg=name)
    drift = independent_session.lamp_drift(30)
    assert (drift[-1, 0], drift[-1, -1]) == pytest.approx((0.90, 0.95), abs=1e-3)
    assert (np.diff(drift, axis=0) < 0).all()
    for _, corners in path_traced_scene.marker_poses().values():
        sides_m = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
        np.testing.assert_allclose(sides_m, path_traced_scene.MARKER_SIDE_M)
        # Clockwise for who looks from above.
        assert np.cross(corners[1] - corners[0], corners[2] - corners[1])[2] < 0
