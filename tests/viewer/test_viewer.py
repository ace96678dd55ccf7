"""The spectral panel in nerfstudio's viewer."""

import math
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
import torch
from fake_viewer import attach, rendered_as
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerClick, ViewerElement
from small_trainer import untrained_pipeline
from viser.transforms import SO3

from hsi_sc_nerf.data.dataparser import CAMERA_ROTATION, FRAME_INDEX
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.plotting import BLANK
from hsi_sc_nerf.spectra import COMPOSITES
from hsi_sc_nerf.viewer.panel import SpectralPanel, attach_spectral_panel, pick
from hsi_sc_nerf.viewer.training_views import TrainingViews


@pytest.fixture(scope="module")
def pipeline(flagged_dataset):
    return untrained_pipeline(flagged_dataset)


@pytest.fixture
def attached(pipeline):
    return attach(pipeline)


def truth_of(pipeline, view):
    return unpack(pipeline.datamanager.train_dataset.frames[view].cube())


@pytest.mark.slow
def test_nothing_changes_without_a_viewer_and_for_frames(attached, pipeline):
    panel, server, _ = attached
    spectral = np.full((4, 4, 12), 0.5, np.float32)
    panel.measured_view.cb_hook(SimpleNamespace(value=1))
    camera, frame = server.moved_camera(), pipeline.datamanager.train_dataset.cameras[2:3]
    assert set(panel.render(frame, rendered_as(spectral))) == {"rgb", "spectral", "depth", "accumulation"}
    before = pipeline.state_dict().keys()
    alone = attach_spectral_panel(pipeline)
    assert set(alone.render(camera, rendered_as(spectral))) == {"rgb", "spectral", "depth", "accumulation"}
    found = [path for path, _ in parse_object(pipeline, ViewerElement, "Custom Elements")]
    assert "Custom Elements/spectral_panel/band" in found
    assert pipeline.state_dict().keys() == before  # checkpoints stay as they are
    frame.rescale_output_resolution(0.1)
    assert "spectral" in pipeline.model.get_outputs_for_camera(frame)


def test_a_viewer_gets_pictures_of_one_or_three_channels(attached, pipeline):
    panel, server, _ = attached
    panel.measured_view.cb_hook(SimpleNamespace(value=4))
    camera = server.moved_camera()
    outputs = panel.render(camera, pipeline.model.get_outputs_for_camera)
    assert list(outputs)[:5] == ["rgb", "band", "composite", "index", "spectral_angle"]
    assert "spectral" not in outputs
    for image in outputs.values():
        assert image.shape[:2] == (24, 36)
        assert image.shape[2] in (1, 3)
        assert image.isfinite().all()
    for name in ("rgb", "composite", "index", "spectral_angle"):
        assert outputs[name].shape[2] == 3
        assert 0.0 <= outputs[name].min() <= outputs[name].max() <= 1.0


def test_controls_choose_band_composite_and_index(attached, spectral):
    panel, server, _ = attached
    panel.legend.install(server)
    panel.measured_view.cb_hook(SimpleNamespace(value=0))

    def nearest(nm):
        return spectral[..., np.abs(panel.wavelengths_nm - nm).argmin()]

    for nm, name, index in ((450.0, "pear", "NDVI"), (960.0, "CIR", "WI")):
        panel.band.value, panel.composite.value, panel.index.value = nm, name, index
        panel.composite.cb_hook(panel.composite)
        outputs = panel.render(server.moved_camera(), rendered_as(spectral))
        np.testing.assert_array_equal(outputs["band"][..., 0], nearest(nm))
        expected = np.stack([nearest(nm) for nm in COMPOSITES[name].wavelengths_nm], -1)
        np.testing.assert_array_equal(outputs["composite"], expected)
        for told in (name, index, "{:g}, {:g}, {:g} nm".format(*COMPOSITES[name].wavelengths_nm)):
            assert told in panel.legend.gui_handle.content
        assert not set(panel.legend.gui_handle.content) & set("<{")  # the browser reads them as code
    values = nearest(900.0) / nearest(970.0)
    expected = matplotlib.colormaps["viridis"]((values - 0.9) / 0.4)
    np.testing.assert_allclose(outputs["index"], expected[..., :3], atol=0.02)


@pytest.fixture
def index_of(attached):
    """The output `index` of spectra, before the first training camera."""
    panel, server, _ = attached
    panel.legend.install(server)
    panel.measured_view.cb_hook(SimpleNamespace(value=0))
    return lambda spectral, **options: panel.render(server.moved_camera(), rendered_as(spectral, **options))["index"]


def type_in(panel, text):
    panel.index_formula.value = text
    panel.index_formula.cb_hook(panel.index_formula)
    return panel.legend.gui_handle.content


@pytest.fixture
def spectral():
    return np.random.default_rng(0).uniform(0.05, 0.9, (24, 36, 12)).astype(np.float32)


def test_a_typed_formula_is_shown_in_place_of_the_list_until_it_is_deleted(attached, index_of, spectral):
    panel = attached[0]
    from_list = index_of(spectral)
    told = type_in(panel, "own = R970 / R900 [0.5, 2]")
    assert "own = R970 / R900" in told
    assert "colours 0.5 to 2" in told
    bands = [np.abs(panel.wavelengths_nm - nm).argmin() for nm in (970.0, 900.0)]
    values = spectral[..., bands[0]] / spectral[..., bands[1]]
    shown = index_of(spectral)
    expected = matplotlib.colormaps["viridis"]((values - 0.5) / 1.5)
    np.testing.assert_allclose(shown, expected[..., :3], atol=0.02)
    assert "**index** `WI" in type_in(panel, " wi ")
    type_in(panel, " ")
    np.testing.assert_array_equal(index_of(spectral), from_list)


def test_a_formula_without_ends_keeps_the_colours_of_its_first_picture_of_the_object(attached, index_of, spectral):
    panel = attached[0]
    assert "colours" not in type_in(panel, "own = R970 / R900").split("**spectral_angle**")[0]
    index_of(spectral, opacity=0.1)  # shows no object
    assert "colours" not in panel.legend.gui_handle.content.split("**spectral_angle**")[0]
    first = index_of(spectral)
    told = panel.legend.gui_handle.content
    assert "colours" in told.split("**spectral_angle**")[0]
    other = spectral.copy()
    other[12:] = np.linspace(0.1, 2.0, 12)
    np.testing.assert_array_equal(first[:12], index_of(other)[:12])
    assert panel.legend.gui_handle.content == told


@pytest.mark.parametrize("text", ["own = R1240", "<b>", "{own}", "own = R970**"])
def test_a_wrong_formula_is_answered_by_a_sentence_and_the_list_stays(attached, index_of, spectral, text):
    panel = attached[0]
    before = type_in(panel, "")
    expected = index_of(spectral)
    told = type_in(panel, text)
    assert told.endswith(before[before.index("**index**") :])
    sentence = told[len(before.split("**index**")[0]) : -len(before[before.index("**index**") :])].strip()
    assert sentence.startswith("**`")  # as code, in which the browser reads no markup
    assert sentence.endswith("`**")
    assert "\n" not in sentence
    np.testing.assert_array_equal(index_of(spectral), expected)


def test_what_the_bands_do_not_reach_is_not_offered():
    visible = SpectralPanel(np.arange(400.0, 701.0, 5.0), 9)
    assert visible.composite.options == ["pseudo-RGB", "maize visible"]
    assert "CRI1" in visible.index.options
    assert "NDVI" not in visible.index.options
    near_infrared = SpectralPanel(np.arange(750.0, 1001.0, 5.0), 9)
    assert near_infrared.composite is None
    assert near_infrared.index.options == ["WI", "WBI"]


@pytest.mark.parametrize("view", [0, 5])
def test_the_camera_stands_where_a_view_was_taken_and_sees_all_of_it(attached, pipeline, view):
    panel, server, _ = attached
    panel.measured_view.cb_hook(SimpleNamespace(value=view))
    frame = pipeline.datamanager.train_dataset.cameras[view]
    camera = server.moved_camera()
    np.testing.assert_allclose(camera.camera_to_worlds[0], frame.camera_to_worlds, atol=1e-5)
    render = rendered_as(np.full((24, 36, 12), 0.5, np.float32))
    panel.render(camera, render)
    for name in (FRAME_INDEX, CAMERA_ROTATION):  # what makes the model refine the pose and see the chamber
        np.testing.assert_array_equal(render.camera.metadata[name][0], frame.metadata[name])
    measured, _, seen = TrainingViews(pipeline.datamanager.train_dataset).measured(
        view, camera.generate_rays(camera_indices=0, keep_shape=True).directions
    )
    # The window is half as wide again as high: the frame fills its height.
    assert seen[:, 6:30].all()
    assert not seen[:, :6].any()
    assert not seen[:, 30:].any()
    assert measured.shape == (24 * 24, 12)
    aspect = 0.5
    half = math.tan(TrainingViews(pipeline.datamanager.train_dataset).vertical_fov(aspect) / 2.0)
    assert half * aspect == pytest.approx(float(frame.width / 2 / frame.fx))


@pytest.mark.parametrize("aspect", [1.5, 0.0, math.nan])
def test_a_browser_opens_behind_the_first_camera_and_turns_around_the_object(attached, pipeline, aspect):
    """Also one that does not know its window's shape yet."""
    _, server, viewer = attached
    server.camera.aspect = aspect
    (opened,) = server.opened
    opened(server.client)
    frame = pipeline.datamanager.train_dataset.cameras[0]
    camera = server.moved_camera()
    torch.testing.assert_close(
        camera.camera_to_worlds[0, :, :3].float(), frame.camera_to_worlds[:, :3], rtol=0, atol=1e-5
    )
    behind = camera.camera_to_worlds[0, :, 3].float() - frame.camera_to_worlds[:, 3]
    torch.testing.assert_close(behind / behind.norm(), frame.camera_to_worlds[:, 2], rtol=0, atol=1e-4)
    assert FRAME_INDEX not in (camera.metadata or {})
    # The centre of rotation is the nearest point of the optical axis to the object's middle.
    middle = pipeline.datamanager.train_dataset.metadata["object_box"].mean(0)
    looked_at = torch.from_numpy(server.camera.look_at / 10.0).float()
    assert (middle - looked_at) @ frame.camera_to_worlds[:, 2] == pytest.approx(0.0, abs=1e-4)
    viewer.init_scene("dataset", train_state="completed")
    assert viewer.calls == [("dataset", "completed"), "cameras hidden", "button switched"]


def test_a_browser_has_a_scale_bar_in_metric_millimetres_that_follows_its_camera(attached, pipeline):
    _, server, _ = attached
    server.opened[0](server.client)
    (moved,) = server.moves
    parsed = pipeline.datamanager.train_dataparser_outputs
    centre = 10.0 * parsed.metadata["object_box"].mean(0).numpy()
    ahead = SO3(server.camera.wxyz).as_matrix()[:, 2]
    for distance_m, words in ((0.4, "50 mm"), (0.1, "10 mm")):
        server.camera.position = centre - 10.0 * parsed.dataparser_scale * distance_m * ahead
        server.camera.fov = 2.0 * math.atan(0.3)
        moved(server.camera)
        assert list(server.labels.values()) == [words]


def test_the_render_of_a_closed_browser_is_stopped(attached):
    """nerfstudio forgets the browser before the panel hears of it."""
    _, server, viewer = attached
    server.opened[0](server.client)
    renderer = viewer.render_statemachines.pop(0)
    server.closed[0](server.client)
    assert renderer.interrupt_render_flag


def test_the_angle_is_zero_for_the_measured_view_and_blank_elsewhere(attached, pipeline):
    panel, server, viewer = attached
    panel.measured_view.cb_hook(SimpleNamespace(value=3))
    reflectance, valid = truth_of(pipeline, 3)
    size = reflectance.shape[0]
    camera = server.moved_camera((size, round(size * 1.5)))
    margin = size // 4
    spectral = np.pad(0.7 * reflectance, ((0, 0), (margin, margin), (0, 0)), constant_values=0.1)
    # Half of the picture has spectra that are turned by a right angle.
    spectral[: size // 2, :, ::2] = 0.0
    turned = np.where(np.arange(12) % 2 == 0, 0.0, 1.0)
    a = np.where(valid, reflectance, 0.0)
    with np.errstate(invalid="ignore"):
        cosine = (a * a * turned).sum(-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(a * turned, axis=-1))
    angles = np.where(np.arange(size)[:, None] < size // 2, np.arccos(np.clip(cosine, 0, 1)), 0.0)
    table = matplotlib.colormaps["magma"]
    expected = table(angles / 0.2)[..., :3]
    expected[valid.sum(-1) < 2] = BLANK
    picture = panel.render(camera, rendered_as(spectral))["spectral_angle"].numpy()
    np.testing.assert_allclose(picture[:, margin:-margin], expected, atol=0.03)
    np.testing.assert_allclose(picture[:, :margin], np.broadcast_to(BLANK, (size, margin, 3)), atol=1e-6)

    viewer.control_panel.output_render = "rgb"  # not asked for, not computed
    np.testing.assert_allclose(panel.render(camera, rendered_as(spectral))["spectral_angle"][..., 0], BLANK[0])
    viewer.control_panel = SimpleNamespace(output_render="rgb", split=True, split_output_render="spectral_angle")
    np.testing.assert_array_equal(panel.render(camera, rendered_as(spectral))["spectral_angle"], picture)
    server.camera.position = server.camera.position + np.array([0.02, 0.0, 0.0])
    moved = server.moved_camera((size, round(size * 1.5)))
    np.testing.assert_allclose(panel.render(moved, rendered_as(spectral))["spectral_angle"][..., 0], BLANK[0])
    assert FRAME_INDEX not in moved.metadata


def test_a_click_shows_the_spectrum_of_its_pixel(attached, pipeline):
    panel, server, _ = attached
    panel.spectrum.install(server)
    view, line, sample = 2, 60, 50
    panel.measured_view.cb_hook(SimpleNamespace(value=view))
    panel.picking.cb_hook(SimpleNamespace(value=True))
    event_type, _ = server.pointer
    assert event_type == "click"
    dataset = pipeline.datamanager.train_dataset
    frame = dataset.cameras[view : view + 1]
    coords = torch.tensor([line + 0.5, sample + 0.5])
    ray = frame.generate_rays(camera_indices=0, coords=coords)
    origin = tuple(frame.camera_to_worlds[0, :3, 3].tolist())
    click = ViewerClick(origin, tuple((3.0 * ray.directions).flatten().tolist()), (0.5, 0.5))
    _, drawn, title, _ = panel.spectrum_at(click)
    panel.show_spectrum(click)

    reflectance, valid = truth_of(pipeline, view)
    expected = np.where(valid[line, sample], reflectance[line, sample], np.nan)
    np.testing.assert_array_equal(drawn["measured"], expected)
    outputs = pipeline.model.get_outputs_for_camera_ray_bundle(ray.reshape((1, 1)))
    np.testing.assert_allclose(drawn["rendered"], outputs["spectral"][0, 0], atol=1e-5)
    told = panel.spectrum.gui_handle.content
    assert f"rad to {dataset.frames[view].capture}" in told
    assert f"opacity {outputs['accumulation'].item():.2f}" in told
    # The point is on the ray, in millimetres of the object frame.
    point = ray.origins.flatten() + ray.directions.flatten() * outputs["depth"].flatten()
    parsed = pipeline.datamanager.train_dataparser_outputs
    homogeneous = torch.eye(4)
    homogeneous[:3] = parsed.dataparser_transform
    in_metres = torch.linalg.inv(homogeneous) @ torch.cat([point / parsed.dataparser_scale, torch.ones(1)])
    assert title == "x {:.1f}, y {:.1f}, z {:.1f} mm".format(*(in_metres[:3] * 1000).tolist())
    np.testing.assert_allclose(server.points["/picked_point"]["position"], 10.0 * point, rtol=1e-4)

    elsewhere = ViewerClick((origin[0] + 0.1, *origin[1:]), (0.0, 0.0, 1.0), (0.5, 0.5))
    assert set(panel.spectrum_at(elsewhere)[1]) == {"rendered"}
    panel.picking.cb_hook(SimpleNamespace(value=False))
    assert server.pointer is None


def test_a_picked_point_lies_on_the_ray_as_the_model_refines_it(pipeline, monkeypatch):
    origin, direction, shift = torch.tensor([3.0, 0.0, 1.0]), torch.tensor([-3.0, 0.0, -1.0]), torch.ones(3) / 9.0

    def move(rays):
        rays.origins = rays.origins + shift

    monkeypatch.setattr(pipeline.model.camera_optimizer, "apply_to_raybundle", move)
    point = pick(pipeline.model, origin, direction, {})[0]
    torch.testing.assert_close(
        torch.linalg.cross(point - origin - shift, direction), torch.zeros(3), rtol=0, atol=1e-5
    )


def test_a_picked_ray_leaves_a_training_model_training(pipeline):
    pipeline.model.train()
    _, _, spectrum = pick(pipeline.model, torch.tensor([3.0, 0.0, 1.0]), torch.tensor([-3.0, 0.0, -1.0]), {})
    assert pipeline.model.training
    assert spectrum.shape == (12,)
    assert not spectrum.requires_grad
