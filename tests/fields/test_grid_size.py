import pytest

from hsi_sc_nerf.fields.grid_size import COARSEST_GRID, LEVEL_GROWTH, grid_for_resolution


def test_half_a_pixel_is_a_cell():
    assert grid_for_resolution(0.2, 0.002).finest == 200
    assert grid_for_resolution(0.2, 0.0005).finest == 800


@pytest.mark.parametrize("footprint_m", [0.003, 0.002, 0.001, 0.0004])
def test_levels_grow_no_faster_than_they_may_and_are_not_more_than_needed(footprint_m):
    size = grid_for_resolution(0.2, footprint_m)
    growth = size.finest / COARSEST_GRID
    assert growth ** (1 / (size.levels - 1)) <= LEVEL_GROWTH + 1e-9
    assert growth ** (1 / (size.levels - 2)) > LEVEL_GROWTH


def test_tables_hold_every_second_cell_of_a_plane_within_bounds():
    assert 2 ** grid_for_resolution(0.2, 0.002).log2_table >= 200**2 / 2
    assert 2 ** (grid_for_resolution(0.2, 0.002).log2_table - 1) < 200**2 / 2
    assert grid_for_resolution(0.2, 0.05).log2_table == 14
    assert grid_for_resolution(0.2, 0.0001).log2_table == 19


def test_lengths_of_nothing_are_refused():
    for lengths in ((0.0, 0.001), (0.2, 0.0), (0.2, float("nan"))):
        with pytest.raises(ValueError, match="not both above 0"):
            grid_for_resolution(*lengths)
