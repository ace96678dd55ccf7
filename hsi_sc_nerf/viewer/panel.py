"""The controls of the spectral viewer and the images that they select."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from copy import copy
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.viewer.viewer_elements import (
    ViewerCheckbox,
    ViewerClick,
    ViewerDropdown,
    ViewerSlider,
    ViewerText,
)
from torch import Tensor
from viser.transforms import SO3

from hsi_sc_nerf import paper
from hsi_sc_nerf.data.datamanager import SpectralDataset
from hsi_sc_nerf.data.dataparser import FRAME_INDEX
from hsi_sc_nerf.evaluation.spectral_metrics import spectral_angle_map
from hsi_sc_nerf.indices.catalogue import available_indices
from hsi_sc_nerf.plotting import ANGLE_COLOURS, ANGLE_DRAWN_RAD, coloured
from hsi_sc_nerf.spectra import (
    COMPOSITES,
    available_composites,
    composite,
    nearest_bands,
)
from hsi_sc_nerf.viewer.drawings import BrowserControl, ViewerMarkdown, colour_bar, inline_image, spectra_plot
from hsi_sc_nerf.viewer.index_choice import IndexChoice, index_legend
from hsi_sc_nerf.viewer.scale_bar import draw_scale_bar
from hsi_sc_nerf.viewer.training_views import TrainingViews, angle_to_measured

if TYPE_CHECKING:
    from nerfstudio.data.scene_box import OrientedBox
    from nerfstudio.pipelines.base_pipeline import Pipeline
    from nerfstudio.viewer.viewer import Viewer
    from viser import ClientHandle

    from hsi_sc_nerf.indices.formula import SpectralIndex
    from hsi_sc_nerf.models.spectral_model import SpectralModel

Outputs = dict[str, Tensor]
_POINT_RADIUS = 0.01  # scene units: about a millimetre
_POINT_RGB = (213, 94, 0)
_SHOWN = 0.5
"""Opacity of a pixel that shows the object."""
# How far behind the first training camera a browser starts, as a fraction of the camera's distance to the object.
_START_BEHIND = 0.1


def attach_spectral_panel(pipeline: Pipeline) -> SpectralPanel:
    """Add the spectral controls to a pipeline, and their images to what its model renders for a viewer.

    Args:
        pipeline: pipeline whose model is a `SpectralModel`. It gets the attribute ``spectral_panel``, in
            which nerfstudio's viewer finds the controls.

    Returns:
        The panel. It has no parameters and leaves checkpoints unchanged.
    """
    model = cast("SpectralModel", pipeline.model)
    panel = SpectralPanel(model.wavelengths_nm, model.num_train_data)
    render = model.get_outputs_for_camera

    def render_with_panel(camera: Cameras, obb_box: OrientedBox | None = None) -> Outputs:
        return panel.render(camera, lambda camera: render(camera, obb_box=obb_box))

    model.get_outputs_for_camera = render_with_panel  # type: ignore[method-assign]
    pipeline.spectral_panel = panel
    return panel


class SpectralPanel(torch.nn.Module):
    """Controls of the viewer: wavelength, composite, index, training view, spectrum of a clicked point.

    The panel is a module without parameters, because nerfstudio looks for controls in modules. The viewer shows the
    controls in the alphabetical order of their attribute names. Without a viewer the panel does nothing.

    Args:
        wavelengths_nm: band centres; composites and indices that need other wavelengths are not offered.
        num_views: number of training views.
    """

    def __init__(self, wavelengths_nm: Float[np.ndarray, "bands"], num_views: int) -> None:
        super().__init__()
        self.wavelengths_nm = wavelengths_nm
        self.band = ViewerSlider(
            "Wavelength (nm)",
            default_value=float(wavelengths_nm[nearest_bands(wavelengths_nm, paper.PSEUDO_RGB_NM[1:2])[0]]),
            min_value=float(wavelengths_nm.min()),
            max_value=float(wavelengths_nm.max()),
            step=1.0,
            hint="Output 'band' shows the band nearest to this wavelength",
        )
        self.composite = self._dropdown("Composite", [one.name for one in available_composites(wavelengths_nm)])
        self.index = self._dropdown("Index", [one.name for one in available_indices(wavelengths_nm)])
        self.index_formula = ViewerText(
            "Own index",
            "",
            cb_hook=self._explain,
            hint="Shown by output 'index' in place of the list's: a name of the catalogue, or a formula of "
            "reflectances such as CRI = 1/R510 - 1/R550; with [0, 15] behind it for the ends of the colours",
        )
        self.legend = ViewerMarkdown(self._legend)
        self._choice = IndexChoice(wavelengths_nm)
        self.measured_view = ViewerSlider(
            "Training view",
            default_value=0,
            min_value=0,
            max_value=max(1, num_views - 1),
            step=1,
            cb_hook=lambda slider: self._move_all_to(min(slider.value, num_views - 1)),
            hint="Moves the camera to this view, with which output 'spectral_angle' compares",
        )
        self.picking = ViewerCheckbox(
            "Click for spectrum",
            False,
            cb_hook=self._switch_picking,
            hint="A click shows the spectrum of a point; while this is on, the mouse does not move the camera",
        )
        self.spectrum = ViewerMarkdown()
        self.control = BrowserControl(self._opened)

    def render(self, camera: Cameras, render: Callable[[Cameras], Outputs]) -> Outputs:
        """Render a camera; for the viewer's camera, replace the spectra by the images that the controls select.

        A viewer's camera at the position of a training view gets that view's pose refinement and background.

        Args:
            camera: one camera, of a frame or of the viewer.
            render: the model's ``get_outputs_for_camera``.
        """
        viewer: Viewer | None = getattr(self.control, "viewer", None)
        if viewer is None or FRAME_INDEX in (camera.metadata or {}):
            return render(camera)
        views = _training_views(viewer)
        view = views.at(camera.camera_to_worlds[0, :3, 3])
        if view is not None:
            camera = copy(camera)
            camera.metadata = views.metadata(view, camera.device)
        outputs = render(camera)
        spectral = outputs.pop("spectral")
        band = nearest_bands(self.wavelengths_nm, [self.band.value]).tolist()
        pictures = {"rgb": outputs.pop("rgb").clamp(0.0, 1.0), "band": spectral[..., band]}
        if self.composite is not None:
            chosen = COMPOSITES[self.composite.value]
            pictures["composite"] = composite(spectral, self.wavelengths_nm, chosen.wavelengths_nm).clamp(0.0, 1.0)
        index, _ = self._index()
        pictures["index"], new_ends = self._choice.picture(index, spectral, outputs["accumulation"][..., 0] > _SHOWN)
        if new_ends:
            self.legend.show(self._legend())
        angles = torch.full(spectral.shape[:2], torch.nan, device=spectral.device)
        if view is not None and self._shown(viewer, "spectral_angle"):
            directions = camera.generate_rays(camera_indices=0, keep_shape=True).directions
            angles = angle_to_measured(spectral, *views.measured(view, directions))
        pictures["spectral_angle"] = coloured(angles, ANGLE_DRAWN_RAD, ANGLE_COLOURS)
        return pictures | outputs

    def show_spectrum(self, click: ViewerClick) -> None:
        """Show the rendered spectrum at a click and, at a training view, the measured one; mark the point."""
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO

        viewer = self.control.viewer
        position, curves, title, notes = self.spectrum_at(click)
        plot = spectra_plot(self.wavelengths_nm, curves, title)
        self.spectrum.show(f"{inline_image(plot, 'spectrum of the point')}\n\n{title}, {notes}")
        viewer.viser_server.scene.add_icosphere(
            "/picked_point",
            radius=_POINT_RADIUS * VISER_NERFSTUDIO_SCALE_RATIO,
            color=_POINT_RGB,
            position=position.double().numpy() * VISER_NERFSTUDIO_SCALE_RATIO,
        )

    def spectrum_at(
        self, click: ViewerClick
    ) -> tuple[Float[Tensor, "3"], dict[str, Float[np.ndarray, "bands"]], str, str]:
        """The point under a click (scene units), its spectra by name (rendered, and measured at a training view), and
        two texts: where it is, and how far it can be trusted."""
        viewer = self.control.viewer
        views = _training_views(viewer)
        origin, direction = torch.tensor(click.origin).float(), torch.tensor(click.direction).float()
        view = views.at(origin)
        metadata = {} if view is None else views.metadata(view, "cpu")
        with viewer.train_lock or contextlib.nullcontext():
            position, opacity, spectrum = pick(viewer.get_model(), origin, direction, metadata)  # type: ignore[arg-type]
        curves, notes = {"rendered": spectrum.numpy()}, f"opacity {opacity:.2f}"
        if view is not None:
            measured, valid, seen = views.measured(view, direction[None])
            if seen.item():
                curves["measured"] = np.where(valid[0], measured[0], np.nan)
                angle = float(spectral_angle_map(spectrum[None, None], measured[None], valid[None]))
                notes += f", spectral angle {angle:.3f} rad to {views.dataset.frames[view].capture}"
        # From the scene to metres in the object frame.
        parsed: Any = viewer.pipeline.datamanager.train_dataparser_outputs
        millimetres = (position / parsed.dataparser_scale - parsed.dataparser_transform[:, 3]) * 1000.0
        return position, curves, "x {:.1f}, y {:.1f}, z {:.1f} mm".format(*millimetres.tolist()), notes

    def _dropdown(self, label: str, names: list[str]) -> ViewerDropdown | None:
        """A choice of what the output of the label's name shows; None without choices."""
        hint = f"What output '{label.lower()}' shows"
        return ViewerDropdown(label, names[0], names, cb_hook=self._explain, hint=hint) if names else None

    def _index(self) -> tuple[SpectralIndex | None, str]:
        """The chosen index, and what is wrong with a typed one."""
        return self._choice.find(None if self.index is None else self.index.value, self.index_formula.value)

    def _explain(self, _: ViewerDropdown | ViewerText) -> None:
        self.legend.show(self._legend())

    def _legend(self) -> str:
        """Explanation of the colours of the selected outputs."""
        parts = []
        if self.composite is not None:
            chosen = COMPOSITES[self.composite.value]
            shown = ", ".join(f"{nm:g}" for nm in chosen.wavelengths_nm)
            parts.append(f"**composite** {chosen.name}: {shown} nm as red, green, blue ({chosen.shows})")
        parts += index_legend(*self._index())
        bar = colour_bar(ANGLE_DRAWN_RAD, ANGLE_COLOURS, "spectral angle (rad)")
        parts.append("**spectral_angle** between rendering and measurement, at a training view only")
        parts.append(inline_image(bar, "colours {:g} to {:g} rad".format(*ANGLE_DRAWN_RAD)))
        return "\n\n".join(parts)

    @staticmethod
    def _shown(viewer: Viewer, output: str) -> bool:
        panel = viewer.control_panel
        return output == panel.output_render or (panel.split and output == panel.split_output_render)

    def _opened(self, client: ClientHandle) -> None:
        """Show a browser the object, with a scale bar that follows its camera."""
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO

        viewer = self.control.viewer
        parsed: Any = viewer.pipeline.datamanager.train_dataparser_outputs
        centre = VISER_NERFSTUDIO_SCALE_RATIO * parsed.metadata["object_box"].mean(dim=0).double().numpy()
        units_per_m = VISER_NERFSTUDIO_SCALE_RATIO * float(parsed.dataparser_scale)
        client.camera.on_update(lambda _: draw_scale_bar(client, centre, units_per_m))
        self._move_to(client, 0, _START_BEHIND)

    def _move_all_to(self, view: int) -> None:
        """Move the cameras of all browsers to a training view."""
        viewer = self.control.viewer
        for client in viewer.viser_server.get_clients().values():
            self._move_to(client, view)

    def _move_to(self, client: ClientHandle, view: int, behind: float = 0.0) -> None:
        """Move a browser's camera to a training view, with the object as its centre of rotation.

        Args:
            client: the browser.
            view: index of the view.
            behind: how far behind the view's camera, as a fraction of its distance to the object.
        """
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO

        viewer = self.control.viewer
        views = _training_views(viewer)
        rotation = SO3.from_matrix(views.rotations[view].double().numpy()) @ SO3.from_x_radians(np.pi)
        ahead = rotation.as_matrix()[:, 2] * views.distance(view) * VISER_NERFSTUDIO_SCALE_RATIO
        position = views.centres[view].double().numpy() * VISER_NERFSTUDIO_SCALE_RATIO
        # A browser that is still laying out its page says 0 or NaN.
        aspect = client.camera.aspect if client.camera.aspect > 0.0 else 1.0
        with client.atomic():
            client.camera.position = position - behind * ahead
            client.camera.look_at = position + ahead
            client.camera.wxyz = rotation.wxyz
            client.camera.fov = views.vertical_fov(aspect)

    def _switch_picking(self, checkbox: ViewerCheckbox) -> None:
        if checkbox.value:
            self.control.register_pointer_cb("click", self.show_spectrum)
        else:
            self.control.unregister_pointer_cb()


def _training_views(viewer: Viewer) -> TrainingViews:
    return TrainingViews(cast(SpectralDataset, viewer.pipeline.datamanager.train_dataset))


def pick(
    model: SpectralModel,
    origin: Float[Tensor, "3"],
    direction: Float[Tensor, "3"],
    metadata: dict[str, Float[Tensor, "1 ..."]],
) -> tuple[Float[Tensor, "3"], float, Float[Tensor, "bands"]]:
    """Render one ray in evaluation mode and restore the mode of the model.

    Args:
        model: the model; no other thread may use it meanwhile.
        origin: origin of the ray, scene units.
        direction: direction of the ray, of any length.
        metadata: metadata of the frame to which the ray belongs; empty for none.

    Returns:
        The surface point at the median depth on the ray as the model refines it (scene units), its opacity, and its
        spectrum, background included.
    """
    rays = RayBundle(
        origins=origin[None],
        directions=(direction / direction.norm())[None],
        pixel_area=torch.ones(1, 1),
        camera_indices=torch.zeros(1, 1, dtype=torch.long),
        metadata={"directions_norm": torch.ones(1, 1), **metadata},
    ).to(model.device)
    was_training = model.training
    model.eval()
    try:
        with torch.no_grad():
            outputs = model(rays)
    finally:
        model.train(was_training)
    point = (rays.origins + rays.directions * outputs["depth"])[0]
    return point.cpu(), float(outputs["accumulation"][0]), outputs["spectral"][0].cpu()
