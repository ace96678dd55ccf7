"""What the viewer's panel meets: a server with one browser, and nerfstudio's rendering."""

import contextlib
from types import SimpleNamespace

import numpy as np
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.viewer.utils import CameraState, get_camera, parse_object
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement
from viser.transforms import SO3

from hsi_sc_nerf.viewer.panel import SpectralPanel


class FakeServer:
    """What the panel uses of viser's server: one browser, a scene, a panel of texts."""

    def __init__(self):
        self.moves = []
        self.camera = SimpleNamespace(aspect=1.5, on_update=self.moves.append)
        self.labels = {}
        own_scene = SimpleNamespace(
            add_spline_catmull_rom=lambda *_, **__: None,
            add_label=lambda name, text, **_: self.labels.update({name: text}),
        )
        self.client = SimpleNamespace(camera=self.camera, scene=own_scene, atomic=contextlib.nullcontext, client_id=0)
        self.pointer = None
        self.points = {}
        self.scene = SimpleNamespace(
            on_pointer_event=lambda event_type: lambda callback: setattr(self, "pointer", (event_type, callback)),
            remove_pointer_callback=lambda: setattr(self, "pointer", None),
            add_icosphere=lambda name, **sphere: self.points.update({name: sphere}),
        )
        self.opened, self.closed = [], []
        self.gui = SimpleNamespace(add_markdown=lambda content, image_root: SimpleNamespace(content=content))

    def on_client_connect(self, callback):
        self.opened.append(callback)

    def on_client_disconnect(self, callback):
        self.closed.append(callback)

    def get_clients(self):
        return {0: self.client}

    def moved_camera(self, size=(24, 36)):
        """The camera that nerfstudio's viewer makes of the browser's."""
        turn = SO3(self.camera.wxyz) @ SO3.from_x_radians(np.pi)
        pose = np.concatenate([turn.as_matrix(), self.camera.position[:, None] / 10.0], axis=1)
        state = CameraState(
            fov=self.camera.fov,
            aspect=size[1] / size[0],
            c2w=torch.from_numpy(pose),
            camera_type=CameraType.PERSPECTIVE,
        )
        return get_camera(state, size[0])


def attach(pipeline):
    """A panel, its browser, and the viewer that both belong to."""
    model = pipeline.model
    panel = SpectralPanel(model.wavelengths_nm, model.num_train_data)
    server = FakeServer()
    viewer = SimpleNamespace(
        pipeline=pipeline,
        viser_server=server,
        train_lock=None,
        render_statemachines={0: SimpleNamespace(interrupt_render_flag=False)},
        get_model=lambda: model,
        control_panel=SimpleNamespace(output_render="spectral_angle", split=False),
        calls=(calls := []),
        init_scene=lambda dataset, train_state: calls.append((dataset, train_state)),
        set_camera_visibility=lambda visible: calls.append("cameras shown" if visible else "cameras hidden"),
        toggle_cameravis_button=lambda: calls.append("button switched"),
    )
    found = [path for path, _ in parse_object(panel, ViewerElement, "panel")]
    names = ("band", "composite", "index", "index_formula", "legend", "measured_view", "picking", "spectrum")
    assert found == [f"panel/{name}" for name in names]
    for _, control in parse_object(panel, ViewerControl, "panel"):
        control._setup(viewer)
    model.eval()
    return panel, server, viewer


def rendered_as(spectral, opacity=1.0):
    """A stand-in for nerfstudio's rendering that remembers the camera and gives these spectra."""

    def render(camera):
        render.camera = camera
        image = torch.from_numpy(spectral)
        ones = torch.ones(*image.shape[:2], 1)
        return {"rgb": 2.0 * image[..., :3], "spectral": image, "depth": ones, "accumulation": ones * opacity}

    return render
