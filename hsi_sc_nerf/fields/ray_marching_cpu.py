"""`ray_marching` as a compiled loop: a ray is sampled before the next one is begun, in a few kilobytes of memory."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np
from jaxtyping import Float32

from hsi_sc_nerf.compiled import compiled
from hsi_sc_nerf.fields.hash_grid_cpu import run_in_parts, shared


def sample_occupied(
    rays: Sequence[Float32[np.ndarray, "rays *components"]],
    grid: tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "3"], float],
    num_samples: int,
    explored: float,
    max_opacity: float,
) -> tuple[Float32[np.ndarray, "rays samples"], Float32[np.ndarray, "rays samples"]]:
    """Starts and ends of the samples, as `ray_marching.sample_occupied` describes them."""
    count = len(rays[0])
    results = np.empty((count, num_samples), np.float32), np.empty((count, num_samples), np.float32)
    opacity, lower, cell = grid
    cells = opacity, lower, np.float32(cell), np.float32(max_opacity)
    run_in_parts(_sample, _sample_at_once, count, tuple(rays), cells, np.float32(explored), results)
    return results


@compiled
def _sample(rays, grid, explored, results, part, parts):
    origins, directions, nears, fars = rays
    starts, ends = results
    x, y, z = grid[0].shape
    weights = np.empty(int(math.sqrt(x * x + y * y + z * z)) + 2, np.float32)
    seen = np.empty_like(weights)
    for i in range(len(origins) * part // parts, len(origins) * (part + 1) // parts):
        count = _march(origins[i], directions[i], nears[i], fars[i], grid, seen)
        total = _spread(seen, count, explored, weights)
        if total > 0.0:
            _invert(weights, count, total, nears[i], grid[2], starts[i], ends[i])
        else:
            starts[i], ends[i] = nears[i], nears[i]


@shared
def _sample_at_once(rays, grid, explored, results, parts):
    for part in numba.prange(parts):
        _sample(rays, grid, explored, results, part, parts)


@compiled
def _march(origin, direction, near, far, grid, seen):
    """Weight with which each step of a ray is seen, -1 where it holds no matter; returns the number of steps."""
    opacity, lower, cell, max_opacity = grid
    transmittance = np.float32(1.0)
    for k in range(len(seen)):
        t = near + (np.float32(k) + np.float32(0.5)) * cell
        if not t < far:
            return k
        seen[k] = np.float32(-1.0)
        x = np.int64(np.floor((origin[0] + direction[0] * t - lower[0]) / cell))
        y = np.int64(np.floor((origin[1] + direction[1] * t - lower[1]) / cell))
        z = np.int64(np.floor((origin[2] + direction[2] * t - lower[2]) / cell))
        if 0 <= x < opacity.shape[0] and 0 <= y < opacity.shape[1] and 0 <= z < opacity.shape[2]:
            value = opacity[x, y, z]
            if value >= 0.0:
                value = min(value, max_opacity)
                seen[k] = transmittance * value
                transmittance *= np.float32(1.0) - value
    return len(seen)


@compiled
def _spread(seen, count, explored, weights):
    """Weights by which samples are drawn, 0 where there is no matter; returns their sum."""
    matter = 0
    for k in range(count):
        if seen[k] >= 0.0:
            matter += 1
    total = np.float32(0.0)
    for k in range(count):
        weights[k] = np.float32(0.0)
        if seen[k] >= 0.0:
            widened = seen[k]
            if k > 0:
                widened = max(widened, seen[k - 1])
            if k + 1 < count:
                widened = max(widened, seen[k + 1])
            weights[k] = widened + explored / np.float32(matter)
            total += weights[k]
    return total


@compiled
def _invert(weights, count, total, near, cell, starts, ends):
    """Samples of equal weight, each within the stretch of matter that its middle is in."""
    samples = len(starts)
    spacing = total / np.float32(samples + 1)
    k, passed = 0, np.float32(0.0)
    while weights[k] == 0.0:
        k += 1
    first = k  # of the stretch of matter that step k is in
    # Quantiles in half steps: starts at even ones, ends two later, middles at odd ones.
    for half in range(2 * samples + 1):
        level = np.float32(0.5) * np.float32(half + 1) * spacing
        while passed + weights[k] <= level:
            following = k + 1
            while following < count and weights[following] == 0.0:
                following += 1
            if following == count:
                break
            passed += weights[k]
            if following > k + 1:
                first = following
            k = following
        t = near + (np.float32(k) + min((level - passed) / weights[k], np.float32(1.0))) * cell
        sample = half // 2
        if half % 2 == 0:
            if sample < samples:
                starts[sample] = t
            if sample > 0:
                ends[sample - 1] = min(ends[sample - 1], t)
        else:
            last = k + 1
            while last < count and weights[last] > 0.0:
                last += 1
            starts[sample] = max(starts[sample], near + np.float32(first) * cell)
            ends[sample] = near + np.float32(last) * cell
