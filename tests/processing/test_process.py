import json
import logging
import re
import shutil
import sys
import weakref
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from capture_factory import (
    BACKGROUND,
    INFO,
    INTRINSICS,
    PLANT,
    SPHERE_CENTRE_M,
    SPHERE_RADIUS_M,
    WAVELENGTHS_NM,
    expose,
    frame_reflectance,
    sphere_mask,
    true_pose,
    true_poses,
    write_capture,
    write_session,
)

from hsi_sc_nerf.calibration.session_calibration import CalibrationConfig
from hsi_sc_nerf.capture.envi import write_cube
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.inspection import inspect
from hsi_sc_nerf.packed.cube import REFLECTANCE_SCALE
from hsi_sc_nerf.packed.dataset import Container, open_packed
from hsi_sc_nerf.poses.pose_methods import find_poses
from hsi_sc_nerf.processing import process, session_masks
from hsi_sc_nerf.processing.frames import pack_frames
from hsi_sc_nerf.processing.masks import MaskConfig, foreground_masks
from hsi_sc_nerf.processing.painted_masks import painted_box
from hsi_sc_nerf.processing.posed_frames import container_under, known_camera
from hsi_sc_nerf.processing.process import ProcessConfig, process_session

ANGLES_DEG = (0.0, 90.0, 180.0, 270.0)
DARK_TARP = np.zeros((20, 20, len(WAVELENGTHS_NM)), np.uint16)


def run(session, output, config=None, poses=true_poses):
    return process_session(session, output, config or ProcessConfig(), progress=False, estimate_poses=poses)


@pytest.fixture
def session(tmp_path, blank_figures):
    return write_session(tmp_path / "session", ANGLES_DEG)


@pytest.fixture(scope="module")
def processed_once(tmp_path_factory):
    root = tmp_path_factory.mktemp("processed")
    run(write_session(root / "session", ANGLES_DEG), root / "data")
    return root


@pytest.fixture
def processed(processed_once, tmp_path, blank_figures):
    """A session and its dataset, with the files' times."""
    shutil.copytree(processed_once, tmp_path, dirs_exist_ok=True)
    return tmp_path / "session", tmp_path / "data"


def written(output) -> dict[str, int]:
    """When each frame's cube was written, by its name."""
    return {path.stem: path.stat().st_mtime_ns for path in (output / "cubes").glob("*.bip")}


def rewritten(output, before: dict[str, int]) -> list[str]:
    """Names of the frames that were packed since."""
    return sorted(name for name, time in written(output).items() if time != before.get(name))


def no_markers(images, names, **_):
    raise InputError("no marker was found")


@pytest.mark.slow
def test_the_dataset_that_gives_the_camera_is_not_replaced(processed):
    session, output = processed
    with pytest.raises(InputError, match="that --camera names"):
        run(session, output, ProcessConfig(camera=output), poses=no_markers)
    assert (output / "transforms.json").exists()


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the process's maps from /proc")
def test_pictures_of_the_inspection_and_maps_of_frames_are_not_kept(session, tmp_path, monkeypatch):
    pictures, mapped = [], []

    def inspected(*args, **kwargs):
        found = inspect.inspect_session(*args, **kwargs)
        pictures.extend(weakref.ref(look.picture) for look in found.quicklooks)
        return found

    def masked(bins, *args, **kwargs):
        assert len(pictures) == len(bins) == len(ANGLES_DEG)
        assert [picture() for picture in pictures] == [None] * len(pictures)
        found = foreground_masks(bins, *args, **kwargs)
        mapped.extend(re.findall(r"\S+\.bins", Path("/proc/self/maps").read_text()))
        return found

    monkeypatch.setattr(process, "inspect_session", inspected)
    monkeypatch.setattr(session_masks, "foreground_masks", masked)
    run(session, tmp_path / "data")
    assert mapped == []


@pytest.mark.slow
def test_a_cube_that_vanishes_is_named_and_leaves_nothing_half_written(session, tmp_path, monkeypatch):
    (cube,) = (path for path in session.rglob("*ball_3.raw") if "REF" not in path.name)

    def packed(*args, **kwargs):
        cube.unlink()
        return pack_frames(*args, **kwargs)

    monkeypatch.setattr(process, "pack_frames", packed)
    # The entry makes one line of both kinds.
    with pytest.raises((InputError, FileNotFoundError), match=re.escape(cube.name)):
        run(session, tmp_path / "data")
    assert not (tmp_path / "data" / "transforms.json").exists()
    assert not list(tmp_path.rglob(".partial-*"))


@pytest.mark.slow
def test_session_to_dataset(processed):
    _, output = processed
    dataset = open_packed(output)
    assert [frame.capture for frame in dataset.frames] == ["ball_1", "ball_2", "ball_3", "ball_4"]
    assert dataset.intrinsics == INTRINSICS
    assert dataset.container == Container(0.09, 0.07)
    assert (dataset.image_rotation_deg, dataset.origin_on_disc) == (0, True)
    assert (dataset.object_name, dataset.pose_method) == ("ball", "markers")
    np.testing.assert_array_equal(dataset.wavelengths_nm, WAVELENGTHS_NM)
    np.testing.assert_allclose(dataset.background_reflectance, BACKGROUND, atol=2e-3)
    assert dataset.pseudo_rgb_nm.tolist() == [WAVELENGTHS_NM[i] for i in (4, 3, 1)]
    for frame, angle in zip(dataset.frames, ANGLES_DEG, strict=True):
        truth = frame_reflectance(angle)
        np.testing.assert_allclose(frame.cube() / REFLECTANCE_SCALE, truth, atol=1e-3)
        np.testing.assert_allclose(frame.pseudo_rgb() / 255.0, truth[..., [4, 3, 1]], atol=5e-3)
        ball = sphere_mask(true_pose(angle))
        mask = frame.mask()
        assert (mask & ball).sum() / (mask | ball).sum() > 0.97
        np.testing.assert_array_equal(frame.camera_to_world, true_pose(angle))
        assert frame.angle_deg == angle
    assert PLANT.min() < 0.2
    low, high = dataset.object_box_m
    assert (low[:2] <= SPHERE_CENTRE_M[:2] - SPHERE_RADIUS_M + 1e-3).all()
    assert (high >= SPHERE_CENTRE_M + SPHERE_RADIUS_M - 1e-3).all()
    assert low[2] == 0.07
    assert (dataset.scene_box_m[0] < low).all()
    assert dataset.scene_box_m[0, 2] < 0.0
    assert dataset.scene_box_m[1, 0] >= 0.08  # a marker on the disc
    for picture in ("white_reference", "masks", "poses"):
        assert cv2.imread(str(output / "report" / f"{picture}.png")).std() > 1.0
    assert json.loads((output / "poses.json").read_text())["marker_dictionary"] == "DICT_5X5_50"
    (note,) = output.glob(".cache/masks*")
    assert painted_box(dataset) is None
    note.unlink()
    assert painted_box(dataset) is None  # after a look at the masks
    assert not [path for path in output.rglob("*") if "partial" in path.name]


@pytest.mark.slow
def test_a_session_of_finished_reflectance(tmp_path):
    session = tmp_path / "session"
    for number, angle in enumerate(ANGLES_DEG, start=1):
        finished = np.rot90(frame_reflectance(angle)).astype(np.float32)
        write_cube(session / f"REFLECTANCE_ball_{number}.hdr", finished, wavelengths_nm=WAVELENGTHS_NM)
    (session / "session.json").write_text(json.dumps({**INFO, "image_rotation_deg": 90}))
    output = run(session, tmp_path / "data")
    dataset = open_packed(output)
    assert dataset.uncertainty is None
    for frame, angle in zip(dataset.frames, ANGLES_DEG, strict=True):
        np.testing.assert_allclose(frame.cube() / REFLECTANCE_SCALE, frame_reflectance(angle), atol=1e-4)
    assert sorted(path.name for path in (output / "report").iterdir()) == [
        "effects.png",
        "inspection.json",
        "masks.png",
        "poses.png",
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_the_pose_estimate_gets_what_the_session_tells(tmp_path):
    """A session in a plain folder."""
    info = {**INFO, "nominal_step_deg": 90, "direction": "ccw", "marker_dictionary": "DICT_4X4_50"}
    session = write_session(tmp_path / "session", ANGLES_DEG, specim=False, info=info)
    got = {}

    def poses(images, names, **options):
        got.update(options, images=images, names=names)
        return true_poses(images, names)

    run(session, tmp_path / "data", ProcessConfig(marker_side_m=0.04), poses=poses)
    assert got["names"] == ["ball_1", "ball_2", "ball_3", "ball_4"]
    info = got["info"]
    assert (info.marker_dictionary, info.marker_side_m) == ("DICT_4X4_50", 0.04)
    assert (info.nominal_step_deg, info.direction, info.image_rotation_deg) == (90, "ccw", 0)
    assert (info.container_diameter_m, info.container_height_m) == (0.09, 0.07)
    visible = (WAVELENGTHS_NM >= 450.0) & (WAVELENGTHS_NM <= 700.0)
    for image, angle in zip(got["images"], ANGLES_DEG, strict=True):
        assert image.dtype == np.uint8
        np.testing.assert_allclose(image, 255 * frame_reflectance(angle)[..., visible].mean(-1), atol=1.0)


@pytest.mark.slow
def test_the_same_input_is_processed_once_and_other_settings_redo_what_depends_on_them(processed):
    session, output = processed
    before, stamp = written(output), (output / "transforms.json").stat().st_mtime_ns
    assert run(session, output, poses=no_markers) == output
    assert run(session, output, ProcessConfig(workers=1), poses=no_markers) == output
    assert rewritten(output, before) == []
    assert (output / "transforms.json").stat().st_mtime_ns == stamp
    run(session, output, ProcessConfig(masks=MaskConfig(threshold=0.1)))
    assert rewritten(output, before) == []
    run(session, output, ProcessConfig(calibration=CalibrationConfig(bounds=(0.0, 0.9))))
    assert rewritten(output, before) == ["ball_1", "ball_2", "ball_3", "ball_4"]


@pytest.mark.slow
def test_a_changed_panel_is_noticed(session, tmp_path):
    (session / "session.json").write_text(json.dumps({**INFO, "panel_reflectance": "panel.csv"}))
    for white in (1.0, 0.9):
        (session / "panel.csv").write_text(f"400,{white}\n1000,{white}\n")
        cube = open_packed(run(session, tmp_path / "data")).frames[0].cube()
        np.testing.assert_allclose(cube / REFLECTANCE_SCALE, white * frame_reflectance(0.0), atol=1e-3)


@pytest.mark.slow
def test_a_changed_earlier_camera_is_noticed(processed, tmp_path):
    session, earlier = processed
    config = ProcessConfig(camera=earlier)
    output = run(session, tmp_path / "other", config)
    assert run(session, output, config, poses=no_markers) == output
    transforms = earlier / "transforms.json"
    transforms.write_text(transforms.read_text() + "\n")
    with pytest.raises(InputError, match="no marker was found"):
        run(session, output, config, poses=no_markers)


@pytest.mark.parametrize(
    ("angles_deg", "direction"),
    [((0.0, 90.0, 180.0), "ccw"), ((0.0, -90.0, -180.0), "cw"), ((0.0, 90.0, -90.0), None), ((0.0,), None)],
)
def test_an_earlier_session_tells_how_the_table_turns(angles_deg, direction):
    frames = [SimpleNamespace(angle_deg=angle, camera_to_world=true_pose(angle)) for angle in angles_deg]
    for metric in (True, False):
        for method, stated, on_disc in (("markers", None, True), ("colmap", None, False), ("markers", False, False)):
            earlier = SimpleNamespace(
                frames=frames,
                intrinsics=INTRINSICS,
                distortion=np.zeros(4),
                metric=metric,
                container=None,
                pose_method=method,
                origin_on_disc=stated,
                image_rotation_deg=90,
            )
            camera = known_camera(earlier)
            assert (camera.direction, camera.metric, camera.on_disc) == (direction, metric, on_disc)
            assert camera.image_rotation_deg == 90
    np.testing.assert_allclose(camera.camera_to_world, true_pose(0.0), atol=1e-12)


def test_without_a_known_height_of_the_disc_that_of_the_lid_is_unknown():
    session = SimpleNamespace(info=SimpleNamespace(container_diameter_m=0.09, container_height_m=0.07))
    poses = true_poses([None] * 4, ["a", "b", "c", "d"])
    assert container_under(session, poses) == Container(0.09, 0.07)
    assert container_under(session, replace(poses, disc_markers=())) is None
    assert container_under(session, replace(poses, disc_markers=(), disc_by_container=True)) is not None


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_a_camera_of_a_session_without_a_scale_gives_none(tmp_path):
    info = {"object": "ball", "nominal_step_deg": 90, "direction": "ccw"}
    session = write_session(tmp_path / "session", ANGLES_DEG, info=info)

    def unscaled(*given, **options):
        return replace(true_poses(*given, **options), metric=False)

    earlier = run(session, tmp_path / "earlier", ProcessConfig(poses="colmap"), poses=unscaled)
    output = run(session, tmp_path / "data", ProcessConfig(poses="angles", camera=earlier), poses=find_poses)
    assert not open_packed(output).metric
    findings = json.loads((output / "report" / "inspection.json").read_text())["findings"]
    assert [f["level"] for f in findings if f["name"] in ("scale", "poses-no-scale")] == ["amber", "amber"]


@pytest.mark.slow
def test_a_changed_capture_is_done_again_alone_and_an_outdated_dataset_does_not_survive_a_failure(session, tmp_path):
    # All of that frame gets darker, which would be taken for the lamps.
    config = ProcessConfig(calibration=CalibrationConfig(lamp_drift="never"))
    output = run(session, tmp_path / "data", config)
    before = written(output)
    write_capture(session, "ball_3", expose(frame_reflectance(180.0) * 0.9))
    with pytest.raises(InputError, match="no marker was found"):
        run(session, output, config, poses=no_markers)
    assert not (output / "transforms.json").exists()
    run(session, output, config)
    assert rewritten(output, before) == ["ball_3"]
    cube = open_packed(output).frames[2].cube()
    np.testing.assert_allclose(cube / REFLECTANCE_SCALE, 0.9 * frame_reflectance(180.0), atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("lost", ["masks/ball_1.png", "cubes/ball_2.bip"])
def test_damaged_output_is_made_again(processed, lost):
    session, output = processed
    before = written(output)
    data = output / "cubes" / "ball_2.bip"
    data.write_bytes(data.read_bytes()[:-2])
    before |= {"ball_2": 0}
    (output / lost).unlink()
    run(session, output)
    assert rewritten(output, before) == ["ball_2"]
    assert open_packed(output).frames[0].mask().any()


@pytest.mark.slow
@pytest.mark.parametrize("lost", ["calibration.json", "poses.json"])
def test_a_lost_report_is_written_again_and_no_frame_is(processed, lost):
    session, output = processed
    before, told = written(output), (output / lost).read_bytes()
    (output / lost).unlink()
    run(session, output)
    assert rewritten(output, before) == []
    assert (output / lost).read_bytes() == told


@pytest.mark.slow
def test_a_stopped_run_goes_on(session, tmp_path):
    one_by_one = ProcessConfig(workers=1)
    in_the_way = tmp_path / "data" / "cubes" / "ball_3.bip"
    in_the_way.mkdir(parents=True)
    with pytest.raises(InputError, match="ball_3"):
        run(session, tmp_path / "data", one_by_one)
    assert not (tmp_path / "data" / "transforms.json").exists()
    in_the_way.rmdir()
    before = written(tmp_path / "data")
    assert {"ball_1", "ball_2"} <= before.keys()
    output = run(session, tmp_path / "data", one_by_one)
    assert not {"ball_1", "ball_2"} & set(rewritten(output, before))
    assert len(open_packed(output).frames) == 4


@pytest.mark.slow
def test_frames_without_a_pose_are_left_out_with_a_warning(session, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        output = run(session, tmp_path / "data", poses=partial(true_poses, unused=("ball_2",)))
    assert "ball_2" in caplog.text
    assert [frame.capture for frame in open_packed(output).frames] == ["ball_1", "ball_3", "ball_4"]


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_a_frame_in_which_nothing_was_found_is_named(tmp_path, caplog):
    angles_deg = tuple(np.arange(20) * 18.0)
    session = write_session(tmp_path / "session", angles_deg)
    write_capture(session, "ball_7", expose(np.full((48, 48, len(WAVELENGTHS_NM)), BACKGROUND)))
    with caplog.at_level(logging.WARNING):
        config = ProcessConfig(accept=("other-object",))
        output = run(session, tmp_path / "data", config, poses=partial(true_poses, angles_deg=angles_deg))
    told = [record.getMessage() for record in caplog.records if "masks-empty" in record.getMessage()]
    assert len(told) == 1
    assert "ball_7" in told[0]
    assert [frame.capture for frame in open_packed(output).frames if not frame.mask().any()] == ["ball_7"]


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_names_are_printed_as_they_are(tmp_path, capsys):
    info = {**INFO, "white_reference": "[white]"}
    session = write_session(tmp_path / "[session]", ANGLES_DEG, info=info)
    (session / "white_reference").rename(session / "[white]")
    for _ in range(2):
        process_session(session, tmp_path / "[apple]", estimate_poses=true_poses)
    # Lines are broken wherever the folder's path makes them too long.
    printed = "".join(capsys.readouterr().err.split())
    for words in ("the tarp in [white].", "[apple]: 4 frames are ready", "[apple]: is up to date"):
        assert words.replace(" ", "") in printed


@pytest.mark.parametrize(
    ("spoil", "config", "message"),
    [
        (lambda session: None, ProcessConfig(workers=0), "--workers is 0"),
        (lambda session: (session / "session.json").unlink(), None, "nothing gives a scale; state marker_side_m"),
        (lambda session: write_capture(session, "white_reference", DARK_TARP), None, "white_reference is dark"),
    ],
)
def test_what_cannot_be_processed_is_refused_before_anything_is_written(session, tmp_path, spoil, config, message):
    spoil(session)
    with pytest.raises(InputError, match=message):
        run(session, tmp_path / "data", config)
    assert not (tmp_path / "data").exists()


def test_another_dataset_is_not_overwritten(session, tmp_path):
    other = tmp_path / "data" / "transforms.json"
    other.parent.mkdir()
    other.write_text('{"frames": []}')
    with pytest.raises(InputError, match="another kind of dataset"):
        run(session, tmp_path / "data")
    assert other.read_text() == '{"frames": []}'


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_an_object_wider_than_its_container_is_not_cut_off(tmp_path):
    session = write_session(tmp_path / "session", ANGLES_DEG, info={**INFO, "container_diameter_m": 0.05})
    narrow = ProcessConfig(masks=MaskConfig(overhang=1.2))
    with pytest.raises(InputError, match="--accept masks-cut"):
        run(session, tmp_path / "narrow", narrow)
    frames = open_packed(run(session, tmp_path / "data")).frames
    for frame, angle_deg in zip(frames, ANGLES_DEG, strict=True):
        assert (frame.mask() ^ sphere_mask(true_pose(angle_deg))).sum() < 0.02 * frame.mask().sum()


@pytest.mark.slow
def test_wrong_masks_are_refused_after_their_picture_is_drawn(session, tmp_path, monkeypatch):
    def everything_above_the_lid(bins, config, regions):
        return regions.copy(), np.zeros(len(regions), bool)

    monkeypatch.setattr(session_masks, "foreground_masks", everything_above_the_lid)
    with pytest.raises(InputError, match="--accept masks-border"):
        run(session, tmp_path / "data")
    assert (tmp_path / "data" / "report" / "masks.png").is_file()
    assert not (tmp_path / "data" / "transforms.json").exists()
    accepted = ProcessConfig(accept=("masks-border", "masks-cut", "masks-static", "masks-hull"))
    assert open_packed(run(session, tmp_path / "data", accepted)).frames[0].mask().mean() > 0.1
