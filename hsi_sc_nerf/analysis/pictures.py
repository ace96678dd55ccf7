"""Pictures of a spectral mesh: composites, maps and classes from four sides; spectra of regions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib import colormaps, rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from hsi_sc_nerf.analysis.class_maps import OUTSIDE, WITHOUT_LIMITS
from hsi_sc_nerf.analysis.classes import UNCLASSIFIED, class_areas_m2
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.analysis.traits import Traits
from hsi_sc_nerf.geometry.mesh import Mesh, ray_scene
from hsi_sc_nerf.plotting import COLOURS, INDEX_COLOURS, STYLE, new_figure, save_figure, show_image, usual_range
from hsi_sc_nerf.spectra import available_composites, composite

SIDES_DEG = {"camera's side": 0.0, "turned by 90°": 90.0, "by 180°": 180.0, "by 270°": 270.0}
_HEIGHT_PX = 420
_LABEL_IN = 1.4
"""Height of a row's label."""
_LONGEST_NAME = 32
"""Characters of a name in a legend; more would leave no room for the curves."""
GREY = 0.85
"""Grey value of unseen surface."""
_NEAR_WHITE = 0.97
"""Grey value of surface in no class."""
_STRIPES, _STRIPES_PX = (0.45, 0.95), 12
"""Grey values of surface without a value, and the stripes' period."""
NO_CLASS = "in no class"


class SideViews:
    """Parallel projections of a mesh from the four `SIDES_DEG`, as barycentric coordinates of each pixel."""

    def __init__(self, mesh: Mesh, height_px: int = _HEIGHT_PX) -> None:
        self._mesh = mesh
        scene = ray_scene(mesh.vertices, mesh.triangles)
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        middle = (low + high) / 2.0
        reach_m = float(np.linalg.norm(mesh.vertices[:, :2] - middle[:2], axis=1).max())
        step_m = 1.04 * max(high[2] - low[2], reach_m) / height_px
        columns = int(np.ceil(2.08 * reach_m / step_m))
        across = (np.arange(columns) + 0.5 - columns / 2) * step_m
        up = (height_px / 2 - np.arange(height_px) - 0.5) * step_m
        self.sides = []
        for azimuth in np.deg2rad(list(SIDES_DEG.values())):
            towards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
            start = middle + 2.0 * reach_m * towards + across[None, :, None] * right + up[:, None, None] * [0, 0, 1.0]
            rays = np.concatenate([start, np.broadcast_to(-towards, start.shape)], axis=-1).astype(np.float32)
            hits = scene.cast_rays(rays)
            u, v = np.moveaxis(hits["primitive_uvs"].numpy(), -1, 0)
            hit = np.isfinite(hits["t_hit"].numpy())
            triangle = np.where(hit, hits["primitive_ids"].numpy(), 0).astype(np.int64)
            self.sides.append((hit, triangle, np.stack([1.0 - u - v, u, v], axis=-1)))

    def on_white(
        self, colours: Float[np.ndarray, "v 3"], striped: Bool[np.ndarray, "v"] | None = None
    ) -> list[Float[np.ndarray, "h w 3"]]:
        """Pictures of the vertices' colours, one a side, interpolated within triangles; white beside the object.

        Vertices that are ``striped`` have grey stripes, which no colour map has.
        """
        pictures = []
        for hit, triangle, barycentric in self.sides:
            corners = self._mesh.triangles[triangle]
            mixed = np.einsum("hwc,hwcj->hwj", barycentric, colours[corners])
            mixed[~hit] = 1.0
            if striped is not None:
                on = hit & (np.einsum("hwc,hwc->hw", barycentric, striped[corners]) > 0.5)
                dark = np.indices(hit.shape).sum(axis=0) % _STRIPES_PX < _STRIPES_PX // 2
                mixed[on] = np.where(dark[on], *_STRIPES)[:, None]
            pictures.append(mixed)
        return pictures


@rc_context(STYLE)
def draw_composites(path: Path, surface: SpectralMesh, views: SideViews) -> None:
    """The named composites in rows, the sides in columns; unseen surface is grey."""
    rows = {}
    for one in available_composites(surface.wavelengths_nm):
        values = composite(surface.spectra, surface.wavelengths_nm, one.wavelengths_nm, one.name).astype(float)
        # Brightened, so that dark tissue can be seen; the brightest percent is clipped.
        values = np.clip(values / np.percentile(values[surface.seen], 99.0), 0.0, 1.0)
        values[~surface.seen] = GREY
        rows[f"{one.name}\n{', '.join(f'{nm:g}' for nm in one.wavelengths_nm)} nm"] = views.on_white(values)
    draw_rows(path, rows)


@rc_context(STYLE)
def draw_maps(
    path: Path, maps: Mapping[str, Float[np.ndarray, "v"]], surface: SpectralMesh, views: SideViews
) -> None:
    """Maps by their labels in colours in rows, the sides in columns; unseen surface is grey, seen surface without a
    value striped.

    The scale of each goes from its 1st to its 99th percentile on this surface.
    """
    rows, scales, any_striped = {}, [], False
    for label, values in maps.items():
        known = surface.seen & np.isfinite(values)
        scale = (*usual_range(values[known]), INDEX_COLOURS)
        painted = paint_values(np.where(known, values, np.nan), *scale)
        rows[label] = views.on_white(painted, striped := surface.seen & ~known)
        scales.append(scale)
        any_striped |= bool(striped.any())
    draw_rows(path, rows, scales, [_striped("no value is known here")] if any_striped else [])


def draw_rows(
    path: Path,
    rows: Mapping[str, Sequence[np.ndarray]],
    scales: Sequence[tuple[float, float, str] | None] = (),
    key: Sequence[Patch] = (),
) -> None:
    """Pictures of the four sides in labelled rows.

    Args:
        path: to write.
        rows: pictures by their label.
        scales: ends and colours of the first rows' bars.
        key: key of the legend.
    """
    first = next(iter(rows.values()))[0]
    width_in = 1.75
    row_in = max(width_in * first.shape[0] / first.shape[1], _LABEL_IN)
    figure = new_figure(width_in * len(SIDES_DEG) + 1.0, row_in * len(rows) + 0.35)
    grid = show_rows(figure, rows)
    for axes, title in zip(grid[0], SIDES_DEG, strict=True):
        axes.set_title(title)
    for line, scale in zip(grid, scales, strict=False):
        if scale is not None:
            low, high, colours = scale
            shown = ScalarMappable(Normalize(low, high), colours)
            figure.colorbar(shown, ax=line.tolist(), extend="both", fraction=0.04, aspect=18, pad=0.02)
    if key:
        figure.legend(handles=list(key), loc="outside lower center", fontsize=8)
    save_figure(figure, path)


def show_rows(figure: Figure, rows: Mapping[str, Sequence[np.ndarray]]) -> np.ndarray:
    """Show pictures of the four sides in labelled rows of a figure, and return their axes."""
    grid = figure.subplots(len(rows), len(SIDES_DEG), squeeze=False)
    for line, (label, pictures) in zip(grid, rows.items(), strict=True):
        for axes, picture in zip(line, pictures, strict=True):
            show_image(axes, picture)
        line[0].set_ylabel(label)
    return grid


@rc_context(STYLE)
def draw_classes(
    path: Path,
    names: Sequence[str],
    labels: Int[np.ndarray, "v"],
    surface: SpectralMesh,
    views: SideViews,
    unlabelled: str = NO_CLASS,
) -> None:
    """The classes on the surface, with their areas; grey is unseen.

    Seen surface without a label is white if it is in no class, and striped if a classifier does not know it.
    """
    striped = unlabelled in (OUTSIDE, WITHOUT_LIMITS)
    none = surface.seen & (labels == UNCLASSIFIED)
    pictures = views.on_white(paint_classes(labels, surface.seen), none if striped else None)
    height, width = pictures[0].shape[:2]
    figure = new_figure(1.9 * len(SIDES_DEG), 1.9 * height / width + 0.3 + 0.22 * (len(names) // 3 + 2))
    for axes, picture, title in zip(figure.subplots(1, len(SIDES_DEG)), pictures, SIDES_DEG, strict=True):
        show_image(axes, picture)
        axes.set_title(title)
    areas_cm2 = 1e4 * class_areas_m2(labels, surface.areas_m2, surface.seen, len(names))
    there = {
        number: f"{in_legend(name)}: {area:.2f} cm²"
        for number, (name, area) in enumerate(zip(names, areas_cm2[:-1], strict=True))
        if area > 0
    }
    patches = class_key(there, f"{unlabelled}: {areas_cm2[-1]:.2f} cm²", striped)
    figure.legend(handles=patches, loc="outside lower center", ncols=3, fontsize=8)
    save_figure(figure, path)


def paint_values(values: Float[np.ndarray, "v"], low: float, high: float, colours: str) -> Float[np.ndarray, "v 3"]:
    """Colours of a map between the two ends of its scale at each vertex; grey where it has no value."""
    fractions = np.clip((np.nan_to_num(values) - low) / (high - low), 0.0, 1.0)
    return np.where(np.isfinite(values)[:, None], colormaps[colours](fractions)[:, :3], GREY)


def paint_classes(labels: Int[np.ndarray, "v"], seen: Bool[np.ndarray, "v"]) -> Float[np.ndarray, "v 3"]:
    """Colours of the classes at each vertex, near white in no class; grey is unseen."""
    colours = np.array([to_rgb(colour) for colour in COLOURS])
    painted = np.where(labels[:, None] == UNCLASSIFIED, _NEAR_WHITE, colours[labels % len(COLOURS)])
    painted[~seen] = GREY
    return painted


def class_key(labels: Mapping[int, str], rest: str = NO_CLASS, striped: bool = False) -> list[Patch]:
    """Legend of `paint_classes`: of the classes by their numbers, of what is in no class, and of what is unseen."""
    patches = [Patch(color=COLOURS[number % len(COLOURS)], label=label) for number, label in labels.items()]
    white = Patch(facecolor=str(_NEAR_WHITE), edgecolor="0.5", label=rest)
    return [*patches, _striped(rest) if striped else white, Patch(color=str(GREY), label="not seen")]


def in_legend(name: str) -> str:
    """A name that leaves room for the curves; matplotlib would leave away one that begins with an underscore."""
    short = name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…"
    return f" {short}" if short.startswith("_") else short


def _striped(label: str) -> Patch:
    dark, light = map(str, _STRIPES)
    return Patch(facecolor=light, edgecolor=dark, hatch="/////", linewidth=0.0, label=label)


@rc_context(STYLE)
def draw_region_spectra(path: Path, wavelengths_nm: Float[np.ndarray, "bands"], traits: Traits) -> None:
    """Mean spectrum of each region with a band of one standard deviation over its surface."""
    figure = new_figure(9.0, 4.0)
    axes = figure.subplots()
    order = np.argsort(wavelengths_nm)
    nm = wavelengths_nm[order]
    for index, region in enumerate(traits.regions):
        colour = "0.35" if index == 0 else COLOURS[(index - 1) % len(COLOURS)]
        mean, sd = region.spectrum.mean[order], region.spectrum.sd[order]
        axes.fill_between(nm, mean - sd, mean + sd, color=colour, alpha=0.18, linewidth=0)
        label = f"{in_legend(region.name)} ({region.area_m2 * 1e4:.2f} cm²)"
        axes.plot(nm, mean, color=colour, linewidth=1.5, marker="o" if len(nm) == 1 else None, label=label)
    axes.margins(x=0.0)
    axes.set(xlabel="wavelength (nm)", ylabel="reflectance, mean ± SD", ylim=(0, None))
    figure.legend(loc="outside right upper", fontsize=8)
    save_figure(figure, path)
