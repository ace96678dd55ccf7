"""Several objects on one table: each is measured as if it were alone, and one page and one file hold all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig
from hsi_sc_nerf.analysis.drawn_regions import DrawnRegion
from hsi_sc_nerf.analysis.measurement import Measurement, measure_traits, on_container
from hsi_sc_nerf.analysis.measurement_files import delete_earlier, write_measurement
from hsi_sc_nerf.analysis.report import MM_PER_M, PIECES, scale_note, trait_tables
from hsi_sc_nerf.analysis.standing_pieces import standing_pieces
from hsi_sc_nerf.export.cloud import SpectralCloud
from hsi_sc_nerf.files import atomic_write, make_folder, write_json
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.terminal import markdown_table, markdown_text


def measure_pieces(
    cloud: SpectralCloud,
    dataset: PackedDataset | None = None,
    *,
    mesh: MeshConfig | None = None,
    regions: Mapping[str, Sequence[float]] | None = None,
    drawn_regions: Sequence[DrawnRegion] = (),
    piece: int | None = None,
    **settings: Any,
) -> list[Measurement]:
    """Measure each object that stands on the table, the one of the largest surface first.

    A region belongs to the object that is nearest to its centre, a drawn one to all objects that it has points on.

    Args:
        cloud: metres, z up.
        dataset: that the cloud was made from.
        mesh: settings of the mesh.
        regions: `measure_traits`.
        drawn_regions: `measure_traits`.
        piece: number of the only one to measure, from 1; None for all.
        settings: further arguments of `measure_traits`.

    Raises:
        InputError: as `measure_traits`.

    Example:
        >>> [found.size.volume_l for found in measure_pieces(read_spectral_ply("point_cloud.ply"), splits=0)]
        [0.0042, 0.0037]
    """
    config = on_container(MeshConfig() if mesh is None else mesh, dataset)
    pieces = standing_pieces(cloud.points, config)
    if len(pieces) == 1 or piece is not None:
        alone = measure_traits(
            cloud, dataset, mesh=config, regions=regions, drawn_regions=drawn_regions, piece=piece, **settings
        )
        return [alone]
    tree, rows_of = cKDTree(cloud.points), [set(rows.tolist()) for rows in pieces]

    def hold(number: int, points_m: Float[np.ndarray, "n 3"]) -> bool:
        """Whether the object is the nearest to one of the points."""
        return not rows_of[number].isdisjoint(tree.query(points_m)[1].tolist())

    return [
        measure_traits(
            cloud,
            dataset,
            mesh=config,
            regions={name: at for name, at in (regions or {}).items() if hold(number, np.array([at[:3]], float))},
            drawn_regions=[one for one in drawn_regions if hold(number, one.points_m[one.chosen])],
            piece=number + 1,
            **settings,
        )
        for number in range(len(pieces))
    ]


def write_pieces(folder: Path | str, pieces: Sequence[Measurement], name: str, piece: int | None = None) -> None:
    """Write the files of `write_measurement`: of one object into ``folder``, of several into piece-1, piece-2, ...

    Of several, ``traits.json`` in ``folder`` holds all; its ``traits.md`` compares their sizes and links their pages.
    Files of an earlier result there, of another number of objects, are deleted.

    Args:
        folder: to write to.
        pieces: pieces of `measure_pieces`.
        name: name of the cloud, which the pages state.
        piece: number of the only one that was measured, which they state as well.

    Raises:
        InputError: the files cannot be written.

    Example:
        >>> pieces = measure_pieces(read_spectral_ply(Path("point_cloud.ply")))
        >>> write_pieces("traits", pieces, "point_cloud.ply")
    """
    folder = Path(folder)
    if len(pieces) == 1:
        write_measurement(folder, pieces[0], name if piece is None else f"{name}, piece {piece}")
        _delete_pieces(folder, above=0)
        return
    contents = []
    for number, measured in enumerate(pieces, start=1):
        own = folder / f"piece-{number}"
        make_folder(own)
        content = write_measurement(own, measured, f"{name}, piece {number}")
        vertices = measured.surface.mesh.vertices
        centre_m = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
        contents.append({"piece": number, "centre_m": centre_m.tolist(), **content})
    write_json(folder / "traits.json", {PIECES: contents})
    with atomic_write(folder / "traits.md") as (temporary,):
        temporary.write_text(_page(contents, name), encoding="utf-8")
    delete_earlier(folder, keep=("traits.json", "traits.md"))
    _delete_pieces(folder, above=len(pieces))


def _delete_pieces(folder: Path, above: int) -> None:
    """What an earlier result wrote of pieces with a number above this one."""
    for own in folder.glob("piece-*"):
        number = own.name.removeprefix("piece-")
        if number.isdecimal() and int(number) > above:
            delete_earlier(own)


def _page(contents: Sequence[Mapping[str, Any]], name: str) -> str:
    """The page of several objects: their places and sizes, and links to their own pages."""
    sizes = [trait_tables(content)[0].rows for content in contents]
    header = ["piece", "x, mm", "y, mm", *(f"{trait}, {unit}" for trait, _, unit in sizes[0])]
    rows = [
        [
            str(content["piece"]),
            *(f"{MM_PER_M * at:.1f}" for at in content["centre_m"][:2]),
            *(value for _, value, _ in size),
        ]
        for content, size in zip(contents, sizes, strict=True)
    ]
    note = f"{len(contents)} objects stand on the table; x and y are of their middle, object frame."
    return "\n\n".join(
        [
            f"# Traits of {markdown_text(name)}",
            f"{scale_note(contents[0])} {note}".lstrip(),
            markdown_table(header, rows),
            *(f"[All traits of piece {c['piece']}](piece-{c['piece']}/traits.md)" for c in contents),
            "",
        ]
    )
