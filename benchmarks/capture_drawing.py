"""The drawing of docs/how-to/first_fruit.md: the imaging chamber from the side, and the turntable from above.

uv run python benchmarks/capture_drawing.py --output docs/images/first_fruit.png

Lengths are those of the scene "pear" of the simulator, which has the container and the markers of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Circle, Ellipse, Polygon, Rectangle

from hsi_sc_nerf.plotting import COLOURS, new_figure, save_figure
from hsi_sc_nerf.simulate.assemble import marker_frames
from hsi_sc_nerf.simulate.scene import Scene, load_scene

WALL_M, LAMP_HEIGHT_M = 0.24, 0.33
SIZE = 8
FRUIT = "#4cb89a"


@dataclass(frozen=True)
class CaptureDrawing:
    """Draw the set-up of a session."""

    output: Path
    """PNG to write."""

    def main(self) -> None:
        """Draw and write."""
        scene = load_scene("pear")
        figure = new_figure(10.0, 4.4)
        from_side, from_above = figure.subplots(1, 2, width_ratios=(1.55, 1.0))
        draw_side(from_side, scene)
        draw_top(from_above, scene)
        for axes, title in ((from_side, "From the side"), (from_above, "From above")):
            axes.set(aspect="equal", title=title)
            axes.axis("off")
        save_figure(figure, self.output)


def draw_side(axes: Axes, scene: Scene) -> None:
    """Chamber, lamps, turntable with container and pear, and the camera with its field of view."""
    camera, container, disc = scene.camera, scene.container, scene.turntable.disc_diameter_m
    axes.plot([0.52, -WALL_M, -WALL_M, 0.52], [-0.06, -0.06, 0.38, 0.38], color="0.6", linewidth=3)
    axes.text(-WALL_M + 0.01, 0.02, "matt white wall,\nno pattern", size=SIZE, color="0.35")
    for x in (-0.12, 0.12, 0.36):
        axes.add_patch(Circle((x, LAMP_HEIGHT_M), 0.014, color=COLOURS[4]))
    axes.text(
        -0.095, LAMP_HEIGHT_M - 0.006, "lamps towards the walls:\nlight from all sides", size=SIZE, color="0.35"
    )
    axes.add_patch(Rectangle((-0.05, -0.055), 0.1, 0.047, color="0.8"))
    axes.text(0.06, -0.04, "turntable", size=SIZE)
    axes.add_patch(Rectangle((-disc / 2, -0.008), disc, 0.008, color="0.45"))
    axes.add_patch(
        Rectangle((-container.diameter_m / 2, 0.0), container.diameter_m, container.height_m, color="0.88")
    )
    side = scene.markers.side_m
    axes.add_patch(Rectangle((-side / 2, (container.height_m - side) / 2), side, side, color="black"))
    top = container.height_m
    axes.add_patch(Ellipse((0.0, top + 0.03), 0.066, 0.062, color=FRUIT))
    axes.add_patch(Ellipse((0.0, top + 0.065), 0.036, 0.055, color=FRUIT))
    axes.plot([0.0, 0.003], [top + 0.09, top + 0.1], color="saddlebrown", linewidth=2)
    axes.plot([0.0, 0.0], [-0.06, 0.2], color=COLOURS[0], linewidth=0.8, linestyle="-.")
    axes.text(0.004, 0.19, "axis", size=SIZE, color=COLOURS[0])
    elevation = np.deg2rad(camera.elevation_deg)
    aim = np.array([0.0, camera.aim_height_m])
    eye = aim + camera.distance_m * np.array([np.cos(elevation), np.sin(elevation)])
    axes.plot(*np.stack([aim, eye]).T, color=COLOURS[0], linewidth=0.8)
    for half_deg in (-camera.field_of_view_deg / 2, camera.field_of_view_deg / 2):
        turned = elevation + np.pi + np.deg2rad(half_deg)
        end = eye + 0.46 * np.array([np.cos(turned), np.sin(turned)])
        axes.plot(*np.stack([eye, end]).T, color=COLOURS[0], linewidth=0.5, linestyle=":")
    body = np.array([(0.0, -0.025), (0.09, -0.025), (0.09, 0.025), (0.0, 0.025)])
    rotation = np.array([[np.cos(elevation), -np.sin(elevation)], [np.sin(elevation), np.cos(elevation)]])
    axes.add_patch(Polygon(eye + body @ rotation.T, color="0.25"))
    axes.text(eye[0] - 0.03, eye[1] + 0.07, "camera on a tripod,\nnever touched", size=SIZE)
    middle = aim + 0.62 * (eye - aim)
    axes.text(middle[0], middle[1] - 0.03, f"{100 * camera.distance_m:.0f} cm", size=SIZE, color=COLOURS[0])
    axes.add_patch(Arc(aim, 0.3, 0.3, theta1=0.0, theta2=camera.elevation_deg, color=COLOURS[0], linewidth=0.8))
    axes.text(0.155, camera.aim_height_m + 0.015, f"{camera.elevation_deg:.0f}°", size=SIZE, color=COLOURS[0])
    axes.set(xlim=(-WALL_M - 0.02, 0.6), ylim=(-0.08, 0.4))


def draw_top(axes: Axes, scene: Scene) -> None:
    """Disc, container and fruit, with the markers around the container and on the disc."""
    axes.add_patch(Circle((0.0, 0.0), scene.turntable.disc_diameter_m / 2, facecolor="0.93", edgecolor="0.45"))
    axes.add_patch(Circle((0.0, 0.0), scene.container.diameter_m / 2, facecolor="white", edgecolor="0.45"))
    axes.add_patch(Circle((0.0, 0.0), 0.033, color=FRUIT))
    around, on_disc = marker_frames(scene)
    half = scene.markers.side_m / 2
    for centre, sideways, _ in around.values():
        axes.plot(
            *np.stack([centre - half * sideways, centre + half * sideways])[:, :2].T, color="black", linewidth=3
        )
    for centre, u, v in on_disc.values():
        corners = np.stack([centre + half * (a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        axes.add_patch(Polygon(corners[:, :2], color="black"))
    radius = scene.turntable.disc_diameter_m / 2
    axes.add_patch(Arc((0, 0), 2.2 * radius, 2.2 * radius, theta1=100, theta2=150, color=COLOURS[0], linewidth=1.2))
    end = 1.1 * radius * np.array([np.cos(np.deg2rad(150)), np.sin(np.deg2rad(150))])
    axes.annotate("", end, end + np.array([0.003, 0.006]), arrowprops={"arrowstyle": "->", "color": COLOURS[0]})
    axes.text(-0.13, 0.105, '"ccw"', size=SIZE, color=COLOURS[0])
    axes.text(
        0.0,
        -0.128,
        f"{len(around)} markers around the container, {len(on_disc)} flat on the disc,",
        size=SIZE,
        ha="center",
    )
    axes.text(0.0, -0.142, "every number once; camera to the right", size=SIZE, ha="center")
    axes.add_patch(Polygon([(0.15, 0.012), (0.15, -0.012), (0.135, 0.0)], color="0.25"))
    axes.set(xlim=(-0.14, 0.16), ylim=(-0.15, 0.13))


if __name__ == "__main__":
    tyro.cli(CaptureDrawing).main()
