"""A spectral cloud of random numbers, with columns of every kind."""

import numpy as np

from hsi_sc_nerf.export.cloud import SpectralCloud

WAVELENGTHS_NM = np.array([397.32, 400.2, 650.0, 1003.58])
BAND_NAMES = ("397.32nm", "400.20nm", "650.00nm", "1003.58nm")


def random_cloud(count: int = 50, wavelengths_nm: np.ndarray = WAVELENGTHS_NM, **changes: object) -> SpectralCloud:
    random = np.random.default_rng(0)
    arrays = {
        "points": random.normal(0, 0.05, (count, 3)).astype(np.float32),
        "normals": random.normal(size=(count, 3)).astype(np.float32),
        "colours": random.integers(0, 256, (count, 3), dtype=np.uint8),
        "spectra": random.random((count, len(wavelengths_nm)), dtype=np.float32),
        "wavelengths_nm": wavelengths_nm,
        "extra": {"opacity": random.random(count, dtype=np.float32), "views": np.arange(count, dtype=np.float32)},
    }
    return SpectralCloud(**arrays | changes)


def assert_equal(read: SpectralCloud, written: SpectralCloud) -> None:
    """Bands and columns in any order, as other programs write them."""
    ours, theirs = (np.argsort(cloud.wavelengths_nm) for cloud in (written, read))
    np.testing.assert_array_equal(read.wavelengths_nm[theirs], written.wavelengths_nm[ours])
    np.testing.assert_array_equal(read.spectra[:, theirs], written.spectra[:, ours])
    for name in ("points", "normals", "colours"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    assert read.metric == written.metric
    assert set(read.extra) == set(written.extra)
    for name, column in written.extra.items():
        np.testing.assert_array_equal(read.extra[name], column)
