"""A user's own mesh: each format and way of laying materials on gives what was put in; bad files get one sentence."""

import numpy as np
import pytest
import trimesh
from plyfile import PlyData, PlyElement

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate import own_mesh
from hsi_sc_nerf.simulate.mesh import cylinder, snapped, subdivided, welded
from hsi_sc_nerf.simulate.scene import OwnMesh

RADIUS_M = 0.03
TWO, THREE = ("a", "b"), ("a", "b", "c")


def uv_sphere(rings=24, segments=36):
    """A sphere about (1, 2, 3) whose vertices repeat along the seam and at the poles; UVs are azimuth, latitude."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, segments + 1), np.linspace(0, 1, rings + 1)))
    latitude, azimuth = np.pi * (v - 0.5), 2 * np.pi * np.where(u == 1.0, 0.0, u)
    r = np.where((v == 0.0) | (v == 1.0), 0.0, np.cos(latitude))
    vertices = RADIUS_M * np.stack([r * np.cos(azimuth), r * np.sin(azimuth), np.sin(latitude)], axis=-1)
    corner = np.arange(rings * (segments + 1)).reshape(rings, -1)[:, :-1].ravel()
    right, above = corner + 1, corner + segments + 1
    triangles = np.concatenate([np.stack([corner, right, above + 1], -1), np.stack([corner, above + 1, above], -1)])
    return vertices + np.array([1.0, 2.0, 3.0]), triangles, np.stack([u, v], axis=-1)


def save(path, vertices, triangles, uv):
    if path.suffix == ".obj":
        lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in vertices]
        lines += [f"vt {u:.17g} {v:.17g}" for u, v in uv]
        lines += ["f " + " ".join(f"{i}/{i}" for i in t) for t in triangles + 1]
        path.write_text("\n".join(lines) + "\n")
        return
    if path.suffix in (".glb", ".gltf"):
        vertices = vertices @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]).T  # z up to y up
    mesh = trimesh.Trimesh(vertices, triangles, process=False, visual=trimesh.visual.TextureVisuals(uv=uv))
    if path.suffix == ".gltf":
        for name, content in trimesh.Scene(mesh).export(file_type="gltf").items():
            (path.parent / (path.name if name == "model.gltf" else name)).write_bytes(content)
    else:
        mesh.export(path)


def save_ply(path, vertices, triangles, columns):
    vertex = np.empty(len(vertices), [(name, "<f8") for name in ("x", "y", "z", *columns)])
    for name, column in zip(vertex.dtype.names, [*vertices.T, *columns.values()], strict=True):
        vertex[name] = column
    face = np.empty(len(triangles), [("vertex_indices", "<i4", (3,))])
    face["vertex_indices"] = triangles
    PlyData([PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")]).write(path)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_every_format_stands_upright_on_the_axis_at_its_scale(tmp_path, suffix):
    vertices, triangles, uv = uv_sphere()
    is_low = vertices[:, 2] < 3.0 - 1e-9
    vertices[is_low, :2] = 0.6 * (vertices[is_low, :2] - [1.0, 2.0]) + [1.0, 2.0]
    save(tmp_path / f"egg{suffix}", vertices, triangles, uv)
    mesh, weights = own_mesh.load(OwnMesh("mesh", tmp_path / f"egg{suffix}", ("a",)))
    np.testing.assert_array_equal(weights, 1.0)
    assert mesh.is_watertight()
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-RADIUS_M, -RADIUS_M, 0.0], atol=1e-6)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [RADIUS_M, RADIUS_M, 2 * RADIUS_M], atol=1e-6)
    low, high = (np.ptp(mesh.vertices[np.abs(mesh.vertices[:, 2] - z) < 0.004, 0]) for z in (0.02, 0.04))
    assert low < 0.8 * high
    taller, _ = own_mesh.load(OwnMesh("mesh", tmp_path / f"egg{suffix}", ("a",), height_m=0.12))
    assert taller.volume_m3() == pytest.approx(8.0 * mesh.volume_m3(), rel=1e-5)


def test_up_axis_overrides_the_format(tmp_path):
    vertices, triangles, uv = uv_sphere()
    save(tmp_path / "long.ply", (vertices - vertices.mean(axis=0)) * [1, 2, 1], triangles, uv)
    mesh, _ = own_mesh.load(OwnMesh("mesh", tmp_path / "long.ply", ("a",), up_axis="y"))
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [2 * RADIUS_M, 2 * RADIUS_M, 4 * RADIUS_M], rtol=1e-3)


def test_vertex_properties_come_through_normalised_and_in_the_order_of_the_scene(tmp_path):
    vertices, triangles, uv = uv_sphere()
    rise = np.rint(255 * uv[:, 1])
    save_ply(tmp_path / "ball.ply", vertices, triangles, {"weight_b": rise, "weight_a": 255.0 - rise})
    mesh, weights = own_mesh.load(OwnMesh("mesh", tmp_path / "ball.ply", TWO))
    height = (mesh.vertices[:, 2] - RADIUS_M) / RADIUS_M
    np.testing.assert_allclose(weights[:, 1], np.arcsin(np.clip(height, -1, 1)) / np.pi + 0.5, atol=0.003)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-12)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_vertex_colours_are_fractions(tmp_path, suffix):
    vertices, triangles, _ = uv_sphere()
    if suffix == ".glb":
        vertices = vertices[:, [0, 2, 1]] * [1, 1, -1]
    is_low = vertices[:, 1 if suffix == ".glb" else 2] < 3.0
    colours = np.where(is_low[:, None], [0, 200, 0, 255], [50, 0, 150, 255]).astype(np.uint8)
    mesh = trimesh.Trimesh(vertices, triangles, process=False, vertex_colors=colours)
    mesh.export(tmp_path / f"ball{suffix}")
    mesh, weights = own_mesh.load(OwnMesh("mesh", tmp_path / f"ball{suffix}", THREE))
    low = mesh.vertices[:, 2] < RADIUS_M - 1e-4
    np.testing.assert_allclose(weights[low], np.tile([0, 1, 0], (low.sum(), 1)), atol=1e-12)
    high = mesh.vertices[:, 2] > RADIUS_M + 1e-4
    np.testing.assert_allclose(weights[high], np.tile([0.25, 0, 0.75], (high.sum(), 1)), atol=0.005)


@pytest.mark.parametrize("flip", [slice(None), slice(None, None, 3)], ids=["all", "some"])
def test_triangles_that_face_inwards_are_turned(tmp_path, flip):
    vertices, triangles, _ = uv_sphere()
    expected, _ = welded(vertices, triangles, np.ones((len(vertices), 1)))
    triangles = triangles.copy()
    triangles[flip] = triangles[flip, ::-1]
    save_ply(tmp_path / "ball.ply", vertices, triangles, {})
    mesh, _ = own_mesh.load(OwnMesh("mesh", tmp_path / "ball.ply", ("a",)))
    assert mesh.is_watertight()
    assert mesh.volume_m3() == pytest.approx(expected.volume_m3(), rel=1e-6)


@pytest.mark.parametrize("longest", [0.5, 0.03, 0.004])
def test_cutting_edges_keeps_surface_and_columns(longest):
    coarse = cylinder(0.06, 0.08, segments=7)
    vertices = np.column_stack([coarse.vertices, coarse.vertices @ [1.0, 2.0, 3.0]])
    fine, triangles = subdivided(vertices, coarse.triangles, longest)
    mesh = Mesh(fine[:, :3], triangles)
    assert mesh.is_watertight()
    assert mesh.area_m2() == pytest.approx(coarse.area_m2(), rel=1e-12)
    assert mesh.volume_m3() == pytest.approx(coarse.volume_m3(), rel=1e-12)
    np.testing.assert_allclose(fine[:, 3], fine[:, :3] @ [1.0, 2.0, 3.0], atol=1e-15)
    ends = fine[triangles, :3]
    assert np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=-1).max() <= longest


def test_a_seam_that_an_exporter_rounded_is_closed(tmp_path):
    vertices, triangles, uv = uv_sphere()
    save(
        tmp_path / "ball.obj", vertices + np.random.default_rng(0).uniform(-1e-9, 1e-9, vertices.shape), triangles, uv
    )
    mesh, _ = own_mesh.load(OwnMesh("mesh", tmp_path / "ball.obj", ("a",)))
    assert mesh.is_watertight()


def test_welding_averages_columns_and_drops_empty_triangles():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [-0.0, 0, 0], [1, 0, 0]], float)
    mesh, columns = welded(vertices, np.array([[0, 1, 2], [3, 0, 2]]), np.array([[0.0], [1], [2], [4], [3]]))
    np.testing.assert_array_equal(mesh.vertices[mesh.triangles], [[[0, 0, 0], [1, 0, 0], [1, 1, 0]]])
    np.testing.assert_array_equal(columns.ravel(), [2.0, 2.0, 2.0])


def test_snapping_moves_near_vertices_to_one_place():
    vertices = np.array([[0.1, 0.2, 0.3], [0.1 + 1e-9, 0.2, 0.3], [0.5, 0.2, 0.3]])
    np.testing.assert_array_equal(snapped(vertices, 1e-6), vertices[[0, 0, 2]])


def refused(tmp_path, sentence, file="ball.ply", materials=TWO, **keys):
    with pytest.raises(InputError) as caught:
        own_mesh.load(OwnMesh("mesh", tmp_path / file, materials, **keys))
    message = str(caught.value)
    assert sentence in message
    assert str(tmp_path) in message
    assert "\n" not in message


def test_bad_meshes_get_one_sentence(tmp_path):
    vertices, triangles, _ = uv_sphere()
    refused(tmp_path, "there is no such file")
    (tmp_path / "ball.stl").write_text("solid")
    refused(tmp_path, "not a mesh format", "ball.stl")
    for suffix in own_mesh.FORMATS:
        (tmp_path / f"broken{suffix}").write_bytes(b"ply\nnonsense\x00\xff")
        with pytest.raises(InputError, match=r"cannot be read as|has no triangles"):
            own_mesh.load(OwnMesh("mesh", tmp_path / f"broken{suffix}", ("a",)))
    save_ply(tmp_path / "ball.ply", vertices, triangles[:0], {})
    refused(tmp_path, "has no triangles")
    save_ply(tmp_path / "ball.ply", vertices, triangles[:-40], {})
    refused(tmp_path, "is not closed", materials=("a",))
    save_ply(tmp_path / "ball.ply", vertices * 1000.0, triangles, {})
    refused(tmp_path, "and 60 m tall", materials=("a",))
    save_ply(tmp_path / "ball.ply", vertices * [1, 1, 0], triangles, {})
    refused(tmp_path, "is flat", materials=("a",))
    save_ply(tmp_path / "ball.ply", np.where(vertices > 3.0, np.nan, vertices), triangles, {})
    refused(tmp_path, "not finite", materials=("a",))


def test_bad_weights_get_one_sentence(tmp_path):
    vertices, triangles, uv = uv_sphere()
    save_ply(tmp_path / "ball.ply", vertices, triangles, {})
    refused(tmp_path, "does not locate its materials a, b")
    save_ply(tmp_path / "ball.ply", vertices, triangles, {"weight_a": uv[:, 0]})
    refused(tmp_path, "have no property weight_b")
    save_ply(tmp_path / "ball.ply", vertices, triangles, {"weight_a": uv[:, 0], "weight_b": 0 * uv[:, 0]})
    refused(tmp_path, "are 0 for every material")
    save_ply(tmp_path / "ball.ply", vertices, triangles, {"weight_a": uv[:, 0], "weight_b": -1 - uv[:, 0]})
    refused(tmp_path, "are negative")
