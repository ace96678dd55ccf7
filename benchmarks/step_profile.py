"""Where a training step's time goes, and what its arithmetic and memory traffic need at least on this machine.

    uv run python benchmarks/step_profile.py DATA

Each part's time is its own: what is called within it is counted where it belongs. The least time of the networks is
that of their matrix products at the rate of one large product. That of the other parts is the bytes that they cannot
do without at the rate of a large copy. Both rates are measured in the same run, with the same threads. Seconds are of
processor time, which other work on the machine hardly changes.
"""

from __future__ import annotations

import tempfile
import time
import timeit
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from results_table import Benchmark, write_results
from torch import nn

from hsi_sc_nerf.benchmark.run import Job, build_trainer
from hsi_sc_nerf.fields import hash_grid_cpu
from hsi_sc_nerf.fields.hash_grid import FusedHashEncoding

FIRST_STEP = 100
"""Steps before the first that is timed: by then the occupancy grid has emptied most of the hull."""
RUN_STEPS = 10_000
"""Steps of the run over which those that are timed are spread: the stages' steps differ."""
BLOCK_STEPS = 8
"""Steps that are timed in a row: as many as there are from one update of the occupancy grid to the next."""
CORNERS = 8
COPIED_FLOATS = 2**25
PRODUCT_SIDE = 1024
REPEATS = 7
PARTS = (
    *("fetch", "occupancy grid", "sampling", "hash grid", "networks", "rest of the forward pass", "loss and metrics"),
    *("backward: hash grid", "backward: networks and the rest", "optimisers", "rest"),
)


class PartTimer:
    """Seconds of nested parts, each without those within it."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._stack: list[str] = []
        self._since = time.process_time()

    def _charge(self) -> None:
        now = time.process_time()
        if self._stack:
            self.seconds[self._stack[-1]] += now - self._since
        self._since = now

    def timed(self, part: str, function: Callable) -> Callable:
        """The function, whose time counts for ``part``."""

        def wrapper(*arguments, **options):
            self._charge()
            self._stack.append(part)
            try:
                return function(*arguments, **options)
            finally:
                self._charge()
                self._stack.pop()

        return wrapper

    def wrap(self, part: str, owner: Any, name: str) -> None:
        """Time the attribute ``name`` of ``owner``."""
        setattr(owner, name, self.timed(part, getattr(owner, name)))


@dataclass(frozen=True)
class StepProfile(Benchmark):
    """Profile some steps of the default method and write the table."""

    data: tyro.conf.Positional[Path]
    """A dataset made by `hsi-sc-nerf process`."""
    words: tuple[str, ...] = ("--preset", "fast", "--pipeline.model.effects", "none")
    """As after `ns-train hsi-sc-nerf`."""
    blocks: int = 8
    """Blocks of 8 steps that are timed."""
    threads: int = 1
    """CPU threads."""
    label: str = "pear"
    """Name of the dataset in the table."""

    def main(self) -> None:
        """Measure and write."""
        torch.set_num_threads(self.threads)
        with tempfile.TemporaryDirectory() as folder:
            job = Job(
                "hsi-sc-nerf", self.words, str(self.data), folder, RUN_STEPS, None, "cpu", (), self.threads, None
            )
            trainer = build_trainer(job)
            trainer._show_progress = lambda step, psnr_db: None
            for step in range(FIRST_STEP):
                trainer.pipeline.train()
                trainer.train_iteration(step)
            timer, counts, timed_steps = PartTimer(), defaultdict(float), self.blocks * BLOCK_STEPS
            _wrap(trainer, timer, counts)
            step_of = timer.timed("rest", trainer.train_iteration)
            for block in range(self.blocks):
                first = FIRST_STEP + int((RUN_STEPS - FIRST_STEP) * (block + 0.5) / self.blocks)
                for step in range(first, first + BLOCK_STEPS):
                    step_of(step)
            least = least_seconds(trainer, {name: value / timed_steps for name, value in counts.items()})
        total = sum(timer.seconds.values())
        rows = []
        for part in PARTS:
            milliseconds = 1000.0 * timer.seconds[part] / timed_steps
            at_least = f"{1000.0 * least[part]:.2f}" if part in least else "-"
            rows.append(
                [self.label, part, f"{milliseconds:.1f}", f"{100.0 * timer.seconds[part] / total:.0f}", at_least]
            )
        rows.append([self.label, "a step", f"{1000.0 * total / timed_steps:.1f}", "100", ""])
        titles = ["dataset", "part", "ms", "%", "at least, ms"]
        write_results("step_profile", titles, rows, keys=2, seed="0", folder=self.results)


def _wrap(trainer: Any, timer: PartTimer, counts: dict[str, float]) -> None:
    """Time the parts of a step, and count the samples of the grid and of the head."""
    model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
    timer.wrap("fetch", manager, "next_train")
    timer.wrap("occupancy grid", model, "prepare_step")
    timer.wrap("sampling", model.proposal_sampler, "forward")
    timer.wrap("rest of the forward pass", model, "get_outputs")
    timer.wrap("loss and metrics", model, "get_loss_dict")
    timer.wrap("loss and metrics", model, "get_metrics_dict")
    timer.wrap("backward: networks and the rest", torch.Tensor, "backward")
    for name in ("table_gradient", "position_gradient"):
        timer.wrap("backward: hash grid", hash_grid_cpu, name)
    timer.wrap("optimisers", trainer.optimizers, "optimizer_scaler_step_some")
    timer.wrap("optimisers", trainer.optimizers, "zero_grad_some")
    timer.wrap("optimisers", model.field, "shrink_grid")
    for module in model.field.modules():
        if isinstance(module, FusedHashEncoding):
            timer.wrap("hash grid", module, "forward")
        elif isinstance(module, nn.Linear):
            timer.wrap("networks", module, "forward")

    def count(name: str, owner: nn.Module) -> None:
        def hook(_: nn.Module, inputs: tuple[torch.Tensor, ...]) -> None:
            if torch.is_grad_enabled():
                counts[name] += inputs[0].reshape(-1, inputs[0].shape[-1]).shape[0]

        owner.register_forward_pre_hook(hook)

    count("samples", model.field.mlp_base)
    count("seen", model.field.mlp_head)


def least_seconds(trainer: Any, counts: dict[str, float]) -> dict[str, float]:
    """Least seconds of a step's parts.

    Args:
        trainer: of the step.
        counts: ``samples`` that pass the grid and ``seen`` ones that pass the head, a step.
    """
    floats_per_second, flops = copied_floats_per_second(), product_flops()
    model = trainer.pipeline.model
    (grid,) = (module for module in model.field.modules() if isinstance(module, FusedHashEncoding))
    levels, features = grid.num_levels, grid.features_per_level
    # Corners are read forward; backward they are read and written, and the levels' features come in.
    gathered = counts["samples"] * levels * features
    weights = {
        name: sum(layer.weight.numel() for layer in part.modules() if isinstance(layer, nn.Linear))
        for name, part in (("samples", model.field.mlp_base), ("seen", model.field.mlp_head))
    }
    products = 2.0 * sum(counts[name] * count for name, count in weights.items())
    rays = trainer.config.pipeline.datamanager.train_num_rays_per_batch
    bands = len(model.wavelengths_nm)
    parameters = sum(parameter.numel() for group in trainer.optimizers.parameters.values() for parameter in group)
    return {
        "fetch": rays * bands / floats_per_second,
        "hash grid": gathered * (CORNERS + 1) / floats_per_second,
        "networks": products / flops,
        "rest of the forward pass": 2.0 * rays * bands / floats_per_second,
        "loss and metrics": 2.0 * rays * bands / floats_per_second,
        "backward: hash grid": gathered * (2 * CORNERS + 1) / floats_per_second,
        "backward: networks and the rest": 2.0 * products / flops,
        # Adam reads a gradient, and reads and writes a parameter and two moments.
        "optimisers": 7.0 * parameters / floats_per_second,
    }


def copied_floats_per_second() -> float:
    """Floats read, or written, in a second of a large copy."""
    source, target = torch.rand(COPIED_FLOATS), torch.empty(COPIED_FLOATS)
    return 2.0 * COPIED_FLOATS / _best_seconds(lambda: target.copy_(source))


def product_flops() -> float:
    """Floating-point operations in a second of a large matrix product."""
    first, second = torch.rand(PRODUCT_SIDE, PRODUCT_SIDE), torch.rand(PRODUCT_SIDE, PRODUCT_SIDE)
    return 2.0 * PRODUCT_SIDE**3 / _best_seconds(lambda: first @ second)


def _best_seconds(work: Callable[[], object]) -> float:
    return min(timeit.repeat(work, timer=time.process_time, number=1, repeat=REPEATS))


if __name__ == "__main__":
    tyro.cli(StepProfile).main()
