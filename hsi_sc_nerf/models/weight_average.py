"""Exponential moving average of a model's weights."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.nn import Parameter


def update_average(average: Sequence[Tensor], weights: Sequence[Tensor], decay: float, count: int) -> None:
    """Take the weights after step ``count`` into their average, in place.

    The average of the steps 1 to t is ``sum_i decay^(t - i) w_i / sum_i decay^(t - i)``: a step ago counts ``decay``
    times as much, and the division corrects the bias at the start (Kingma and Ba 2015, section 3) so that after one
    step the average is the weights themselves. Whatever it held before does not count then.

    Args:
        average: tensors of the average, changed.
        weights: tensors of the same shapes.
        decay: in (0, 1).
        count: steps since the average began, this one included; 1 or more.
    """
    share = (1.0 - decay) / -math.expm1(count * math.log(decay))
    torch._foreach_lerp_(list(average), list(weights), share)


class WeightAverage:
    """The average of parameters over training steps, and its use in their place.

    Args:
        parameters: by name.
        decay: how much a step ago counts in comparison with the newest, in (0, 1).
    """

    def __init__(self, parameters: Mapping[str, Parameter], decay: float) -> None:
        self.decay = decay
        self._parameters = dict(parameters)
        self.restart()

    def restart(self) -> None:
        """Let the average be the parameters as they are."""
        self._average = [parameter.detach().clone() for parameter in self._parameters.values()]

    def update(self, count: int) -> None:
        """Take in the parameters as they are; they are the ``count``-th since the average began."""
        weights = [parameter.detach() for parameter in self._parameters.values()]
        update_average(self._average, weights, self.decay, count)

    def weights(self) -> dict[str, Tensor]:
        """What the parameters hold now, by name."""
        return {name: parameter.detach() for name, parameter in self._parameters.items()}

    def swap(self) -> None:
        """Exchange the parameters' values and the averages; nothing is copied."""
        for i, parameter in enumerate(self._parameters.values()):
            parameter.data, self._average[i] = self._average[i], parameter.data

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """The parameters hold the averages within this context."""
        self.swap()
        try:
            yield
        finally:
            self.swap()
