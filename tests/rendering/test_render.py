import json
from dataclasses import replace
from types import SimpleNamespace

import av
import ball_run
import capture_factory as factory
import numpy as np
import pytest
import spectral
import torch
from PIL import Image

from hsi_sc_nerf.cli.trained_runs import RenderCommand
from hsi_sc_nerf.data.dataparser import pinhole_cameras
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.geometry.camera import in_camera_frame, pixel_rays
from hsi_sc_nerf.models.trained_run import open_trained_run
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.rendering.pictures import find_false_colour, open_video
from hsi_sc_nerf.rendering.views import (
    RenderedView,
    cameras_at,
    render_view,
    views_of_orbit,
    views_of_path,
    visible_points,
    write_view,
)
from hsi_sc_nerf.spectra import COMPOSITES

NM = factory.WAVELENGTHS_NM
HELD_OUT = "ball_8"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return open_packed(ball_run.write_ball_dataset(tmp_path_factory.mktemp("ball") / "data"))


def random_view(lines=5, samples=7):
    generator = torch.Generator().manual_seed(0)
    spectral_ = torch.rand(lines, samples, len(NM), generator=generator)
    return RenderedView(spectral_, torch.rand(lines, samples, generator=generator), torch.ones(lines, samples))


@pytest.mark.parametrize("kind", ["float32", "uint16"])
def test_spy_reads_a_view_as_it_was(tmp_path, dataset, kind):
    view = random_view()
    write_view(tmp_path, "view", view, dataset, kind)
    read = spectral.open_image(str(tmp_path / "view.hdr"))
    assert read.metadata["interleave"] == "bil"
    assert read.dtype == np.dtype(kind)
    assert read.metadata["band names"][0] == "400.00 nm"
    assert read.metadata["default bands"] == ["6", "4", "2"]
    np.testing.assert_allclose(read.bands.centers, NM, atol=1e-6)
    np.testing.assert_allclose(read.bands.bandwidths, 7.0)
    # SPy divides by the reflectance scale factor.
    np.testing.assert_allclose(np.array(read.load()), view.spectral, atol=0.0 if kind == "float32" else 0.51 / 50_000)
    valid = spectral.open_image(str(tmp_path / "view_valid.hdr"))
    np.testing.assert_array_equal(np.array(valid.load())[..., 0], view.opacity > 0.5)
    assert valid.shape == (5, 7, 1)
    assert valid.bands.centers is None


def test_spy_knows_colours_and_widths_from_a_simulated_session_to_its_rendered_views(tmp_path, tiny_dataset):
    simulated = open_packed(tiny_dataset[0])
    shape = (4, 5, len(simulated.wavelengths_nm))
    write_view(tmp_path, "view", RenderedView(torch.rand(shape), *torch.ones(2, *shape[:2])), simulated, "float32")
    for header in (simulated.frames[0].cube_path, tmp_path / "view.hdr"):
        read = spectral.open_image(str(header))
        np.testing.assert_allclose(read.bands.bandwidths, 7.0)
        shown_nm = [read.bands.centers[int(band) - 1] for band in read.metadata["default bands"]]
        assert shown_nm == sorted(shown_nm, reverse=True)
        np.testing.assert_allclose(shown_nm, (598, 548, 449), atol=30)


def test_false_colours_are_the_viewers():
    wavelengths_nm = np.arange(400.0, 1001.0, 10.0)
    values = torch.rand(3, 4, len(wavelengths_nm), generator=torch.Generator().manual_seed(0))
    opacity = torch.ones(3, 4)
    opacity[0] = 0.2
    view = RenderedView(values, opacity, torch.ones(3, 4))
    bands = [int(np.abs(wavelengths_nm - nm).argmin()) for nm in COMPOSITES["CIR"].wavelengths_nm]
    cir = find_false_colour("cir", wavelengths_nm)
    assert cir.name == "CIR"
    torch.testing.assert_close(cir.colours(view), values[..., bands])
    painted = find_false_colour("ndvi", wavelengths_nm).colours(view)
    assert (painted[0] == 0.25).all()
    assert (painted[1:] != 0.25).any(dim=-1).all()
    own = find_false_colour("own = (R800 - R670) / (R800 + R670) [0, 1]", wavelengths_nm)
    assert own.name == "own"
    torch.testing.assert_close(own.colours(view), painted)
    with pytest.raises(InputError, match=r"'own = R800 \[LOW, HIGH\]'"):
        find_false_colour("own = R800", wavelengths_nm)
    with pytest.raises(InputError, match=r"no composite .*CIR.* no index 'beauty'"):
        find_false_colour("beauty", wavelengths_nm)
    with pytest.raises(InputError, match="needs a band near"):
        find_false_colour("NDVI", wavelengths_nm[wavelengths_nm < 650.0])


def test_a_video_holds_its_frames(tmp_path):
    path = tmp_path / "video.mp4"
    shades = (20, 120, 220)
    with open_video(path, 5) as add_frame:
        for shade in shades:
            add_frame(np.full((33, 47, 3), shade, np.uint8))
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.average_rate) == ("h264", 5)
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert [frame.shape for frame in frames] == [(32, 46, 3)] * 3
    np.testing.assert_allclose([frame.mean() for frame in frames], shades, atol=3)


@pytest.mark.parametrize("frames", [1, 40])  # written when the video ends, and while frames are added
def test_a_video_on_a_full_disk_is_one_sentence_and_leaves_nothing(tmp_path, limit_of_files, frames):
    def record(noise):
        with atomic_write(tmp_path / "video.mp4") as (temporary,), open_video(temporary, 5) as add_frame:
            for frame in noise:
                add_frame(frame)

    noise = np.random.default_rng(0).integers(0, 255, (frames, 64, 64, 3), np.uint8)
    told = r"video\.mp4: cannot be written \(.*\); free some space"
    with limit_of_files(100), pytest.raises(InputError, match=told):
        record(noise)
    assert list(tmp_path.iterdir()) == []


def camera_path(tmp_path, pose, **changes):
    camera = {"camera_to_world": pose.reshape(-1).tolist(), "fov": 30.0, "aspect": 1.0}
    content = {"render_height": 20, "render_width": 30, "camera_type": "perspective", "camera_path": [camera] * 2}
    path = tmp_path / "path.json"
    path.write_text(json.dumps(content | changes))
    return path


def test_a_camera_path_is_nerfstudios(tmp_path):
    pose = factory.true_pose(30.0)
    views = views_of_path(camera_path(tmp_path, pose))
    assert [name for name, _ in views] == ["path_000", "path_001"]
    _, camera = next(iter(views))
    np.testing.assert_allclose(camera.camera_to_worlds[0], pose[:3], atol=1e-6)
    assert (camera.height.item(), camera.width.item()) == (20, 30)
    for bad in (camera_path(tmp_path, pose, camera_path=[{}]), camera_path(tmp_path, pose, camera_path=[])):
        with pytest.raises(InputError, match="is not a camera path"):
            views_of_path(bad)
    with pytest.raises(InputError, match="there is no such file"):
        views_of_path(tmp_path / "none.json")


def test_what_cannot_be_rendered_is_refused_before_anything_is_loaded(tmp_path):
    for options in ({"orbit_views": 0}, {"orbit_size": 0.0}, {"frames_per_second": 0}):
        with pytest.raises(InputError, match="it must"):
            RenderCommand(tmp_path / "config.yml", tmp_path, **options).main()
    with pytest.raises(InputError, match="nothing to do"):
        RenderCommand(tmp_path / "config.yml", tmp_path, cubes="none").main()


def test_two_formulas_of_one_name_are_refused(run, tmp_path):
    video = ("X = R500/R600 [0, 2]", "X = R600/R500 [0, 9]")
    with pytest.raises(InputError, match="two of --video have one name"):
        RenderCommand(tmp_path, tmp_path / "out", cubes="none", video=video).main(run)


@pytest.fixture(scope="module")
def run(tmp_path_factory, dataset):
    opened = open_trained_run(ball_run.write_untrained_run(dataset.root, tmp_path_factory.mktemp("runs")))
    ball_run.fill_with_ball(opened)
    return opened


def silhouette(pose, lens=factory.INTRINSICS):
    """Signed distance of each pixel's ray from the ball's outline, in metres at the ball; negative inside."""
    x, y = np.meshgrid(np.arange(lens.w) + 0.5, np.arange(lens.h) + 0.5)
    origin, directions = pixel_rays(lens, pose, np.stack([x, y], axis=-1))
    towards = factory.SPHERE_CENTRE_M - origin
    return np.sqrt(towards @ towards - (directions @ towards) ** 2) - factory.SPHERE_RADIUS_M


@pytest.mark.slow
def test_a_ball_is_rendered_as_it_was_measured(tmp_path, run):
    RenderCommand(tmp_path, tmp_path / "out", video=("pseudo-RGB",)).main(run)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    of_view = {HELD_OUT + end for end in (".hdr", ".raw", ".png", "_valid.hdr", "_valid.raw")}
    assert names == of_view | {"render.md", "render.json", "held-out-pseudo-RGB.mp4"}
    cube, valid = (
        np.array(spectral.open_image(str(tmp_path / "out" / f"{HELD_OUT}{end}.hdr")).load()) for end in ("", "_valid")
    )
    valid = valid[..., 0]
    distance = silhouette(factory.true_pose(36.0 * int(HELD_OUT[-1])))
    np.testing.assert_array_equal(valid[distance < -0.002], 1)
    np.testing.assert_array_equal(valid[distance > 0.0], 0)
    assert np.abs(cube[distance < -0.003] - factory.PLANT).max() < 2e-3
    # Pixels on the outline show some of both.
    np.testing.assert_allclose(cube[distance > 0.003], factory.BACKGROUND, atol=1e-5)
    outline = cube[np.abs(distance) < 0.0005]
    assert (np.abs(outline - factory.PLANT).max(axis=-1) > 0.01).any()
    assert (np.abs(outline - factory.BACKGROUND).max(axis=-1) > 0.01).all()
    (row,) = json.loads((tmp_path / "out" / "render.json").read_text())["views"]
    assert row["view"] == HELD_OUT
    assert row["rmse"] < 0.1
    assert f"| {HELD_OUT} |" in (tmp_path / "out" / "render.md").read_text()
    assert Image.open(tmp_path / "out" / f"{HELD_OUT}.png").width > 1000


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["float32", "uint16"])
def test_views_of_the_material_show_the_cloud_that_tells_it(tmp_path, run, kind):
    cloud = ball_run.write_material_cloud(tmp_path / "material.ply", material=factory.PLANT / 0.8)
    RenderCommand(tmp_path, tmp_path / "out", material=cloud, cubes=kind).main(run)
    measured, found = (
        np.array(spectral.open_image(str(tmp_path / "out" / f"{HELD_OUT}{end}.hdr")).load())
        for end in ("", "_material")
    )
    distance = silhouette(factory.true_pose(36.0 * int(HELD_OUT[-1])))
    inside, outside = distance < -0.003, distance > 0.0
    np.testing.assert_allclose(measured[inside] / 0.8, found[inside], atol=4e-3)
    # SPy divides a value without data as well.
    assert (np.isnan(found[outside]) if kind == "float32" else found[outside] > 1.3).all()


def test_points_that_a_view_shows_lie_on_the_rays_as_the_model_refines_them(dataset):
    poses, shift = (
        np.stack([frame.camera_to_world for frame in dataset.frames[:1]]),
        torch.tensor([0.02, -0.01, 0.03]),
    )
    camera = pinhole_cameras(poses, dataset.intrinsics, dataset.distortion)
    lines, samples = dataset.intrinsics.h, dataset.intrinsics.w
    names = {"spectral": len(NM), "accumulation": 1, "depth": 1}
    outputs = {name: torch.ones(lines, samples, channels) for name, channels in names.items()}

    def move(rays):
        rays.origins = rays.origins + torch.nn.Parameter(shift)

    model = SimpleNamespace(device="cpu", get_outputs_for_camera=lambda camera: outputs)
    model.camera_optimizer = SimpleNamespace(apply_to_raybundle=move)
    view = render_view(model, camera)
    moved, as_measured = (visible_points(camera, one) for one in (view, replace(view, model=None)))
    np.testing.assert_allclose(np.linalg.norm(as_measured - poses[0, :3, 3], axis=-1), 1.0, atol=1e-5)
    np.testing.assert_allclose(moved - as_measured, np.broadcast_to(shift, moved.shape), atol=1e-6)


def test_an_orbit_of_another_size_without_cubes(tmp_path, run):
    RenderCommand(
        tmp_path,
        tmp_path / "out",
        views="orbit",
        orbit_views=3,
        orbit_size=0.5,
        cubes="none",
        video=("pseudo-RGB", "PSEUDO-rgb"),
    ).main(run)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "render.md",
        "render.json",
        "orbit-pseudo-RGB.mp4",
    }
    with av.open(str(tmp_path / "out" / "orbit-pseudo-RGB.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert [frame.shape for frame in frames] == [(24, 24, 3)] * 3


@pytest.mark.parametrize(("angle_deg", "size"), [(0.0, 0.01), (0.0, float("nan")), (float("nan"), 1.0)])
def test_views_without_pixels_or_place_are_refused_in_a_sentence(run, angle_deg, size):
    with pytest.raises(InputError, match="finite angles and images of a pixel"):
        cameras_at(run, np.array([angle_deg]), size)


def test_a_run_that_fails_leaves_no_video(tmp_path, run, monkeypatch):
    from hsi_sc_nerf.rendering import views as render_views

    render_view, seen = render_views.render_view, []

    def fail_at_the_second(model, camera):
        seen.append(camera)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return render_view(model, camera)

    monkeypatch.setattr(render_views, "render_view", fail_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        RenderCommand(tmp_path, tmp_path, views="orbit", orbit_views=3, orbit_size=0.3, video=("pseudo-RGB",)).main(
            run
        )
    assert {path.name for path in tmp_path.iterdir()} == {
        f"orbit_000{end}" for end in (".hdr", ".raw", "_valid.hdr", "_valid.raw")
    }


def test_an_orbit_is_one_turn_before_a_chamber_that_stands_still(run):
    views, behind = views_of_orbit(run, 4), []
    centres_m = run.to_metres(views.cameras.camera_to_worlds[:, :, 3].numpy())
    np.testing.assert_allclose(centres_m, [factory.true_pose(angle)[:3, 3] for angle in (0, 90, 180, 270)], atol=1e-6)
    for _, camera in views:
        rays = camera.generate_rays(camera_indices=0, keep_shape=True)
        behind.append(in_camera_frame(rays.directions, rays.metadata["camera_rotation"]))
    for directions in behind[1:]:
        torch.testing.assert_close(directions, behind[0], atol=1e-6, rtol=0)
