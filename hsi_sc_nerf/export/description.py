"""What the file of a cloud says about itself: software, run, frame, and the unit and meaning of each column.

Units and attributes are those of the CF conventions 1.11.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from hsi_sc_nerf import __version__

FRAME = (
    "object frame: z points up along the turntable's axis, 0 on the disc; x points from the axis to the camera of "
    "the first frame"
)
REFLECTANCE = ("1", "reflectance factor relative to the white reference in full light")
_POSITION = ("m", "position in the object frame")
_NORMAL = ("1", "outward unit normal")
_COLOUR = ("1", "pseudo-RGB of the spectrum, 0 to 255")
COLUMNS: dict[str, tuple[str, str]] = {
    **dict.fromkeys("xyz", _POSITION),
    **dict.fromkeys(("nx", "ny", "nz"), _NORMAL),
    **dict.fromkeys(("red", "green", "blue"), _COLOUR),
    "opacity": ("1", "opacity that the point's ray collects, 0 to 1"),
    "incidence_deg": ("degree", "angle between the normal and the ray that gave the spectrum"),
    "views": ("1", "number of training frames that see the point"),
    "spectral_std": ("1", "standard deviation of the reflectance measured in these frames, mean over bands"),
    "saturated": ("1", "fraction of these frames in which the pixel is saturated or without data"),
    "sampled_views": ("1", "number of training views that were averaged"),
    "sampled_std": ("1", "standard deviation of the reflectance over these views, mean over bands"),
}
"""CF unit and meaning of each column that this package writes, the bands' apart."""


def run_name(load_config: Path) -> str:
    """EXPERIMENT/METHOD/TIME of a run, as nerfstudio names its folder; where it lies is nobody else's business."""
    return "/".join(load_config.resolve().parent.parts[-3:])


def cloud_attributes(run: str = "") -> dict[str, str]:
    """Global attributes of a file; ``run`` is the name of the run, where one made the cloud."""
    attributes = {
        "title": "spectral point cloud",
        "source": f"hsi-sc-nerf {__version__}",
        "references": "https://arxiv.org/abs/2602.16950",
        "comment": FRAME,
    }
    return attributes | ({"run": run} if run else {})


def comment_lines(columns: Iterable[str], run: str = "") -> list[str]:
    """Attributes and the meaning of the columns as lines of text, in ASCII: ``x y z [m]: position ...``.

    Args:
        columns: names of the columns; those that have no stated meaning are left out.
        run: name of the run.

    Example:
        >>> comment_lines(["views"])[-1]
        'views [1]: number of training frames that see the point'
    """
    lines = [f"{name}: {value}" for name, value in cloud_attributes(run).items()]
    lines.append("bands [{}]: {}, one column a band, named by its centre in nm".format(*REFLECTANCE))
    alike: dict[tuple[str, str], list[str]] = {}
    for name in columns:
        if name in COLUMNS:
            alike.setdefault(COLUMNS[name], []).append(name)
    lines += [f"{' '.join(names)} [{unit}]: {meaning}" for (unit, meaning), names in alike.items()]
    return [" ".join(line.encode("ascii", "backslashreplace").decode().split()) for line in lines]
