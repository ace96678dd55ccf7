"""PLY files of points and polygons (Turk 1994): what a header claims is compared with the file before it is read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Int, Shaped
from plyfile import PlyData, PlyElement, PlyElementParseError, PlyListProperty, PlyParseError

from hsi_sc_nerf.errors import InputError

_LONGEST_HEADER = 2**20
# Bytes of a number; plyfile refuses types that are not here.
_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
NO_SCALE = "unknown; lengths are in distances of the camera from the turntable's axis"
"""What a file says of its ``scale`` where nothing gave it."""
_ASCII_BYTES = 2
"""The shortest number of a text file and the blank behind it."""


def read_ply(path: Path) -> PlyData:
    """Read a PLY file of points, ASCII or binary; columns of a binary file are mapped and not loaded.

    Raises:
        InputError: there is no such file, it is no PLY, it is shorter than its header says, or it has no points or
            such that hold lists.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give a PLY file.")
    try:
        _check_counts(path)
        try:
            # Triangles of known length are mapped into memory; others take plyfile seconds.
            content = PlyData.read(str(path), known_list_len={"face": {"vertex_indices": 3}})
        except PlyElementParseError:
            content = PlyData.read(str(path))
    except (OSError, PlyParseError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: cannot be read as a PLY file ({error}); export it again.") from error
    if "vertex" not in content or not all(axis in content["vertex"] for axis in "xyz"):
        raise InputError(f"{path}: has no points with x, y and z; give a point cloud or a mesh.")
    lists = [column.name for column in content["vertex"].properties if isinstance(column, PlyListProperty)]
    if lists:
        raise InputError(f"{path}: its points hold lists ({', '.join(lists)}); save it without them.")
    return content


def _check_counts(path: Path) -> None:
    """Refuse a header that claims more than the file can hold, before memory is made for it.

    Raises:
        ValueError: there is no such header, or the file is shorter than it says.
    """
    with path.open("rb") as file:
        start = file.read(_LONGEST_HEADER)
    header, end, _ = start.partition(b"end_header")
    if not start.startswith(b"ply") or not end:
        raise ValueError("it does not begin with a PLY header")
    row_bytes, counts, is_text = list[int](), list[int](), False
    for words in map(str.split, header.decode("latin-1").splitlines()):
        if words[:1] == ["format"]:
            is_text = "ascii" in words
        elif words[:1] == ["element"]:
            if not (len(words) == 3 and words[2].isascii() and words[2].isdigit() and len(words[2]) < 16):
                raise ValueError("an element does not say how many there are")
            counts.append(int(words[2]))
            row_bytes.append(0)
        elif words[:1] == ["property"] and counts and len(words) > 2:
            # Of a list, the number of its entries.
            row_bytes[-1] += _ASCII_BYTES if is_text else _SIZES.get(words[2 if words[1] == "list" else 1], 1)
    # Rows without a number are none; the last number of a text may have no blank behind it.
    claimed = sum(count * max(size, 1) for count, size in zip(counts, row_bytes, strict=True))
    if claimed > path.stat().st_size - len(header) + 1:
        raise ValueError("it is shorter than its header says")


def is_metric(content: PlyData) -> bool:
    """Whether lengths may be metres: no comment says that nothing gave the scale."""
    return f"scale: {NO_SCALE}" not in content.comments


def ply_vertices(columns: Mapping[str, Shaped[np.ndarray, "v"]]) -> PlyElement:
    """The element ``vertex`` of a PLY file from its properties by name, in order; types are kept."""
    rows = np.empty(len(next(iter(columns.values()))), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    return PlyElement.describe(rows, "vertex")


def ply_triangles(content: PlyData) -> Int[np.ndarray, "t 3"]:
    """Triangles of a PLY file with vertices; polygons are cut into fans, and a point cloud has no triangles.

    Raises:
        ValueError: the faces have no list of vertices, or refer to vertices that are not in the file.
    """
    if "face" not in content or not content["face"].count:
        return np.zeros((0, 3), np.int64)
    lists = [column.name for column in content["face"].properties if isinstance(column, PlyListProperty)]
    name = next((name for name in lists if name in ("vertex_indices", "vertex_index")), None)
    if name is None:
        raise ValueError("its faces have no vertex_indices")
    faces = content["face"][name]
    corners = np.array([len(face) for face in faces])
    fans = [
        np.stack(faces[corners == count])[:, [0, step, step + 1]]
        for count in np.unique(corners)
        for step in range(1, count - 1)
    ]
    triangles = np.concatenate(fans).astype(np.int64) if fans else np.zeros((0, 3), np.int64)
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < content["vertex"].count:
        raise ValueError("its faces refer to vertices that do not exist")
    return triangles
