import struct

import numpy as np
import pytest

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.ply_file import ply_triangles, read_ply

XYZ = "property float x\nproperty float y\nproperty float z\n"
BINARY, ASCII = "binary_little_endian", "ascii"


def write(path, form, properties, body=b"", count="1"):
    path.write_bytes(f"ply\nformat {form} 1.0\nelement vertex {count}\n{properties}end_header\n".encode() + body)
    return path


@pytest.mark.parametrize(("form", "body"), [(BINARY, struct.pack("<3f", 1, 2, 3)), (ASCII, b"1 2 3")])
def test_a_file_that_holds_just_what_it_says_is_read(tmp_path, form, body):
    read = read_ply(write(tmp_path / "a.ply", form, XYZ, body))
    np.testing.assert_array_equal([read["vertex"][axis] for axis in "xyz"], [[1], [2], [3]])


@pytest.mark.parametrize("form", [BINARY, ASCII])
@pytest.mark.parametrize("count", ["2", "1000000000", "9" * 15, "9" * 5000, "-1", "1e9", "one"])
def test_a_count_that_the_file_cannot_hold_is_refused_before_room_is_made_for_it(tmp_path, form, count):
    with pytest.raises(InputError, match=r"a\.ply: cannot be read"):
        read_ply(write(tmp_path / "a.ply", form, XYZ, struct.pack("<3f", 1, 2, 3), count))


def test_a_polygon_of_more_corners_than_the_file_is_refused(tmp_path):
    faces = XYZ + "element face 1\nproperty list uint int vertex_indices\n"
    body = struct.pack("<3fI3i", 1, 2, 3, 2**32 - 1, 0, 0, 0)
    with pytest.raises(InputError, match=r"a\.ply: cannot be read"):
        read_ply(write(tmp_path / "a.ply", BINARY, faces, body))


@pytest.mark.parametrize(
    ("properties", "body", "told"),
    [
        (XYZ + "property float x\n", b"1 2 3 4", "cannot be read"),
        (XYZ + "property complex q\n", b"1 2 3 4", "cannot be read"),
        ("property float x\n", b"1", "no points"),
        (XYZ + "property list uchar float spectrum\n", b"1 2 3 1 0.5", r"hold lists \(spectrum\)"),
        (XYZ + "property uchar red\n", b"1 2 3 999", "cannot be read"),
    ],
)
def test_odd_properties_are_refused(tmp_path, properties, body, told):
    with pytest.raises(InputError, match=rf"a\.ply.*{told}"):
        read_ply(write(tmp_path / "a.ply", ASCII, properties, body))


def test_polygons_become_fans_of_triangles(tmp_path):
    faces = "element face 2\nproperty list uchar int vertex_indices\n"
    body = b"0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n3 0 1 3\n"
    read = read_ply(write(tmp_path / "a.ply", ASCII, XYZ + faces, body, "4"))
    assert sorted(map(tuple, ply_triangles(read))) == [(0, 1, 2), (0, 1, 3), (0, 2, 3)]
