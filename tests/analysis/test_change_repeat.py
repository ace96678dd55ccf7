"""A second capture of the first day: clouds of an apple with errors as trained runs have them."""

from dataclasses import replace

import numpy as np
import pytest
from another_day import STAND_M, CloudErrors, SetDown, bruise_cm2, cloud_of, fruit_of

from hsi_sc_nerf.analysis.change import compare_days
from hsi_sc_nerf.analysis.change_days import days_on_one_mesh
from hsi_sc_nerf.analysis.closed_mesh import MeshConfig
from hsi_sc_nerf.indices.catalogue import find_indices

pytestmark = pytest.mark.slow

NM = np.linspace(400.0, 1000.0, 13)
ERRORS = CloudErrors(smooth_over_m=0.01, session=0.02, at_base=8.0)
"""The lamps of two sessions differ, and errors are larger where the fruit stands."""
CAPTURES = {
    "first": SetDown(bruise_diameter_m=0.012),
    "same day": SetDown(bruise_diameter_m=0.012, turn_deg=120.0, tip_deg=2.0),
    "later": SetDown(bruise_diameter_m=0.024, turn_deg=40.0, tip_deg=3.0),
    "repeat": SetDown(bruise_diameter_m=0.012, turn_deg=250.0, tip_deg=4.0),
}


@pytest.fixture(scope="module")
def days():
    each = enumerate(CAPTURES.values(), start=20)
    clouds = [cloud_of(fruit_of(day, NM), day, ERRORS, 12_000, seed) for seed, day in each]
    last = clouds[3]  # whose bands another program wrote in another order
    clouds[3] = replace(last, spectra=last.spectra[:, ::-1], wavelengths_nm=last.wavelengths_nm[::-1])
    # How they lie is found from every fourth start as well.
    return days_on_one_mesh(clouds, list(CAPTURES), MeshConfig(octree_depth=6), 90.0, lambda starts: starts[::4])


def compared(days, repeat):
    """Quantities of the second capture of the first day and of the later day."""
    found = compare_days(days[:3], (), find_indices((), NM), ERRORS.session, repeat=repeat)
    return [one.quantities for one in found]


def false_cm2(quantities, surface):
    """Area that any quantity calls changed near the base."""
    changed = np.any([one.changed for one in quantities.values()], axis=0)
    return 1e4 * surface.areas_m2[changed & (surface.mesh.vertices[:, 2] < STAND_M + 0.02)].sum()


def test_errors_between_captures_are_no_change(days):
    alone, _ = compared(days, None)
    assert false_cm2(alone, days[0].surface) == 0.0
    same_day, _ = compared(days, days[3])
    for name, one in same_day.items():
        assert not one.changed.any(), name
        assert one.test.whole_p > 0.01, name


def test_a_bruise_is_found_all_the_same(days):
    _, later = compared(days, days[3])
    (bruise,) = later["brightness"].regions
    before_cm2, after_cm2 = (bruise_cm2(fruit_of(CAPTURES[name], NM)) for name in ("first", "later"))
    assert 1e4 * bruise.area_m2 == pytest.approx(after_cm2 - before_cm2, rel=0.1)
    assert false_cm2(later, days[0].surface) == 0.0
