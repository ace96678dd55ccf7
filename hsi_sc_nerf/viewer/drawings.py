"""What the viewer shows in its panel (plots, colour bars, Markdown), and what each browser sees when it opens it."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement
from viser import GuiMarkdownHandle, ViserServer

from hsi_sc_nerf.plotting import COLOURS, STYLE, new_figure

if TYPE_CHECKING:
    from nerfstudio.viewer.render_state_machine import RenderStateMachine
    from nerfstudio.viewer.viewer import Viewer
    from viser import ClientHandle

_WIDTH_IN = 2.5  # 240 px of the viewer's panel
_DPI = 3 * 96  # three dots a pixel, sharp on high-resolution screens
_STYLE: Any = STYLE | {"font.size": 7, "axes.titlesize": 7, "axes.linewidth": 0.6}


@rc_context(_STYLE)
def spectra_plot(
    wavelengths_nm: Float[np.ndarray, "bands"], spectra: Mapping[str, Float[np.ndarray, "bands"]], title: str
) -> bytes:
    """PNG of up to two named spectra over the wavelength; NaN leaves a gap."""
    figure = new_figure(_WIDTH_IN, 1.77)
    axes, order = figure.add_subplot(), np.argsort(wavelengths_nm)
    for (name, spectrum), colour in zip(spectra.items(), COLOURS, strict=False):
        axes.plot(wavelengths_nm[order], spectrum[order], color=colour, linewidth=1.0, label=name)
    axes.set(xlabel="Wavelength (nm)", ylabel="Reflectance", title=title)
    axes.set_xlim(wavelengths_nm.min(), wavelengths_nm.max())
    axes.set_ylim(0.0, max(0.1, 1.05 * max(float(np.nanmax(spectrum)) for spectrum in spectra.values())))
    axes.legend()
    return _png(figure)


@rc_context(_STYLE)
def colour_bar(drawn_range: tuple[float, float], colours: str, label: str) -> bytes:
    """PNG of a colour map with its range."""
    figure = new_figure(_WIDTH_IN, 0.6)
    mappable = ScalarMappable(Normalize(*drawn_range), colours)
    figure.colorbar(mappable, cax=figure.add_subplot(), orientation="horizontal", label=label)
    return _png(figure)


def inline_image(png: bytes, text: str) -> str:
    """Markdown of an image with the alternative text ``text``."""
    return f"![{text}](data:image/png;base64,{base64.b64encode(png).decode()})"


def _png(figure: Figure) -> bytes:
    memory = io.BytesIO()
    figure.savefig(memory, format="png", dpi=_DPI)
    return memory.getvalue()


class ViewerMarkdown(ViewerElement[str]):
    """Markdown in the control panel.

    Args:
        first: gives the initial content; called when a viewer shows the panel.
    """

    gui_handle: GuiMarkdownHandle | None  # type: ignore[assignment]

    def __init__(self, first: Callable[[], str] = str) -> None:
        super().__init__(name="")
        self.first = first

    def show(self, content: str) -> None:
        """Replace the content; the element must be in a panel."""
        assert self.gui_handle is not None
        self.gui_handle.content = content

    def install(self, viser_server: ViserServer) -> None:
        """Add the element to the panel."""
        self._create_gui_handle(viser_server)

    def _create_gui_handle(self, viser_server: ViserServer) -> None:
        # An image root avoids one warning for each image.
        self.gui_handle = viser_server.gui.add_markdown(self.first(), image_root=Path())


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
