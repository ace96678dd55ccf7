"""Regions drawn in the report: the surface nearest to their points, their files, and proposals to begin with."""

import json

import numpy as np
import pytest
from halved_cylinder import BROWN, two_halves
from random_cloud import random_cloud

from hsi_sc_nerf.analysis.drawn_regions import (
    KIND,
    DrawnRegion,
    points_of_page,
    propose_regions,
    read_drawn_regions,
    write_drawn_regions,
)
from hsi_sc_nerf.analysis.traits import WHOLE, RegionOfInterest, analyse
from hsi_sc_nerf.errors import InputError


def written(path, points_m, **chosen):
    regions = [{"name": name, "points": np.flatnonzero(where).tolist()} for name, where in chosen.items()]
    path.write_text(json.dumps({"kind": KIND, "points_m": points_m.tolist(), "regions": regions}))
    return path


def random_points(surface, count, shift_m=0.0):
    rng = np.random.default_rng(0)
    return rng.choice(surface.mesh.vertices, count, replace=False) + shift_m + rng.normal(0.0, 2e-5, (count, 3))


def test_area_and_spectrum_of_a_drawn_half_which_is_written_as_it_was_read(tmp_path):
    """The edge lies between points, so that an area is neither widened nor narrowed by their spacing."""
    surface = two_halves()
    points_m = random_points(surface, 2000)
    file = written(tmp_path / "regions.json", points_m, brown=points_m[:, 1] < 0.0, top=points_m[:, 2] > 0.03)
    brown, top = read_drawn_regions(file)
    traits = analyse(surface, [brown, top, RegionOfInterest("ball", (0.02, 0.0, 0.02), 0.005)])
    found = {region.name: region for region in traits.regions}
    assert list(found) == [WHOLE, "brown", "top", "ball"]
    assert found["brown"].area_m2 == pytest.approx(surface.mesh.area_m2() / 2.0, rel=0.01)
    np.testing.assert_allclose(found["brown"].spectrum.mean, BROWN, rtol=0.03)
    write_drawn_regions(tmp_path / "again.json", [brown, top])
    for one, again in zip([brown, top], read_drawn_regions(tmp_path / "again.json"), strict=True):
        assert one.name == again.name
        np.testing.assert_array_equal(one.chosen, again.chosen)
        np.testing.assert_allclose(one.points_m, again.points_m, atol=1e-6)


@pytest.mark.parametrize("points_m", [None, np.zeros((3, 3)), np.ones((2, 3))], ids=["none", "more", "others"])
def test_regions_on_different_points_are_not_written_as_if_they_were_on_the_same(tmp_path, points_m):
    one = DrawnRegion("a", np.zeros((2, 3)), np.array([True, False]))
    regions = [] if points_m is None else [one, DrawnRegion("b", points_m, np.arange(len(points_m)) > 0)]
    with pytest.raises(InputError, match=r"regions\.json: takes regions that were drawn among the same points"):
        write_drawn_regions(tmp_path / "regions.json", regions)


def test_regions_of_another_object_and_unseen_ones_are_refused(tmp_path):
    surface = two_halves()
    file = written(tmp_path / "far.json", points_m := random_points(surface, 500, shift_m=0.05), a=points_m[:, 1] < 9)
    with pytest.raises(InputError, match="drawn on another object"):
        analyse(surface, read_drawn_regions(file))
    file = written(tmp_path / "hidden.json", points_m := random_points(surface, 500), a=points_m[:, 1] < 0.0)
    surface.seen[surface.mesh.vertices[:, 1] < 0.012] = False
    with pytest.raises(InputError, match="holds no seen surface"):
        analyse(surface, read_drawn_regions(file))


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "regions"},
        {"points_m": [[0.0, 0.0]]},
        {"points_m": [[0.0, 0.0, 10**400]] * 3},
        {"points_m": [[0.0, 0.0, float("nan")]] * 3},
        {"points_m": None},
        {"regions": []},
        {"regions": [{"name": "a", "points": [3]}]},
        {"regions": [{"name": "a", "points": [-1]}]},
        {"regions": [{"name": "a", "points": [True]}]},
        {"regions": [{"name": "a", "points": []}]},
        {"regions": [{"name": " ", "points": [0]}]},
        {"regions": [["a", [0]]]},
    ],
)
def test_files_that_are_something_else_are_one_sentence(tmp_path, change):
    valid = {"kind": KIND, "points_m": [[0.0, 0.0, 0.1]] * 3, "regions": [{"name": "a", "points": [0]}]}
    file = tmp_path / "regions.json"
    file.write_text(json.dumps(valid))
    assert len(read_drawn_regions(file)) == 1
    file.write_text(json.dumps(valid | change))
    with pytest.raises(InputError, match=r"regions\.json: holds no region"):
        read_drawn_regions(file)
    with pytest.raises(InputError, match=r"no\.json: there is no such file"):
        read_drawn_regions(tmp_path / "no.json")


def test_the_page_has_whole_points_with_what_belongs_to_them():
    cloud = random_cloud(500)
    cloud.spectra[::2, 3] = np.nan
    cloud.extra["height"] = cloud.points[:, 2].copy()
    page = points_of_page(cloud, 100)
    assert len(page) == len(np.unique(page.points, axis=0)) == 100
    assert np.isfinite(page.spectra).all()
    np.testing.assert_array_equal(page.extra["height"], page.points[:, 2])
    assert len(points_of_page(cloud)) == 250
    cloud.spectra[:, 1] = np.nan
    for needs_points in (points_of_page, propose_regions):
        with pytest.raises(InputError, match="no point with a spectrum"):
            needs_points(cloud)
