"""Checks of masks on silhouettes of a sphere and of walls, whose findings are known."""

from dataclasses import replace

import numpy as np
import pytest
from capture_factory import SPHERE_CENTRE_M, SPHERE_RADIUS_M, sphere_mask, true_pose

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.packed.dataset import Container
from hsi_sc_nerf.processing.lid_regions import above_lid, lid_middle
from hsi_sc_nerf.processing.mask_checks import check_masks
from hsi_sc_nerf.processing.visual_hull import voted_hull

INTRINSICS = PinholeIntrinsics(64, 64, 120.0, 120.0, 32.0, 32.0)
CONTAINER = Container(diameter_m=0.09, height_m=0.07)
FRAMES = 12
POSES = np.stack([true_pose(angle) for angle in np.arange(FRAMES) * 360.0 / FRAMES])
NAMES = [f"ball_{i}" for i in range(FRAMES)]
NOTHING = np.zeros(FRAMES, bool)
REGIONS = np.stack([above_lid(INTRINSICS, np.zeros(4), pose, CONTAINER, overhang=1.2) for pose in POSES])


def ball(pose, offset_m=(0.0, 0.0, 0.0), radius_m=SPHERE_RADIUS_M) -> np.ndarray:
    return sphere_mask(pose, INTRINSICS, SPHERE_CENTRE_M + offset_m, radius_m)


def good_masks() -> np.ndarray:
    return np.stack([ball(pose) for pose in POSES])


def seen(masks, change=0.05) -> np.ndarray:
    """Brightness of a still wall with noise; what the masks show changes by more."""
    rng = np.random.default_rng(0)
    wall = rng.uniform(0.2, 0.8, masks.shape[1:])
    return wall + rng.normal(0.0, 0.005, masks.shape) + masks * rng.normal(0.0, change, masks.shape)


def findings(masks, brightness=None, regions=None) -> dict[str, str]:
    brightness = seen(masks) if brightness is None else brightness
    return {finding.name: finding.level for finding in checked(masks, brightness, regions)}


def checked(masks, brightness, regions=None, lid_middles=None, left_out=NOTHING):
    hull = voted_hull(masks, POSES, INTRINSICS)
    return check_masks(masks, NAMES, hull, brightness, left_out, silhouettes_of, regions, lid_middles)


def silhouettes_of(masks):
    return voted_hull(masks, POSES, INTRINSICS).silhouettes


def test_good_masks_have_no_finding():
    assert findings(good_masks(), regions=REGIONS) == {}


@pytest.mark.parametrize(("number", "level"), [(1, "red"), (12, "red")])
def test_empty_masks_are_named(number, level):
    masks = good_masks()
    masks[:number] = False
    (finding,) = [f for f in checked(masks, seen(masks)) if f.name == "masks-empty"]
    assert (finding.level, finding.values["frames"]) == (level, NAMES[:number])


def test_a_mask_at_the_border_of_the_image():
    masks = good_masks()
    masks[0, :, :40] |= ball(POSES[0])[:, 24:]
    masks[0, 0, 30] = True
    assert findings(masks)["masks-border"] == "amber"
    masks[:, 0, 30] = True
    assert findings(masks)["masks-border"] == "red"


@pytest.mark.parametrize(("frames", "named"), [(3, set()), (4, {"masks-pieces"})])
def test_a_piece_that_many_masks_leave_out_is_told(frames, named):
    masks = good_masks()
    found = checked(masks, seen(masks), left_out=np.arange(FRAMES) < frames)
    assert {(finding.name, finding.level) for finding in found} == {(name, "amber") for name in named}


def test_masks_of_a_wall_are_cut_by_the_space_above_the_lid():
    wall = np.zeros((64, 64), bool)
    wall[5:30, 2:-2] = True
    assert findings(wall & REGIONS, regions=REGIONS)["masks-cut"] == "red"


@pytest.mark.parametrize(("beside_m", "named"), [(0.003, {}), (0.015, {"masks-cut": "amber"})])
def test_an_object_that_reaches_beyond_the_space_above_the_lid_is_told(beside_m, named):
    masks = np.stack([ball(pose, (beside_m, 0.0, 0.0)) for pose in POSES])
    assert findings(masks & REGIONS, regions=REGIONS) == named


def test_masks_that_stand_still_show_the_wall():
    still = np.broadcast_to(ball(POSES[0], offset_m=-SPHERE_CENTRE_M + [0, 0, 0.1]), (FRAMES, 64, 64))
    assert findings(still, seen(still, change=0.0))["masks-static"] == "red"
    assert "masks-static" not in findings(still, seen(still))
    turning = good_masks()
    assert "masks-static" not in findings(turning, seen(turning, change=0.0))


def test_a_body_of_revolution_stands_on_the_lid_and_a_wall_is_behind_it():
    middles = np.stack([lid_middle(INTRINSICS, pose, CONTAINER) for pose in POSES])
    on_the_lid = -SPHERE_CENTRE_M + [0.0, 0.0, CONTAINER.height_m + SPHERE_RADIUS_M]
    body = np.broadcast_to(ball(POSES[0], offset_m=on_the_lid), (FRAMES, 64, 64))
    of_wall = body & (np.arange(64) < np.nonzero(middles[0])[0].min())[:, None]
    for masks, names in ((body, set()), (of_wall, {"masks-static"})):
        found = checked(masks, seen(masks, change=0.0), lid_middles=middles)
        assert {finding.name for finding in found} & {"masks-static"} == names


def test_masks_that_contradict_each_other():
    masks = good_masks()
    patch = np.zeros((64, 64), bool)
    patch[10:30, 10:24] = True
    assert findings(masks | patch)["masks-hull"] == "red"


def test_a_narrow_object_differs_from_its_hull_as_the_vote_makes_it():
    """The hull is wider than the masks by a pixel, which is 9 % of this object."""
    masks = good_masks()

    def wider(masks):
        return np.stack([dilate(mask, 3) for mask in masks])

    hull = replace(voted_hull(masks, POSES, INTRINSICS), silhouettes=wider(masks))

    def names(silhouettes_of):
        return {f.name for f in check_masks(masks, NAMES, hull, seen(masks), NOTHING, silhouettes_of)}

    assert names(lambda others: others) == {"masks-hull"}
    assert names(wider) == set()


@pytest.mark.parametrize("other", [{"offset_m": (0.0, 0.0, 0.012)}, {"radius_m": 0.034}, {"radius_m": 0.046}])
def test_a_frame_of_another_object_is_named(other):
    masks = good_masks()
    masks[5] = ball(POSES[5], **other)
    (finding,) = checked(masks, seen(masks))
    assert (finding.name, finding.level, list(finding.values["frames"])) == ("frames-hull", "red", ["ball_5"])
    assert "--exclude ball_5" in finding.sentence


@pytest.mark.parametrize(("count", "span_deg"), [(2 * FRAMES, 180.0), (FRAMES, 90.0)])
def test_the_ends_of_a_part_of_a_turn_show_no_other_object(count, span_deg):
    """Only they carve the hull from their directions, and the others outvote them."""
    poses = np.stack([true_pose(angle) for angle in np.linspace(0.0, span_deg, count)])
    masks = np.stack([ball(pose, (0.02, 0, 0), 0.025) | ball(pose, (-0.02, 0, 0), 0.025) for pose in poses])

    def hull_of(masks):
        return voted_hull(masks, poses, INTRINSICS)

    def frames_named(masks):
        names = [str(frame) for frame in range(count)]
        nothing = np.zeros(count, bool)
        found = check_masks(
            masks, names, hull_of(masks), seen(masks), nothing, lambda others: hull_of(others).silhouettes
        )
        return [[*finding.values["frames"]] for finding in found]

    assert frames_named(masks) == []
    masks[0] = ball(poses[0], (0.02, 0, 0), 0.025)
    assert frames_named(masks) == [["0"]]


@pytest.mark.parametrize(("shows", "found"), [("what the other frames show there", []), ("fruit", ["frames-hull"])])
def test_a_part_beyond_the_hull_is_another_object_only_if_it_shows_something_else(shows, found):
    """Noise on the lid is trimmed; it is no reason to leave the frame out."""
    masks = good_masks()
    brightness = seen(masks)
    masks[5, 44:52, 20:44] = True
    if shows == "fruit":
        brightness[5, 44:52, 20:44] = 0.4
    assert list(findings(masks, brightness)) == found
