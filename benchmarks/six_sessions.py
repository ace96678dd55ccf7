"""Six small simulated sessions for `hsi-sc-nerf batch`, of which one is broken and one has no markers.

``batch_slurm.py`` runs them on a SLURM, ``tests/cli/test_batch_sessions.py`` three of them on this machine.
"""

from __future__ import annotations

import csv
import shutil
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import WHITE_REFERENCE, simulate_session

BROKEN, UNMARKED = "broken", "unmarked"
WHOLE = ("apple", "pear_1", "pear_2", "tomato")
OBJECTS = {
    # A pear of 20 steps; the others have fewer.
    "pear_1": ("pear", "A", "--max-num-iterations 20"),
    "pear_2": ("pear", "B", ""),
    "apple": ("apple", "A", ""),
    "tomato": ("tomato", "B", ""),
    BROKEN: ("pear", "A", ""),
    UNMARKED: ("apple", "B", ""),
}
"""Of each session the fruit, its genotype and its own words for the training."""
TRAIN = "--pipeline.datamanager.train-num-rays-per-batch 64 --pipeline.model.match-resolution False"
TRAIN += " --pipeline.model.num-levels 8 --pipeline.model.log2-hashmap-size 12 --pipeline.model.max-res 64"
TRAIN += " --pipeline.model.proposal-warmup 100 --evaluate-stages False"
"""A model that takes seconds."""
TRAITS = "--mesh.octree-depth 5"


def write_six_sessions(folder: Path, names: Collection[str] = tuple(OBJECTS)) -> Path:
    """Simulate the sessions of these names in ``folder/captures``; the broken one is a copy of ``pear_1``.

    Returns:
        The list that names them, ``folder/season.csv``.
    """
    objects = {name: known for name, known in OBJECTS.items() if name in names}
    for seed, (name, (kind, *_)) in enumerate(OBJECTS.items(), start=1):
        if name in objects and name != BROKEN:
            _simulate(folder / "captures" / name, kind, seed, marked=name != UNMARKED)
    shutil.copytree(folder / "captures" / "pear_1", folder / "captures" / BROKEN)
    cut = folder / "captures" / BROKEN / WHITE_REFERENCE / "capture" / f"{WHITE_REFERENCE}.raw"
    cut.write_bytes(cut.read_bytes()[:-1000])
    path = folder / "season.csv"
    with path.open("w", newline="") as file:
        rows = [(name, f"captures/{name}", genotype, train) for name, (_, genotype, train) in objects.items()]
        csv.writer(file).writerows([("object", "session", "genotype", "train"), *rows])
    return path


def _simulate(session: Path, kind: str, seed: int, marked: bool) -> None:
    """Eight frames in which the markers are just large enough."""
    scene = override(load_scene(kind), frames=8, size_px=64, bands=8, seed=seed)
    if kind == "apple":
        # Its own camera sees the markers at less favourable pixels.
        scene = replace(scene, camera=override(load_scene("pear"), size_px=64).camera)
    if not marked:
        scene = replace(scene, markers=replace(scene.markers, on_container=0, on_disc=0))
    simulate_session(scene, session, progress=False)
