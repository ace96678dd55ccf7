"""The average of weights against its closed form, and its use in place of the weights."""

import pytest
import torch

from hsi_sc_nerf.models.weight_average import WeightAverage, update_average

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("decay", [0.3, 0.9, 0.9999])
def test_closed_form(device, decay):
    generator = torch.Generator().manual_seed(0)
    steps = [torch.randn(3, 5, generator=generator, dtype=torch.float64).to(device) for _ in range(40)]
    average = [torch.full((3, 5), torch.nan, dtype=torch.float64, device=device).nan_to_num(1e6)]
    for count, weights in enumerate(steps, start=1):
        update_average(average, [weights], decay, count)
        powers = [decay ** (count - i) for i in range(1, count + 1)]
        expected = sum(p * w for p, w in zip(powers, steps[:count], strict=True)) / sum(powers)
        torch.testing.assert_close(average[0], expected, rtol=1e-9, atol=1e-9)


def test_what_does_not_change_is_its_own_average():
    weights = torch.rand(1000)
    average = [weights.clone()]
    for count in range(1, 30):
        update_average(average, [weights], 0.97, count)
    assert torch.equal(average[0], weights)


def test_swapped_in_for_a_while():
    parameter = torch.nn.Parameter(torch.ones(2))
    average = WeightAverage({"a": parameter}, 0.5)
    optimizer = torch.optim.SGD([parameter], lr=1.0)
    for count in (1, 2):
        parameter.grad = torch.ones(2)
        optimizer.step()
        average.update(count)
    assert parameter.tolist() == [-1.0, -1.0]
    with average.in_use():
        assert parameter.tolist() == pytest.approx([-2 / 3] * 2)  # (0.5 * 0 + 1 * -1) / 1.5
    assert parameter.tolist() == [-1.0, -1.0]
    optimizer.step()  # the optimiser still moves the parameter, not its average
    assert parameter.tolist() == [-2.0, -2.0]
    assert average.weights()["a"].tolist() == [-2.0, -2.0]
    average.restart()
    with average.in_use():
        assert parameter.tolist() == [-2.0, -2.0]
