"""Effects of the turntable: which frames are taken, at which angles, from where."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from hsi_sc_nerf.simulate.effects.stages import FramePlan, MotionEffect
from hsi_sc_nerf.simulate.reading import between


@dataclass(frozen=True)
class AngleJitter(MotionEffect):
    """The turntable's steps are not all of one size: each frame but the first is off its angle by chance."""

    name: ClassVar[str] = "angle_jitter"
    spread_deg: float = between(0.0, 10.0, default=1.0)
    """Angles are off by at most this, evenly spread, degrees."""

    def replan(self, plan: FramePlan, rng: np.random.Generator) -> FramePlan:
        """Move each angle but the first."""
        errors_deg = rng.uniform(-self.spread_deg, self.spread_deg, len(plan.angles_deg))
        errors_deg[0] = 0.0
        return replace(plan, angles_deg=plan.angles_deg + errors_deg)
