"""The views that the benchmark's committed figures were measured on, and the report shows."""

import pytest

from hsi_sc_nerf.benchmark.run import HeldOutViews
from hsi_sc_nerf.evaluation.chosen_views import spread_of_views


@pytest.mark.parametrize(
    ("count", "wanted", "expected"), [(6, 2, [0, 3]), (7, 3, [0, 2, 4]), (3, 9, [0, 1, 2]), (5, 1, [0]), (0, 4, [])]
)
def test_views_are_spread_evenly_from_the_first(count, wanted, expected):
    assert spread_of_views(count, wanted) == expected
    assert HeldOutViews(range(count), wanted).indices == expected
