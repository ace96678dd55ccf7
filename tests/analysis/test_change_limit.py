"""Regions up to the limit of blank, on a ball whose spots turned to another material, with errors of two captures."""

import csv
import json

import numpy as np
import pytest
import trimesh
from matplotlib.colors import to_rgb
from results_table import RESULTS, read_results

from hsi_sc_nerf.analysis.change import compare_days
from hsi_sc_nerf.analysis.change_days import Day
from hsi_sc_nerf.analysis.change_pictures import draw_change, draw_class_change
from hsi_sc_nerf.analysis.change_regions import LIMIT_M2, LIMIT_PART, limit_of_blank_m2
from hsi_sc_nerf.analysis.change_registration import Attitude
from hsi_sc_nerf.analysis.change_report import change_rows, write_change_ply, write_change_tables
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.analysis.pictures import SideViews
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.analysis.traits import WHOLE
from hsi_sc_nerf.export.cloud import read_spectral_ply
from hsi_sc_nerf.geometry.camera import Similarity
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.indices.formula import SpectralIndex
from hsi_sc_nerf.plotting import COLOURS
from hsi_sc_nerf.simulate.materials import smooth_noise

NM = np.linspace(500.0, 900.0, 5)
SKIN, BRUISE = np.array([0.2, 0.3, 0.3, 0.5, 0.6]), np.array([0.12, 0.16, 0.2, 0.3, 0.4])
LIBRARY = SpectralLibrary(("skin", "bruise"), NM, np.stack([SKIN, BRUISE]))
ROUND = trimesh.creation.icosphere(5, 0.035)
BALL = Mesh(ROUND.vertices + np.array([0.0, 0.0, 0.035]), ROUND.faces)
SMALL_M, LARGE_M = 0.005, 0.011
"""Radii of spots on opposite sides, below and above the limit."""
AS_IT_WAS = Attitude(Similarity(1.0, np.eye(3), np.zeros(3)), 0.0, 0.05, 0.0, 1.0, 5e-4, 1e-4, 1.0, np.nan, np.nan)


def spot(radius_m, side=1.0):
    return np.linalg.norm(BALL.vertices - [0.035 * side, 0.0, 0.035], axis=1) < radius_m


def day(seed, *bruised):
    rng, count = np.random.default_rng(seed), len(BALL.vertices)
    spectra = np.where(np.any([*bruised, np.zeros(count, bool)], axis=0)[:, None], BRUISE, SKIN)
    spectra = spectra * (1.0 + 0.015 * smooth_noise(BALL.vertices, 0.01, rng)[:, None])
    surface = SpectralMesh(BALL, spectra, NM, BALL.vertices[:, 2] > 0.004)
    raised_m = 1e-4 * smooth_noise(BALL.vertices, 0.01, rng)
    return Day(f"day {seed}", surface, raised_m, np.zeros((count, 3)), AS_IT_WAS if seed else None)


def compared(*days, repeat=None):
    return list(compare_days(days, (), (), 0.01, LIBRARY, repeat=repeat))


def test_an_index_that_the_typical_spectrum_has_not_is_compared_where_it_is_defined():
    def dark(seed):
        one = day(seed)
        one.surface.spectra[BALL.vertices[:, 0] < 0.005, 0] *= -1.0
        return one

    index = SpectralIndex("X", "sqrt(R500)")
    (told,) = compare_days([dark(0), dark(1)], (), [index], 0.01, repeat=dark(3))
    assert np.isfinite(told.quantities["X"].whole[1])


def test_the_whole_surface_of_a_library_is_no_class_of_a_day(first):
    """As in the regions.sli of `traits`, which a notebook hands over."""
    library = SpectralLibrary((WHOLE, *LIBRARY.names), NM, np.vstack([SKIN, LIBRARY.spectra]))
    (one,) = compare_days([first, day(1)], (), (), 0.01, library)
    assert one.class_map.names == tuple(one.classes) == LIBRARY.names


def rows_of(comparisons, kind, name="brightness"):
    regions = change_rows(comparisons)
    return [
        row for row in regions if row["kind"] == kind and row["name"] == name and row["region"] != "whole surface"
    ]


@pytest.fixture(scope="module")
def first():
    return day(0)


@pytest.fixture(scope="module")
def alone(first):
    return compared(first, day(1, spot(SMALL_M), spot(LARGE_M, side=-1.0)))


def test_a_small_region_is_undecided_without_a_repeat_and_counts_with_one(first):
    """It may be what two trainings differ by: nothing of it counts, in classes and on later days neither."""
    small = spot(SMALL_M)
    again, later = day(1, small), day(2, small)
    undecided = compared(first, again, later)
    for one in undecided:
        brightness = one.quantities["brightness"]
        assert brightness.undecided[small].mean() > 0.8
        assert (brightness.p[small] < 0.05).any()
        assert not np.any([quantity.changed for quantity in one.quantities.values()])
        assert not one.grown["brightness"]
        assert all(region.before_m2 == region.after_m2 for regions in one.classes.values() for region in regions)
    assert not rows_of(undecided, "change")
    assert [row["region"] for row in rows_of(undecided, "undecided")] == ["1", "1"]
    (told,) = compared(first, again, repeat=day(3))
    assert told.quantities["brightness"].changed[small].mean() > 0.8
    assert not told.quantities["brightness"].undecided.any()
    assert told.classes["bruise"][0].after_m2 == pytest.approx(np.pi * SMALL_M**2, rel=0.25)
    assert not rows_of([told], "undecided")
    assert rows_of([told], "change")


def test_a_region_above_the_limit_counts_beside_one_below_it(alone):
    (one,) = alone
    (large,), (small,) = rows_of([one], "change"), rows_of([one], "undecided")
    assert large["area_after_cm2"] == pytest.approx(1e4 * np.pi * LARGE_M**2, rel=0.1)
    assert large["x_mm"] < 0.0 < small["x_mm"]
    assert not one.quantities["brightness"].changed[BALL.vertices[:, 0] > 0.0].any()
    (whole,) = (r for r in change_rows([one]) if r["name"] == "brightness" and r["region"] == "whole surface")
    assert whole["area_after_cm2"] == pytest.approx(large["area_after_cm2"])
    bruise = one.classes["bruise"]
    assert [np.sign(region.centre_m[0]) for region in bruise] == [-1.0]


def test_the_limit_is_a_part_of_what_was_seen_and_at_least_an_area(first, alone):
    seen_m2 = first.surface.areas_m2[first.surface.seen].sum()
    for scale, limit_m2 in ((1.0, LIMIT_M2), (3.0, LIMIT_PART * 9.0 * seen_m2)):
        assert limit_of_blank_m2(scale**2 * seen_m2) == pytest.approx(limit_m2)
    assert {quantity.limit_m2 for quantity in alone[0].quantities.values()} == {LIMIT_M2}


def test_page_table_and_cloud_tell_what_is_undecided(first, alone, tmp_path):
    write_change_tables(tmp_path, alone, {}, {})
    page = (tmp_path / "change.md").read_text()
    assert "up to 1.4 cm² that are no change (limit of blank)" in page
    assert (
        page.index("## What changed") < page.index("## Undecided: below the limit of blank") < page.index("classes")
    )
    with (tmp_path / "change.csv").open(newline="") as file:
        kinds = {(row["name"], row["region"]): row["kind"] for row in csv.DictReader(file) if row["kind"] != "class"}
    assert (kinds["brightness", "1"], kinds["brightness", "2"]) == ("change", "undecided")
    assert json.loads((tmp_path / "change.json").read_text())["days"][0]["limit_of_blank_m2"] == LIMIT_M2
    write_change_ply(tmp_path / "change.ply", first, alone)
    region = read_spectral_ply(tmp_path / "change.ply").extra["brightness_region_1"]
    assert set(np.unique(region)) == {-2.0, 0.0, 1.0}

    repeat = day(3)
    write_change_tables(tmp_path, compared(first, day(1, spot(SMALL_M)), repeat=repeat), {}, {}, repeat)
    assert "limit of blank" not in (tmp_path / "change.md").read_text()
    assert json.loads((tmp_path / "change.json").read_text())["days"][0]["limit_of_blank_m2"] is None


def test_an_index_without_values_on_one_day_is_left_out_of_it_and_the_page_says_so(first, tmp_path):
    dark = day(1)
    dark.surface.spectra[:, 1] = -0.001
    later = day(2, spot(LARGE_M))
    comparisons = list(compare_days([first, dark, later], (), [SpectralIndex("SR", "R800 / R600")], 0.01))
    assert [one.left_out for one in comparisons] == [("SR",), ()]
    assert "SR" not in comparisons[0].quantities
    assert "SR" in comparisons[1].quantities
    assert "SR" not in comparisons[1].grown  # nobody knows what had changed on the day before
    assert "brightness" in comparisons[1].grown
    write_change_tables(tmp_path, comparisons, {}, {})
    assert [line for line in (tmp_path / "change.md").read_text().splitlines() if "day 1: SR" in line]


def test_undecided_regions_are_striped_in_the_picture(first, alone, tmp_path, monkeypatch):
    (one,) = alone
    views, striped = SideViews(BALL, 40), []
    drawn = views.on_white
    monkeypatch.setattr(
        views, "on_white", lambda colours, stripes=None: striped.append(stripes) or drawn(colours, stripes)
    )
    draw_change(tmp_path / "brightness.png", first, one, one.quantities["brightness"], views)
    assert striped[:3] == [None] * 3
    assert np.array_equal(striped[3], one.quantities["brightness"].undecided)


def test_maps_of_classes_differ_where_a_region_counts(first, alone, tmp_path, monkeypatch):
    """And not where it is undecided; mesh and picture show the same."""
    (one,) = alone
    write_change_tables(tmp_path, alone, {}, {})
    assert json.loads((tmp_path / "change.json").read_text())["classes"] == ["skin", "bruise"]
    write_change_ply(tmp_path / "change.ply", first, alone)
    columns, seen = read_spectral_ply(tmp_path / "change.ply").extra, first.surface.seen
    before, after = columns["class_before"], columns["class_after_1"]
    assert set(before[seen]) == {0.0}
    assert set(before[~seen]) == set(after[~seen]) == {-1.0}
    large, other = spot(LARGE_M, side=-1.0), after != before
    assert set(after[other]) == {1.0}
    assert other[large].mean() > 0.9
    assert large[other].mean() > 0.9
    views, painted = SideViews(BALL, 40), []
    drawn = views.on_white
    monkeypatch.setattr(views, "on_white", lambda colours: painted.append(colours) or drawn(colours))
    draw_class_change(tmp_path / "classes.png", first, one, views)
    skin, bruise = map(to_rgb, COLOURS[:2])
    assert [{*map(tuple, colours[other])} for colours in painted] == [{skin}, {bruise}, {bruise}]
    rest = seen & ~other
    assert [{*map(tuple, colours[rest])} for colours in painted] == [{skin}, {skin}, {(0.97, 0.97, 0.97)}]


def blanks(*fruits):
    """Rows of the table for pairs of captures of one day, without a repeat."""
    titles, *rows = read_results(RESULTS / "change_of_runs.csv")
    table = [dict(zip(titles, row, strict=True)) for row in rows]
    return [
        row
        for row in table
        if row["fruit"] in {f"apple {fruit}" for fruit in fruits}
        and row["second capture of the first day"] == "no"
        and row["bruise grew, cm²"] == ""
    ]


def test_the_limit_follows_from_the_blanks_of_four_apples():
    largest = np.array([float(row["largest undecided, cm²"]) for row in blanks(3, 4, 5, 6)])
    some = largest[largest > 0.0]
    limit_m2 = 1e-4 * some.mean() * np.log(len(some) / len(largest) / 0.01)
    assert len(largest) == 12
    assert pytest.approx(limit_m2, rel=0.02) == LIMIT_M2
    assert pytest.approx(limit_m2 / 0.0162, rel=0.02) == LIMIT_PART


def test_on_three_other_apples_no_blank_shows_a_change():
    others = blanks(7, 8, 9)
    assert len(others) == 9
    assert {row["false change, cm²"] for row in others} == {"0.00"}
