"""The viewer in a real browser, before a ball of one spectrum."""

import io
import re
import threading
import time

import ball_run
import capture_factory as factory
import matplotlib
import numpy as np
import pytest
from headless_browser import needs_browser
from PIL import Image

WINDOW = {"width": 900, "height": 700}
ON_THE_BALL, BESIDE_IT = (300, 345), (40, 345)  # pixels of the window from its upper left; the panel is at the right


@pytest.fixture
def ball_viewer(tmp_path):
    """nerfstudio's viewer as `ns-viewer` makes it of a run whose model is the ball."""
    from nerfstudio.utils.eval_utils import eval_setup
    from nerfstudio.viewer.viewer import Viewer

    from hsi_sc_nerf.models.trained_run import TrainedRun

    data = ball_run.write_ball_dataset(tmp_path / "data")
    config, pipeline, _, step = eval_setup(ball_run.write_untrained_run(data, tmp_path / "runs"), test_mode="test")
    ball_run.fill_with_ball(TrainedRun(pipeline.model, pipeline.datamanager))
    viewer = Viewer(
        config.viewer,
        log_filename=tmp_path / "runs" / "viewer.log",
        datapath=data,
        pipeline=pipeline,
        train_lock=threading.Lock(),
    )
    viewer.init_scene(pipeline.datamanager.train_dataset, "completed", pipeline.datamanager.eval_dataset)
    viewer.update_scene(step)
    yield viewer
    viewer.viser_server.stop()


@pytest.fixture
def page(ball_viewer, browser):
    """A browser's page that shows the viewer as it opens."""
    address = re.search(r"http://\S+", ball_viewer.viewer_info[0])[0].replace("0.0.0.0", "localhost")
    page = browser.new_page(viewport=WINDOW)
    page.set_default_timeout(120_000)
    page.goto(address, wait_until="domcontentloaded")
    yield page
    page.close()


def shows(page, ball, beside_it=255 * factory.BACKGROUND):
    """Wait until the ball has a colour, before a wall of another: from inside the ball all has its colour."""
    for _ in range(240):
        picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), float)
        found, beside = picture[ON_THE_BALL[::-1]], picture[BESIDE_IT[::-1]]
        if np.abs(found - ball).max() <= 12 and (beside_it is None or np.abs(beside - beside_it).max() <= 12):
            return True
        page.wait_for_timeout(500)
    pytest.fail(f"the ball is {found}, not {ball}, and the wall {beside}, not {beside_it}")


def choose(page, label, name):
    page.get_by_label(label, exact=True).click()
    page.get_by_role("option", name=name, exact=True).click()


LOW, HIGH = 255 * factory.PLANT.min(), 255 * factory.PLANT.max()


@pytest.mark.slow
@needs_browser
def test_pictures_and_spectra_of_a_ball_from_the_state_it_opens_in(page):
    """It opens before the object; outputs have their colours; a click tells a position; so after a reload."""
    assert shows(page, [LOW, LOW, LOW])
    assert page.get_by_text("Show Train Cams").is_visible()
    choose(page, "Output type", "composite")
    choose(page, "Composite", "CIR")
    assert shows(page, [HIGH, LOW, LOW])
    page.reload(wait_until="domcontentloaded")
    assert shows(page, [HIGH, LOW, LOW])
    page.get_by_label("Click for spectrum").check()
    answer = page.get_by_text(re.compile(r"x -?[\d.]+, y .* mm, opacity"))
    for _ in range(60):  # the browser listens to clicks only when the server has told it to
        page.mouse.click(ON_THE_BALL[0] + 30, ON_THE_BALL[1] + 30)  # the mark of the point covers it
        page.wait_for_timeout(1000)
        if answer.count():
            break
    told = answer.inner_text(timeout=5000)
    point_mm = np.array(re.findall(r"-?[\d.]+", told)[:3], float)
    opacity = float(re.search(r"opacity ([\d.]+)", told)[1])
    assert np.linalg.norm(point_mm / 1000.0 - factory.SPHERE_CENTRE_M) == pytest.approx(0.04, abs=0.002)
    assert opacity > 0.98
    choose(page, "Output type", "band")
    # nerfstudio normalises: the darkest.
    assert shows(page, 255 * np.array(matplotlib.colormaps["turbo"].colors[0]), beside_it=None)


@pytest.mark.slow
@needs_browser
def test_an_index_is_typed_in_and_a_wrong_one_is_answered(page):
    assert shows(page, [LOW, LOW, LOW])
    choose(page, "Output type", "index")
    # viser binds no label to a box for text.
    box = page.get_by_text("Own index", exact=True).locator("xpath=ancestor::*[.//input or .//textarea][1]")
    box = box.locator("input, textarea").first
    box.fill("own = R670 / R670 [0, 2]")
    assert shows(page, 255 * np.array(matplotlib.colormaps["viridis"](0.5)[:3]), beside_it=None)
    box.fill("own = R670 / R67")
    page.get_by_text("the index 'own = R670 / R67' cannot be computed").wait_for()
    box.fill("own = {R670} / <b>")
    page.get_by_text("the index 'own = {R670} / <b>' cannot be computed").wait_for()
    assert page.get_by_text("Show Train Cams").is_visible()


@pytest.mark.slow
@needs_browser
def test_a_reload_shows_the_object_while_the_last_picture_is_still_rendered(page, ball_viewer):
    """At full size a render may take minutes; that of the browser that was closed must not keep the model."""
    assert shows(page, [LOW, LOW, LOW])
    model, renders, ended = ball_viewer.get_model(), threading.Event(), threading.Event()
    render = model.get_outputs_for_camera

    def endless_at_full_size(camera, obb_box=None):
        while int(camera.height) > 200 and not ended.is_set():
            renders.set()
            time.sleep(0.01)
        return render(camera, obb_box=obb_box)

    model.get_outputs_for_camera = endless_at_full_size
    for _ in range(3):
        choose(page, "Output type", "composite")
        choose(page, "Output type", "rgb")
        assert renders.wait(120.0)
        page.reload(wait_until="domcontentloaded")
        shown = shows(page, [LOW, LOW, LOW])
        renders.clear()
        assert shown
    ended.set()
