"""The differentiable functions of a training step beside the losses: finite differences, an obvious reference, low
precision, hard values. Losses and safe arithmetic have theirs in models/test_losses.py and test_numerics.py.
"""

import math

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from ray_samples import samples_along
from scipy.linalg import expm
from torch.func import functional_call
from torch.nn import functional

from hsi_sc_nerf.fields.camera_shading import LARGEST_LOG_GAIN, CameraShading
from hsi_sc_nerf.fields.hash_grid import interpolate_hash_grid
from hsi_sc_nerf.fields.spectral_field import CoefficientGain, density_of
from hsi_sc_nerf.fields.surface_opacity import opaque_density
from hsi_sc_nerf.geometry.camera import cross_matrix, look_at
from hsi_sc_nerf.models.backgrounds import interpolate_image
from hsi_sc_nerf.models.compositing import BasisDecoder, SpectralRenderer
from hsi_sc_nerf.models.density_losses import free_space_loss, separate_distortion
from hsi_sc_nerf.models.pose_refinement import PoseRefinementConfig

BOX = torch.tensor([[-1.0, -0.5, -1.0], [1.0, 0.5, 0.2]])
POSE = look_at(np.array([2.0, 0.3, 0.9]), np.array([0.0, 0.0, 0.1]))
LOW_PRECISIONS = [torch.float16, torch.bfloat16]
some = settings(deadline=None, max_examples=40)


def random(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


class Method(torch.nn.Module):
    """A method of a module as a function of the module's parameters."""

    def __init__(self, module, name):
        super().__init__()
        self.module, self.name = module, name
        self.leaves = [parameter.detach().clone() for parameter in module.parameters()]

    def forward(self, *arguments):
        return getattr(self.module, self.name)(*arguments)

    def of(self, parameters, *arguments):
        names = [name for name, _ in self.named_parameters()]
        return functional_call(self, dict(zip(names, parameters, strict=True)), arguments)


def segments():
    """Starts and ends of samples along rays, some of which touch."""
    edges = random(3, 10).cumsum(-1)
    edges[:, 4] = edges[:, 3]
    return edges[:, ::2], edges[:, 1::2]


def light_through(density):
    return samples_along(*segments()).get_weights(density)


def spectrum(behind):
    decoder = BasisDecoder(random(4, 3, seed=2))

    def rendered(coefficients, weights):
        return decoder.to(coefficients.dtype)(SpectralRenderer(behind)(coefficients, weights))

    return rendered, [random(3, 5, 3), 0.2 * random(3, 5, 1, seed=1)]


def shading():
    """A shading that has learned something, of a soft ball."""
    torch.manual_seed(0)
    made = CameraShading((9, 9, 9), -torch.ones(3), 2.0 / 9.0, 3, torch.from_numpy(POSE), torch.zeros(3), -0.5)
    positions = torch.stack(torch.meshgrid(*[torch.arange(9) - 4.0] * 3, indexing="ij"), dim=-1)
    made.refresh(torch.sigmoid(3.0 - positions.norm(dim=-1)))
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape))
    return made.double()


def of_shading():
    made = shading()
    method = Method(made, "forward")
    points, origins = random(6, 3) - 0.5, torch.from_numpy(POSE[:3, 3]) + 0.1 * random(6, 3, seed=1)
    return lambda coefficients, *leaves: method.of(leaves, coefficients, points, origins, made.normals(points)), [
        random(6, 3, seed=2),
        *method.leaves,
    ]


def refinement(mode, size):
    made = PoseRefinementConfig(mode=mode).setup(
        camera_to_world=POSE,
        frame_indices=np.array([0, 1, 3]),
        num_frames=4,
        axis_origin=np.array([0.0, 0.0, -0.4]),
    )
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.copy_(size * torch.randn(parameter.shape, generator=generator).clamp(-1.0, 1.0))
    return made.double()


MEASURED = [torch.from_numpy(POSE[:3, :3]).expand(4, 3, 3), torch.from_numpy(POSE[:3, 3]).expand(4, 3)]


def corrections(mode, size):
    method = Method(refinement(mode, size), "corrections")
    frames = torch.arange(4)
    return lambda *leaves: torch.cat([part.flatten() for part in method.of(leaves, frames, *MEASURED)]), method.leaves


def penalty():
    method = Method(refinement("turntable", 0.1), "get_loss_dict")

    def summed(*leaves):
        found = {}
        method.of(leaves, found)
        return found["camera_opt_regularizer"]

    return summed, method.leaves


CASES = {
    "distortion": lambda: (separate_distortion, [random(3, 5, seed=1), *segments()]),
    "free space": lambda: (
        lambda weights: free_space_loss(weights, torch.tensor([[0.2, 0.1, 0.1, -0.1, -0.1]]), torch.arange(3) / 2.0),
        [random(3, 5, seed=1)],
    ),
    "opaque rises": lambda: (lambda density: opaque_density(density, random(3, 5), 0.3), [random(3, 5, seed=1)]),
    "weights": lambda: (light_through, [random(3, 5, 1, seed=1)]),
    "spectrum": lambda: spectrum(False),
    "spectrum, last sample behind": lambda: spectrum(True),
    "gain": lambda: (CoefficientGain(3), [random(4, 3)]),
    "density": lambda: (lambda raw: density_of(raw, torch.ones_like(raw), 0.1), [20.0 * random(9, 1) - 10.0]),
    "hash grid": lambda: (
        lambda points, table: interpolate_hash_grid(points, table, torch.tensor([4.0, 7.0]).double(), 32),
        [random(6, 3), random(64, 2, seed=1)],
    ),
    "shading": of_shading,
    "penalty": penalty,
    **{
        f"{mode} by {size:g}": lambda mode=mode, size=size: corrections(mode, size)
        for mode in ("turntable", "free-discarded")
        for size in (0.0, 0.05, math.pi)
    },
}


@pytest.mark.parametrize("case", CASES)
def test_gradients_match_finite_differences(case):
    function, leaves = CASES[case]()
    # The many numbers of the shading's maps along one random direction.
    fast = sum(leaf.numel() for leaf in leaves) > 1000
    assert torch.autograd.gradcheck(function, [leaf.requires_grad_() for leaf in leaves], atol=1e-4, fast_mode=fast)


@pytest.mark.parametrize("dtype", LOW_PRECISIONS, ids=str)
@pytest.mark.parametrize(
    "case", ["distortion", "free space", "spectrum", "spectrum, last sample behind", "gain", "shading"]
)
def test_low_precision_is_that_of_float64(case, dtype):
    """Of what mixed precision may hand half of the digits: all else is computed in float32 there."""
    function, leaves = CASES[case]()
    rounded = [leaf.to(dtype) for leaf in leaves]
    expected = function(*(leaf.double() for leaf in rounded))
    if case == "shading":
        single = shading().float()
        method = Method(single, "forward")
        points, origins = random(6, 3) - 0.5, torch.from_numpy(POSE[:3, 3]) + 0.1 * random(6, 3, seed=1)
        rounded = [leaf.float().requires_grad_() for leaf in rounded]
        with torch.autocast("cpu", dtype=dtype):
            normals = single.normals(points.float())
            found = method.of(rounded[1:], rounded[0], points.float(), origins.float(), normals)
    else:
        rounded = [leaf.requires_grad_() for leaf in rounded]
        found = function(*rounded)
    torch.testing.assert_close(found.double(), expected, rtol=0.0, atol=16 * torch.finfo(dtype).eps)
    for gradient in torch.autograd.grad(found.sum(), rounded):
        assert gradient.isfinite().all()


def test_distortion_is_the_mean_distance_of_points_drawn_by_the_weights():
    (starts, ends), weights = segments(), random(3, 5, seed=1)
    for ray, found in enumerate(separate_distortion(weights, starts, ends)):
        w, a, b = (values[ray].tolist() for values in (weights, starts, ends))
        pairs = [
            w[i] * w[j] * (abs(a[i] + b[i] - a[j] - b[j]) / 2.0 if i != j else (b[i] - a[i]) / 3.0)
            for i in range(5)
            for j in range(5)
        ]
        assert found.item() == pytest.approx(sum(pairs), rel=1e-12)


@some
@given(
    density=st.lists(st.sampled_from([0.0, 1e-40, 1e-3, 1.0, 30.0, 1e10, 1e26]), min_size=5, max_size=5),
    length=st.lists(st.sampled_from([0.0, 1e-10, 1e-3, 0.1]), min_size=5, max_size=5),
)
def test_weights_are_those_of_fifty_digits(density, length):
    ends = torch.tensor([length]).cumsum(-1)
    samples = samples_along(ends - torch.tensor([length]), ends)
    samples.deltas = torch.tensor([length])[..., None]  # not rounded
    found = samples.get_weights(torch.tensor([density])[..., None]).flatten().tolist()
    with mpmath.workdps(50):
        through = mpmath.mpf(1)
        for weight, sigma, along in zip(found, density, length, strict=True):
            passes = mpmath.exp(-mpmath.mpf(sigma) * mpmath.mpf(along))
            assert weight == pytest.approx(float(through * (1 - passes)), abs=1e-6)
            through *= passes


@pytest.mark.parametrize("behind", [False, True])
def test_spectrum_is_a_sum_over_samples_and_bands(behind):
    function, (coefficients, weights) = spectrum(behind)
    basis = random(4, 3, seed=2)
    for ray, found in enumerate(function(coefficients, weights)):
        shown = [
            sum(basis[band, k] * coefficients[ray, sample, k] for k in range(3))
            for band in range(4)
            for sample in range(5)
        ]
        let_through = 1.0 - sum(weights[ray, :, 0].tolist()) if behind else 0.0
        for band in range(4):
            of_samples = [float(value) for value in shown[5 * band : 5 * band + 5]]
            seen = sum(w * value for w, value in zip(weights[ray, :, 0].tolist(), of_samples, strict=True))
            assert found[band].item() == pytest.approx(seen + let_through * of_samples[-1], rel=1e-12)


def test_shading_is_that_of_loops():
    made, function_and_leaves = shading(), of_shading()
    coefficients = function_and_leaves[1][0]
    found = function_and_leaves[0](*function_and_leaves[1]).detach().numpy()
    points, origins = random(6, 3) - 0.5, torch.from_numpy(POSE[:3, 3]) + 0.1 * random(6, 3, seed=1)
    normals, aside = made.across_image(origins, made.normals(points), points)
    for i, at in enumerate((normals + made.parallax * aside).detach().numpy()):
        features = []
        for values in made.maps:
            table = values.detach().numpy()[0]
            x, y = np.clip((at + 1.0) / 2.0, 0.0, 1.0) * (table.shape[-1] - 1)
            column, line = min(int(x), table.shape[-1] - 2), min(int(y), table.shape[-1] - 2)
            right, down = x - column, y - line
            upper = table[:, line, column] * (1.0 - right) + table[:, line, column + 1] * right
            lower = table[:, line + 1, column] * (1.0 - right) + table[:, line + 1, column + 1] * right
            features.extend(upper * (1.0 - down) + lower * down)
        *hidden, last = made.network.layers
        features = np.array([*features, float(points[i, 2] < made.base)])
        for layer in hidden:
            features = np.maximum(layer.weight.detach().numpy() @ features + layer.bias.detach().numpy(), 0.0)
        log_gain, *gloss = last.weight.detach().numpy() @ features + last.bias.detach().numpy()
        gain = math.exp(np.clip(log_gain, -LARGEST_LOG_GAIN, LARGEST_LOG_GAIN))
        np.testing.assert_allclose(found[i], gain * coefficients[i].numpy() + gloss, rtol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, math.pi])
def test_a_twist_is_a_matrix_exponential(angle):
    """Of no turn, half a turn, and between: about a line across the first camera's way to the axis."""
    made = refinement("turntable", 0.0)
    direction = torch.linalg.lstsq(made.twist_basis[3:], torch.tensor([[0.6], [0.0], [0.8]]).double()).solution[:, 0]
    with torch.no_grad():
        made.camera_twist.copy_(direction * angle / (made.twist_basis[3:] @ direction).norm())
    turns, positions = made.corrections(torch.arange(4), *MEASURED)
    twist = made.twist().detach().numpy()
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = cross_matrix(twist[3:]), twist[:3]
    expected = POSE @ expm(generator)
    np.testing.assert_allclose(turns[2].detach().numpy() @ POSE[:3, :3], expected[:3, :3], atol=1e-6)
    np.testing.assert_allclose(positions[2].detach().numpy(), expected[:3, 3], atol=1e-6)


def test_penalty_is_that_of_its_formula():
    made = refinement("turntable", 0.1)
    with torch.no_grad():
        made.camera_twist.neg_()
    twist, angles = made.twist().tolist(), made.frame_angles.tolist()
    config = made.config
    expected = config.trans_l2_penalty * sum(value**2 for value in twist[:3])
    expected += config.rot_l2_penalty * sum(value**2 for value in twist[3:])
    expected += 1e-2 * sum(value**2 for value in angles) / len(angles)
    found = {}
    made.get_loss_dict(found)
    assert found["camera_opt_regularizer"].item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("mode", ["turntable", "free-discarded"])
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-8, 1e-2, math.pi, 1e3])
def test_corrections_of_any_size_are_rotations_with_finite_gradients(mode, size):
    made = refinement(mode, size).float()
    turns, positions = made.corrections(torch.arange(4), *(values.float() for values in MEASURED))
    # Below a hundredth of a radian nerfstudio's free corrections are rotations to a part in a million.
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).expand(4, 3, 3), rtol=0.0, atol=1e-5)
    weight = torch.arange(9.0).reshape(3, 3)
    value = (turns * weight).sum() + positions.square().sum()
    for gradient in torch.autograd.grad(value, list(made.parameters())):
        assert gradient.isfinite().all()


def test_shading_far_away_on_faces_and_on_the_axis_is_finite():
    made = shading().float()
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [-1.0, 0.0, 0.0], [1e30, -1e30, 0.0], [0.0, 0.0, 3e38]])
    coefficients = torch.tensor([0.0, 1e-40, 1.0, -1.0, 1e30])[:, None].expand(5, 3).clone().requires_grad_()
    origins = torch.tensor([[2.0, 0.3, 0.9], [0.0, 0.0, 3.0], [1e-30, 0.0, 0.0], [1e18, 0.0, 0.0], [0.5, 0.5, 0.5]])
    assert all(part.isfinite().all() for part in made.across_image(origins, points[:1].expand(5, 3)))
    shaded = made(coefficients, points, origins, made.normals(points))
    assert shaded.isfinite().all()
    for gradient in torch.autograd.grad(shaded[:4].sum(), [coefficients, *made.parameters()]):
        assert gradient.isfinite().all()


def test_normals_are_unit_vectors_or_nothing():
    made = shading()
    lengths = made.normals(4.0 * (random(50, 3) - 0.5)).norm(dim=-1)
    assert ((lengths - 1.0).abs() < 1e-9).logical_or(lengths == 0.0).all()
    made.refresh(torch.full((9, 9, 9), 0.5).double())
    # An even grid has no gradient but what rounding left.
    assert functional.normalize(made.normals(random(5, 3)), dim=-1, eps=1.0).isfinite().all()


@pytest.mark.parametrize("count", [1, 50])  # fewer than fit into a processor's vectors, and more
def test_places_that_are_no_numbers_are_looked_up_somewhere(count):
    """The gradient of PyTorch's look-up would be written outside of its table there, and ends the process."""
    nowhere, made = torch.full((count, 3), torch.nan), shading().float()
    shaded = made(torch.ones(count, 3), nowhere, nowhere, made.normals(nowhere))
    assert shaded.isfinite().all()
    for gradient in torch.autograd.grad(shaded.sum(), [*made.maps, *made.network.parameters()]):
        assert gradient.isfinite().all()
    assert interpolate_image(random(4, 6, 3).float(), nowhere[:, :2]).isfinite().all()
