import pytest
import torch
from nerfstudio.cameras.rays import Frustums, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.field_components.spatial_distortions import SceneContraction

from hsi_sc_nerf.fields.spectral_field import SpectralField, SpectralProposalField
from hsi_sc_nerf.fields.surface_opacity import opaque_density

BOX = torch.tensor([[-1.0, -0.5, -1.0], [1.0, 0.5, 0.2]])
SIZE = {
    "num_images": 3,
    "appearance_embedding_dim": 0,
    "num_levels": 4,
    "max_res": 32,
    "log2_hashmap_size": 10,
    "implementation": "torch",
}
BANDS = 7


def contraction() -> SceneContraction:
    return SceneContraction(order=float("inf"))


def rays(count: int = 5, samples: int = 6, reach: float = 1.0, device: str = "cpu") -> RaySamples:
    """Evenly spaced samples along random rays through the box."""
    generator = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(count, 1, 3, generator=generator), dim=-1)
    edges = torch.linspace(0.05, reach, samples + 1)[:, None].expand(count, -1, -1)
    frustums = Frustums(
        origins=torch.full((count, samples, 3), -0.1),
        directions=directions.expand(-1, samples, -1),
        starts=edges[:, :-1],
        ends=edges[:, 1:],
        pixel_area=torch.ones(count, samples, 1),
    )
    return RaySamples(frustums, deltas=frustums.ends - frustums.starts).to(device)


def field(**options) -> SpectralField:
    """A field whose hash grid is not nearly constant, as it is when it is new."""
    torch.manual_seed(0)
    made = SpectralField(BOX, BANDS, **SIZE, **options)
    with torch.no_grad():
        made.mlp_base.model[0].hash_table *= 1e4
    return made


@pytest.mark.slow
def test_the_direct_head_has_a_reflectance_a_band():
    spectra = field()(rays())[FieldHeadNames.RGB]
    assert spectra.shape == (5, 6, BANDS)
    assert ((spectra > 0) & (spectra < 1)).all()


def test_half_precision_of_tiny_cuda_nn_is_taken():
    made, samples = field(), rays()
    _, features = made.get_density(samples)
    expected = made.get_outputs(samples, features)[FieldHeadNames.RGB]
    encode = made.direction_encoding.forward
    made.direction_encoding.forward = lambda directions: encode(directions).half()
    spectra = made.get_outputs(samples, features.half())[FieldHeadNames.RGB]
    torch.testing.assert_close(spectra, expected, rtol=0, atol=5e-3)


def test_rises_are_opaque_along_rays_alone():
    samples = rays()
    plain, made = field(), field(rises=True)
    torch.testing.assert_close(made.get_density(samples)[0], plain.get_density(samples)[0])
    made.rise_length.fill_(0.1)
    density = plain.get_density(samples)[0][..., 0]
    expected = opaque_density(density, samples.deltas[..., 0], 0.1)
    assert (expected > 1.1 * density).any()
    torch.testing.assert_close(made.get_density(samples)[0][..., 0], expected)
    torch.testing.assert_close(made.last_density[..., 0], expected)
    points = samples.frustums.get_positions()
    torch.testing.assert_close(made.density_fn(points), plain.density_fn(points))
    again = field(rises=True)
    again.load_state_dict(made.state_dict())
    assert again.rise_length == made.rise_length


def test_no_ray_has_no_density():
    assert field().density_fn(torch.zeros(0, 4, 3)).shape == (0, 4, 1)


def test_coefficients_start_at_the_mean_and_are_not_bounded():
    start = torch.tensor([1.4, -0.8, 0.0])
    made = field(coefficient_start=start)
    coefficients = made(rays())[FieldHeadNames.RGB]
    assert coefficients.shape == (5, 6, 3)
    torch.testing.assert_close(coefficients, start.expand_as(coefficients), atol=0.2, rtol=0)
    assert coefficients.std(dim=(0, 1)).min() > 0


def test_the_grid_shrinks_and_nothing_else():
    made = field()
    before = {name: value.clone() for name, value in made.state_dict().items()}
    made.shrink_grid(0.25)
    for name, value in made.state_dict().items():
        expected = 0.75 * before[name] if name.endswith("hash_table") else before[name]
        torch.testing.assert_close(value, expected)


@pytest.mark.parametrize("distortion", [None, contraction()])
def test_density_gradient_is_that_of_the_log_density(distortion):
    made = field(spatial_distortion=distortion).double()
    points = torch.tensor([[0.31, 0.22, -0.61], [-0.43, -0.17, 0.03], [0.52, -0.33, 0.11]], dtype=torch.double)
    if distortion is not None:
        points[0] *= 4.0  # in the contracted part
    step = 1e-6
    shifted = points[:, None] + step * torch.eye(3, dtype=torch.double)
    difference = (made.density_fn(shifted).log() - made.density_fn(points[:, None]).log())[..., 0] / step
    torch.testing.assert_close(made.density_gradient(points), difference, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("distortion", [None, contraction()])
def test_normals_are_those_of_the_scene(distortion):
    made = field(use_pred_normals=True, spatial_distortion=distortion)
    samples = rays(reach=0.4 if distortion is None else 4.0)
    normals = made(samples, compute_normals=True)[FieldHeadNames.NORMALS]
    gradient = made.density_gradient(samples.frustums.get_positions().reshape(-1, 3)).view_as(normals)
    torch.testing.assert_close(normals, -torch.nn.functional.normalize(gradient, dim=-1), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("reach", [3.0, 1e4])
def test_the_box_ends_the_scene_unless_space_is_contracted(reach):
    far = torch.tensor([[[reach, 0.0, 0.0]]])
    for kind in (SpectralField, SpectralProposalField):
        options = SIZE if kind is SpectralField else {"implementation": "torch"}
        arguments = (BOX, BANDS) if kind is SpectralField else (BOX,)
        assert kind(*arguments, **options).density_fn(far) == 0
        assert kind(*arguments, **options, spatial_distortion=contraction()).density_fn(far) > 0


def test_spectra_depend_on_the_view_only_where_they_may():
    along, back = rays(samples=1), rays(samples=1)
    back.frustums.directions = -back.frustums.directions
    # The same positions seen from the other side.
    back.frustums.origins = along.frustums.get_positions() - back.frustums.directions * (
        (back.frustums.starts + back.frustums.ends) / 2.0
    )
    for start in (None, torch.zeros(3)):
        fixed = field(view_dependent=False, coefficient_start=start)
        torch.testing.assert_close(
            fixed(along)[FieldHeadNames.RGB], fixed(back)[FieldHeadNames.RGB], rtol=1e-4, atol=1e-5
        )
        free = field(coefficient_start=start)
        assert (free(along)[FieldHeadNames.RGB] - free(back)[FieldHeadNames.RGB]).abs().max() > 1e-2
