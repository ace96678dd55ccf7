"""The tables that `traits` prints and writes."""

import pytest

from hsi_sc_nerf.analysis.report import trait_tables
from hsi_sc_nerf.analysis.traits import WHOLE

SIZES = ("area_m2", "volume_l", "height_m", "largest_diameter_m", "smallest_diameter_m", "equivalent_diameter_m")
BALL = {
    "size": dict.fromkeys(SIZES, 0.07),
    "size_sd": None,
    "size_sd_by_cause": {},
    "seen_area_m2": 0.01,
    "watertight": True,
    "classes": None,
}
"""Content of ``traits.json`` without its regions."""
REGION = {"area_m2": 0.01, "indices": {}, "reflectance": {"mean": 0.4, "std": None}}


@pytest.mark.parametrize(
    ("height_m", "sd_m", "shown"),
    [
        (0.078341, 8.5e-6, "78.3410 ± 0.0085"),
        (0.078341, 3.4e-4, "78.34 ± 0.34"),
        (0.078341, 9.96e-4, "78.3 ± 1.0"),
        (0.078341, 0.0123, "78 ± 12"),
        (0.078341, 0.0, "78.34 ± 0"),
        (0.078341, None, "78.34"),
    ],
)
def test_sizes_have_the_decimals_of_their_uncertainty(height_m, sd_m, shown):
    sizes_m = {"size": dict.fromkeys(SIZES, height_m)}
    if sd_m is not None:
        sizes_m |= {"size_sd": dict.fromkeys(SIZES, sd_m), "size_sd_by_cause": {"base": dict.fromkeys(SIZES, sd_m)}}
    sizes, _ = trait_tables({**BALL, **sizes_m, "regions": {WHOLE: REGION}})
    assert ["height", shown, "mm"] in sizes.rows
    assert ("the unseen base" in sizes.note) == (sd_m is not None)
    assert ("the scale" in sizes.note) == (sd_m is not None)


@pytest.mark.parametrize("settings", [{}, {"metric": False}])
def test_sizes_of_a_session_without_a_scale_are_said_to_be_wrong(settings):
    sizes, _ = trait_tables({**BALL, "settings": settings, "regions": {WHOLE: REGION}})
    assert ("wrong" in sizes.note) == bool(settings)


@pytest.mark.parametrize(("std", "shown"), [(0.021, "0.530 ± 0.021"), (None, "0.53")])
def test_the_light_of_a_region_stands_beside_its_brightness(std, shown):
    of_spot = {"mean": 0.377, "std": 0.004, "measured": 0.2, "irradiance": 0.53, "irradiance_std": std}
    regions = {
        name: {"area_m2": area_m2, "indices": {}, "reflectance": of_spot}
        for name, area_m2 in ((WHOLE, 0.01), ("spot", 0.00071))
    }
    _, brightness = trait_tables({**BALL, "regions": regions})
    areas = {WHOLE: "100.00", "spot": "7.10"}
    assert brightness.rows == [[name, area, "0.3770 ± 0.0040", "0.200", shown] for name, area in areas.items()]
