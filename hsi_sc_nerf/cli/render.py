"""``hsi-sc-nerf render``: rendered views as hyperspectral cubes, and videos of them."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.settings_file import between, check_options


@dataclass(frozen=True)
class RenderCommand:
    """Render views of a trained run as ENVI cubes of reflectance, and videos of composites and indices.

    Beside each cube NAME, NAME_valid is a map that is 1 on the object and all that turns with it, and 0 on the
    background. Held-out and training frames also get a picture of measured and rendered frame and their difference.
    """

    load_config: Path
    """The config.yml of a trained run."""
    output_dir: Path
    """Folder to write to."""
    views: Literal["held-out", "training", "orbit"] = "held-out"
    """Views to render. held-out: frames not used in training. training: frames used in training. orbit: one turn of
    the object before the session's camera."""
    camera_path: Path | None = None
    """Render these cameras instead: a path that nerfstudio's viewer exported (JSON)."""
    orbit_views: int = between(1, math.inf, default=60)
    """Number of views of an orbit."""
    orbit_size: float = between(0.01, 100.0, default=1.0)
    """Factor on the size of an orbit's images; 2 doubles the pixels in each direction."""
    cubes: Literal["float32", "uint16", "none"] = "float32"
    """Type of the numbers in the cubes. float32: reflectance. uint16: reflectance times the header's scale factor, in
    half the space. none: no cubes."""
    video: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Name of a composite or an index to make a video (MP4) of, such as CIR or NDVI; may be given several times."""
    frames_per_second: int = between(1, 1000, default=15)
    """Frame rate of the videos."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: the run, a camera path or a name cannot be used, or a result cannot be written.
        """
        check_options(self)
        if self.cubes == "none" and not self.video:
            raise InputError("--cubes none without a --video leaves nothing to do; give one of the two.")
        from hsi_sc_nerf.files import atomic_write
        from hsi_sc_nerf.models.trained_run import open_run
        from hsi_sc_nerf.rendering.comparison import compare, write_report
        from hsi_sc_nerf.rendering.videos import find_false_colour, open_video
        from hsi_sc_nerf.rendering.views import (
            render_view,
            views_of_frames,
            views_of_orbit,
            views_of_path,
            write_view,
        )
        from hsi_sc_nerf.spectra.bands import to_8_bit
        from hsi_sc_nerf.terminal import progress_bar

        run = open_run(self.load_config)
        found = [find_false_colour(name, run.dataset.wavelengths_nm) for name in self.video]
        shown = list({item.name: item for item in found}.values())  # a name may be given twice
        if self.camera_path is not None:
            views = views_of_path(self.camera_path)
        elif self.views == "orbit":
            views = views_of_orbit(run, self.orbit_views, self.orbit_size)
        else:
            views = views_of_frames(run, self.views)

        rows: list[dict[str, Any]] = []
        files = [self.output_dir / f"{views.kind}-{item.name.replace(' ', '-')}.mp4" for item in shown]
        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_write(*files)) if files else []
            videos = [stack.enter_context(open_video(path, self.frames_per_second)) for path in temporary]
            with progress_bar("rendering", "views", len(views.names)) as update:
                for i, (name, camera) in enumerate(views):
                    rendered = render_view(run.model, camera)
                    if self.cubes != "none":
                        write_view(self.output_dir, name, rendered, run.dataset, self.cubes)
                    rows.append({"view": name, "valid": float(rendered.valid.float().mean())})
                    if views.measured is not None:
                        rows[-1] |= compare(self.output_dir, name, rendered, views.measured[i], run.model.rgb_bands)
                    for item, add_frame in zip(shown, videos, strict=True):
                        add_frame(to_8_bit(item.colours(rendered).numpy()))
                    update(i + 1)
        legends = {path.name: item.legend for path, item in zip(files, shown, strict=True)}
        write_report(self.output_dir / "render", rows, legends)
        Console().print(f"{len(views.names)} views: {escape(str(self.output_dir / 'render.md'))}")
