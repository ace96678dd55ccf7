"""A training step, an evaluation and an export's rays on a GPU that is not there: tensors without values.

They know their devices. What mixes these, or brings something from one to the other in the inner loop, fails here.
(Backward passes need a real GPU; our own autograd functions' are called by themselves.)
"""

import copy
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from small_trainer import shrink
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from hsi_sc_nerf.config import hsi_sc_nerf, hsi_sc_nerf_paper
from hsi_sc_nerf.data.camera_rays import CameraRays
from hsi_sc_nerf.data.device_pixels import DevicePixels
from hsi_sc_nerf.fields import hash_grid
from hsi_sc_nerf.models.captured_step import forward_pass
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.numerics import _Widen
from hsi_sc_nerf.surface.surface_depth import render_object, surface_depth

RAYS = 32


class NoTransfers(TorchDispatchMode):
    """Refuses every operation that takes something from one device to the other; single numbers may go to a GPU."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        given = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        made = {leaf.device.type for leaf in tree_leaves(result) if isinstance(leaf, torch.Tensor)}
        copies = function.overloadpacket in (torch.ops.aten._to_copy, torch.ops.aten.copy_, torch.ops.aten.copy)
        for tensor in given:
            if made and tensor.device.type not in made and (copies or tensor.dim() > 0):
                raise AssertionError(f"{function} takes {tuple(tensor.shape)} from {tensor.device} to {made}")
        return result


def on_fake_gpu(value, mode):
    """Everything inside that is a tensor, on the GPU that is not there."""
    if isinstance(value, torch.Tensor):
        if isinstance(value, FakeTensor):
            return value
        fake = mode.from_tensor(value.detach())
        with mode:
            return fake.to("cuda")
    if isinstance(value, dict):
        return {key: on_fake_gpu(entry, mode) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return type(value)(on_fake_gpu(entry, mode) for entry in value)
    return value


def move_module(module, mode):
    for part in module.modules():
        for name, parameter in part._parameters.items():
            if parameter is not None:
                moved = on_fake_gpu(parameter, mode)
                part._parameters[name] = torch.nn.Parameter(moved, requires_grad=parameter.requires_grad)
        for name, buffer in part._buffers.items():
            part._buffers[name] = None if buffer is None else on_fake_gpu(buffer, mode)
        if isinstance(part, hash_grid.FusedHashEncoding):
            # As after the first step.
            part.scalings = on_fake_gpu(part.scalings, mode)


def small(method, data, **changes):
    config = copy.deepcopy(method.config.pipeline)
    config.datamanager.data = data
    shrink(config.model)
    for name, value in changes.items():
        setattr(config.model, name, value)
    return config.setup(device="cpu")


METHODS = {
    "ours": (hsi_sc_nerf, {}),
    # Normals of the density are gradients, which need a GPU.
    "paper": (hsi_sc_nerf_paper, {"predict_normals": False}),
}


@pytest.fixture(params=METHODS)
def on_gpu(request, flagged_dataset):
    """A pipeline's parts on the GPU that is not there; the dataset has values that are no measurements."""
    method, changes = METHODS[request.param]
    pipeline = small(method, flagged_dataset, **changes)
    manager = pipeline.datamanager
    frames, masks = manager.train_dataset.frames, manager.train_pixel_sampler.masks
    pixels = DevicePixels(frames, masks, "cpu", has_flagged=True)
    rays = CameraRays(manager.train_dataset.cameras)
    rays(torch.zeros(1, 3, dtype=torch.int64), quartered=1)  # makes its tables, which follow to the GPU
    mode = FakeTensorMode()
    move_module(pipeline.model, mode)
    collider = pipeline.model.collider
    if hasattr(collider, "scene_box"):  # nerfstudio leaves the box on the host, and takes single numbers from it
        collider.scene_box.aabb = mode.from_tensor(collider.scene_box.aabb)
    for part in (pixels, rays):
        for name, value in vars(part).items():
            setattr(part, name, on_fake_gpu(value, mode))
    with mode:
        indices = torch.zeros(RAYS, 3, dtype=torch.int64, device="cuda")
        assert pipeline.model.device.type == "cuda"
        yield SimpleNamespace(model=pipeline.model, pixels=pixels, rays=rays, indices=indices)


@pytest.mark.slow
def test_a_training_step_stays_on_the_device(on_gpu):
    model: SpectralModel = on_gpu.model.train()
    with NoTransfers():
        rays = on_gpu.rays(on_gpu.indices, quartered=RAYS // 4 if model.config.supersample_outline else 0)
        loss, terms, metrics = forward_pass(model, rays, on_gpu.pixels(on_gpu.indices))
    assert loss.device.type == "cuda"
    assert {value.device.type for value in (*terms.values(), *metrics.values())} == {"cuda"}


@pytest.mark.slow
def test_rays_of_pixels_that_were_read_from_files_are_on_the_device(on_gpu):
    rays = on_gpu.rays(torch.zeros(RAYS, 3, dtype=torch.int64), quartered=RAYS // 4)
    assert {rays.origins.device.type, rays.directions.device.type, rays.camera_indices.device.type} == {"cuda"}


@pytest.mark.slow
def test_rays_of_a_view_and_of_an_export_stay_on_the_device(on_gpu):
    model = on_gpu.model.eval()
    with NoTransfers(), torch.no_grad(), torch.device("cuda"):
        outputs, spectra = render_object(model, on_gpu.rays(on_gpu.indices))
        assert spectra.device == outputs["spectral"].device
        rays = on_gpu.rays(on_gpu.indices)
        cosines = torch.ones(RAYS, 1, device="cuda")
        depth, opacity = surface_depth(model, rays.origins, rays.directions, outputs["depth"], cosines)
    assert depth.device.type == opacity.device.type == "cuda"


def test_mixed_devices_and_hidden_transfers_are_refused():
    with FakeTensorMode(), NoTransfers():
        there, here = torch.ones(3, device="cuda"), torch.ones(3)
        for mixed in (lambda: there + here, lambda: there + here.to("cuda"), lambda: there[[0, 2]], there.cpu):
            with pytest.raises((AssertionError, RuntimeError)):
                mixed()
        with pytest.raises(Exception, match=r"item|local_scalar"):
            float(there.sum())
        assert (there + 2.0 * here.sum()).device.type == "cuda"


def test_own_backward_passes_stay_on_the_device():
    context = SimpleNamespace(needs_input_grad=(True, True, False, False), table_size=16, dtype=torch.float32)
    with FakeTensorMode(), NoTransfers(), torch.no_grad():
        context.save_for_backward = lambda *tensors: setattr(context, "saved_tensors", tensors)
        positions, table, scalings = (torch.ones(*shape, device="cuda") for shape in ((5, 3), (48, 2), (3,)))
        features = hash_grid._Interpolate.forward(context, positions, table, scalings, 16)
        assert features.shape == (5, 6)
        to_positions, to_table, *_ = hash_grid._Interpolate.backward(context, features)
        assert to_positions.shape == (5, 3)
        assert to_table.shape == (48, 2)
        assert {to_positions.device.type, to_table.device.type} == {"cuda"}
        wide = _Widen.forward(context, positions)
        assert _Widen.backward(context, wide).device.type == "cuda"


def test_held_pixels_equal_those_read_from_files(flagged_dataset, device):
    manager = small(hsi_sc_nerf, flagged_dataset).datamanager
    sampler = manager.train_pixel_sampler
    held = DevicePixels(manager.train_dataset.frames, sampler.masks, device, has_flagged=True)
    read = sampler.sample(3, 0.5, 0.5)
    indices = torch.from_numpy(sampler.draw(3, 0.5, 0.5)[0]).to(device)
    for name, value in held(indices).items():
        np.testing.assert_array_equal(value.cpu().numpy(), read[name])


def test_pixels_of_either_byte_order_are_the_same():
    counts = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)
    indices = torch.tensor([[0, 1, 2]])
    found = [
        DevicePixels(
            [SimpleNamespace(cube=lambda kind=kind: counts.astype(kind))],
            np.ones((1, 2, 3), bool),
            "cpu",
            has_flagged=False,
        )
        for kind in ("<u2", ">u2")
    ]
    torch.testing.assert_close(*(pixels(indices)["spectral"] for pixels in found))
