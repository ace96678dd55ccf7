"""Text and pictures as an element of nerfstudio's viewer, which has controls only."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from nerfstudio.viewer.viewer_elements import ViewerElement
from viser import GuiMarkdownHandle, ViserServer


class ViewerMarkdown(ViewerElement[str]):
    """Markdown in the control panel.

    Args:
        first: what it shows at first; asked only when a viewer shows the panel.
    """

    gui_handle: GuiMarkdownHandle | None  # type: ignore[assignment]

    def __init__(self, first: Callable[[], str] = str) -> None:
        super().__init__(name="")
        self.first = first

    def show(self, content: str) -> None:
        """Show something else, once it is in a panel."""
        assert self.gui_handle is not None
        self.gui_handle.content = content

    def install(self, viser_server: ViserServer) -> None:
        """Put it into the panel."""
        self._create_gui_handle(viser_server)

    def _create_gui_handle(self, viser_server: ViserServer) -> None:
        # A root for relative paths of pictures, of which there are none, spares a warning of each picture.
        self.gui_handle = viser_server.gui.add_markdown(self.first(), image_root=Path())
