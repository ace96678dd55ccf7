"""Browsers that open and close the viewer: what each sees first, and renders that nobody waits for."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from nerfstudio.viewer.viewer_elements import ViewerControl

if TYPE_CHECKING:
    from nerfstudio.viewer.render_state_machine import RenderStateMachine
    from nerfstudio.viewer.viewer import Viewer
    from viser import ClientHandle


class BrowserControl(ViewerControl):
    """nerfstudio's access to the viewer, which also reports every browser that opens it.

    The training cameras are hidden when their scene is made: their pictures would cover the object and catch clicks.
    A render for a browser that is closed or reloaded is stopped: nerfstudio would finish it, a minute at full size on
    two cores, while all other browsers wait for the model and stay black.

    Args:
        opened: called with the browser, whose initial camera is inside the object.
    """

    def __init__(self, opened: Callable[[ClientHandle], None]) -> None:
        self._opened = opened

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        renderers: dict[int, RenderStateMachine] = {}

        def opened(client: ClientHandle) -> None:
            renderers[client.client_id] = viewer.render_statemachines[client.client_id]
            self._opened(client)

        def closed(client: ClientHandle) -> None:
            # nerfstudio has told the thread to end, but not its render.
            renderers.pop(client.client_id).interrupt_render_flag = True

        viewer.viser_server.on_client_connect(opened)
        viewer.viser_server.on_client_disconnect(closed)
        show_scene = viewer.init_scene

        def show_scene_without_cameras(*args: Any, **options: Any) -> None:
            show_scene(*args, **options)
            viewer.set_camera_visibility(False)
            viewer.toggle_cameravis_button()

        viewer.init_scene = show_scene_without_cameras  # type: ignore[method-assign]
