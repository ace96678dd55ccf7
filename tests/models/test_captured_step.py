"""Inputs of captured steps: where a graph reads them, whatever the number of rays."""

from types import SimpleNamespace

import torch
from nerfstudio.cameras.rays import RayBundle

from hsi_sc_nerf.models.captured_step import CapturedSteps


def batch_of(rays: int, value: float) -> tuple[RayBundle, dict[str, torch.Tensor]]:
    filled = torch.full((rays, 3), value)
    bundle = RayBundle(
        origins=filled,
        directions=filled,
        pixel_area=filled[:, :1],
        camera_indices=torch.zeros(rays, 1, dtype=torch.long),
        metadata={"directions_norm": filled[:, :1]},
    )
    return bundle, {"spectral": torch.full((4, 2), value)}


def test_batches_of_one_size_lie_where_their_graph_reads_them_and_others_elsewhere():
    steps = CapturedSteps(SimpleNamespace(device=torch.device("cpu")), [])
    first = steps._loaded(*batch_of(4, 1.0))
    places = {name: value.data_ptr() for name, value in first.items()}
    more = steps._loaded(*batch_of(7, 2.0))
    again = steps._loaded(*batch_of(4, 3.0))
    assert {name: value.data_ptr() for name, value in again.items()} == places
    assert again["rays/origins"].shape == (4, 3)
    assert (again["rays/origins"] == 3.0).all()
    assert (again["batch/spectral"] == 3.0).all()
    assert more["metadata/directions_norm"].shape == (7, 1)
    assert (more["batch/spectral"] == 2.0).all()
