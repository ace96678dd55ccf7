"""The hash grid's interpolation and its gradients as compiled loops, for training without a GPU.

A tensor library writes every corner of every cell to memory several times; a loop keeps them in registers. Work is
shared among as many threads as torch uses, each with rows of its own to write, so that results do not depend on how
many there are.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float32

from hsi_sc_nerf.compiled import compiled

_PRIME_Y, _PRIME_Z = 2654435761, 805459861  # Müller et al. 2022, Eq. 4; the first is 1
_SHARED_FROM = 4096
"""Points from which on threads are worth waking."""

shared = compiled(parallel=True)

# On Linux these are the threads of torch: others would have to wait for its own, which go on spinning on their cores
# for milliseconds after every operation.
numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # type: ignore[attr-defined]
# The last of these does not bear a second launch beside the first, as from the viewer's thread.
_one_at_a_time = Lock()


def run_in_parts(alone: Callable[..., None], at_once: Callable[..., None], points: int, *arguments: Any) -> None:
    """Run a kernel in as many parts as torch has threads, or as one where waking them is not worth it.

    Args:
        alone: takes the arguments, the number of a part and how many parts there are.
        at_once: takes the arguments and the number of parts, and does them side by side.
    """
    threads = min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    if threads == 1 or points < _SHARED_FROM:
        alone(*arguments, 0, 1)
        return
    with _one_at_a_time:
        numba.set_num_threads(threads)
        at_once(*arguments, threads)


def interpolate(
    positions: Float32[np.ndarray, "n 3"],
    table: Float32[np.ndarray, "rows channels"],
    scalings: Float32[np.ndarray, "levels"],
    table_size: int,
) -> Float32[np.ndarray, "n levels_x_channels"]:
    """Trilinear interpolation of a stack of hashed grids, as `hash_grid.interpolate_hash_grid` describes it."""
    features = np.empty((len(positions), len(scalings) * table.shape[1]), np.float32)
    arguments = positions, table, scalings, table_size - 1, features
    run_in_parts(_interpolate, _interpolate_at_once, len(positions), *arguments)
    return features


def table_gradient(
    positions: Float32[np.ndarray, "n 3"],
    table: Float32[np.ndarray, "rows channels"],
    scalings: Float32[np.ndarray, "levels"],
    table_size: int,
    gradient: Float32[np.ndarray, "n levels_x_channels"],
) -> Float32[np.ndarray, "rows channels"]:
    """Gradient with respect to the table; threads share the levels, whose rows are apart."""
    grad_table = np.zeros_like(table)
    arguments = positions, scalings, table_size - 1, gradient, grad_table
    run_in_parts(_add_to_table, _add_to_table_at_once, len(positions), *arguments)
    return grad_table


def position_gradient(
    positions: Float32[np.ndarray, "n 3"],
    table: Float32[np.ndarray, "rows channels"],
    scalings: Float32[np.ndarray, "levels"],
    table_size: int,
    gradient: Float32[np.ndarray, "n levels_x_channels"],
) -> Float32[np.ndarray, "n 3"]:
    """Gradient with respect to the positions."""
    grad_positions = np.zeros_like(positions)
    arguments = positions, table, scalings, table_size - 1, gradient, grad_positions
    run_in_parts(_position_gradients, _position_gradients_at_once, len(positions), *arguments)
    return grad_positions


@compiled
def _corners(x, y, z, scale, mask, offset):
    """Rows of a cell's eight corners, numbered 4 x + 2 y + z, and where in the cell the point lies."""
    x, y, z = x * scale, y * scale, z * scale
    floor_x, floor_y, floor_z = np.floor(x), np.floor(y), np.floor(z)
    x0, y0, z0 = np.int64(floor_x), np.int64(floor_y) * _PRIME_Y, np.int64(floor_z) * _PRIME_Z
    x1, y1, z1 = x0 + 1, y0 + _PRIME_Y, z0 + _PRIME_Z
    rows = (
        ((x0 ^ y0 ^ z0) & mask) + offset,
        ((x0 ^ y0 ^ z1) & mask) + offset,
        ((x0 ^ y1 ^ z0) & mask) + offset,
        ((x0 ^ y1 ^ z1) & mask) + offset,
        ((x1 ^ y0 ^ z0) & mask) + offset,
        ((x1 ^ y0 ^ z1) & mask) + offset,
        ((x1 ^ y1 ^ z0) & mask) + offset,
        ((x1 ^ y1 ^ z1) & mask) + offset,
    )
    return rows, x - floor_x, y - floor_y, z - floor_z


@compiled
def _weights(x, y, z):
    """Trilinear weights of the corners."""
    one = np.float32(1.0)
    near_x, near_y, near_z = one - x, one - y, one - z
    a, b, c, d = near_x * near_y, near_x * y, x * near_y, x * y
    return a * near_z, a * z, b * near_z, b * z, c * near_z, c * z, d * near_z, d * z


# The three below do one part of ``parts``.


@compiled
def _interpolate(positions, table, scalings, mask, features, part, parts):
    channels = table.shape[1]
    first, last = len(positions) * part // parts, len(positions) * (part + 1) // parts
    for level in range(len(scalings)):
        for i in range(first, last):
            x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
            rows, x, y, z = _corners(x, y, z, scalings[level], mask, level * (mask + 1))
            weights = _weights(x, y, z)
            for f in range(channels):
                total = np.float32(0.0)
                for corner in range(8):
                    total += weights[corner] * table[rows[corner], f]
                features[i, level * channels + f] = total


@compiled
def _add_to_table(positions, scalings, mask, gradient, grad_table, part, parts):
    """Gradient with respect to the table. Every part gets coarse and fine levels: the coarse ones are done sooner."""
    channels = grad_table.shape[1]
    for level in range(part, len(scalings), parts):
        for i in range(len(positions)):
            x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
            rows, x, y, z = _corners(x, y, z, scalings[level], mask, level * (mask + 1))
            weights = _weights(x, y, z)
            for f in range(channels):
                upstream = gradient[i, level * channels + f]
                for corner in range(8):
                    grad_table[rows[corner], f] += weights[corner] * upstream


@compiled
def _position_gradients(positions, table, scalings, mask, gradient, grad_positions, part, parts):
    channels = table.shape[1]
    first, last = len(positions) * part // parts, len(positions) * (part + 1) // parts
    one = np.float32(1.0)
    for i in range(first, last):
        for level in range(len(scalings)):
            x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
            rows, x, y, z = _corners(x, y, z, scalings[level], mask, level * (mask + 1))
            near_x, near_y, near_z = one - x, one - y, one - z
            along_x, along_y, along_z = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for f in range(channels):
                upstream = gradient[i, level * channels + f]
                a, b, c, d = table[rows[0], f], table[rows[1], f], table[rows[2], f], table[rows[3], f]
                e, g, h, k = table[rows[4], f], table[rows[5], f], table[rows[6], f], table[rows[7], f]
                across_x = near_y * (near_z * (e - a) + z * (g - b)) + y * (near_z * (h - c) + z * (k - d))
                across_y = near_x * (near_z * (c - a) + z * (d - b)) + x * (near_z * (h - e) + z * (k - g))
                across_z = near_x * (near_y * (b - a) + y * (d - c)) + x * (near_y * (g - e) + y * (k - h))
                along_x += upstream * across_x
                along_y += upstream * across_y
                along_z += upstream * across_z
            grad_positions[i, 0] += scalings[level] * along_x
            grad_positions[i, 1] += scalings[level] * along_y
            grad_positions[i, 2] += scalings[level] * along_z


@shared
def _interpolate_at_once(positions, table, scalings, mask, features, parts):
    for part in numba.prange(parts):
        _interpolate(positions, table, scalings, mask, features, part, parts)


@shared
def _add_to_table_at_once(positions, scalings, mask, gradient, grad_table, parts):
    for part in numba.prange(parts):
        _add_to_table(positions, scalings, mask, gradient, grad_table, part, parts)


@shared
def _position_gradients_at_once(positions, table, scalings, mask, gradient, grad_positions, parts):
    for part in numba.prange(parts):
        _position_gradients(positions, table, scalings, mask, gradient, grad_positions, part, parts)
