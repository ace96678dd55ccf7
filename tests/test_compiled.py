"""Compiled functions start where nothing can be kept."""

import numba
import numpy as np

from hsi_sc_nerf.compiled import compiled


def test_without_a_folder_for_what_was_compiled_it_is_compiled_all_the_same(monkeypatch):
    njit = numba.njit

    def read_only(*args, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return njit(*args, **options)

    monkeypatch.setattr(numba, "njit", read_only)

    @compiled
    def ratio(a, b):
        return a / b

    assert ratio(1.0, 2.0) == 0.5
    assert ratio(1.0, 0.0) == np.inf  # as NumPy, not as Python
