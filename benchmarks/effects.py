"""The effects that sessions are found to call for, and what simulating them or leaving them out costs.

    uv run python benchmarks/effects.py --output-dir /tmp/effects
    uv run python benchmarks/effects.py --output-dir /tmp/effects --parts decisions

Decisions: sessions with each effect, from clear to below the noise, and without it. Models: scenes that call for one
effect of the model, or for none, trained with what is decided, with everything, and without the effect; held-out
views are compared with noise-free ones.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro
from beyond_the_paper import noise_free_metrics
from paper_tables import PaperTable, mean_and_deviation
from results_table import write_results

from hsi_sc_nerf.benchmark.configurations import own_configuration
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.models.chosen_effects import MODEL_EFFECTS, chosen_effects, effects_setting
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.packed.effects import Effect
from hsi_sc_nerf.processing.process import ProcessConfig, process_session
from hsi_sc_nerf.simulate.scene import EFFECTS, load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session

NOISE = ("photon_noise", "read_noise")
FEATURES_PX = 192
"""Side of the pictures in which features are found."""
PROCESS = ProcessConfig(accept=("poses-uncertain",))
"""Poses without markers that the container alone scales are called uncertain, which the evidence is to tell."""


@dataclass(frozen=True)
class Case:
    """A session: what it has beside noise, and what is known to be so."""

    name: str
    effects: tuple[str, ...] = ()
    present: tuple[str, ...] = ()
    """Effects that are clearly there."""
    weak: tuple[str, ...] = ()
    """Effects that may be decided either way."""
    scene: str = "pear"
    markers: bool = True


CASES = (
    Case("nothing but noise"),
    Case("nothing but noise, apple", scene="apple"),
    Case("lamp, 40 % of the light", ("lamp",), ("view_dependence", "uneven_light")),
    Case("lamp, 10 %", ("{lamp: {fraction: 0.1}}",), ("view_dependence",), ("uneven_light",)),
    Case("lamp, 3 %", ("{lamp: {fraction: 0.03}}",), weak=("view_dependence", "uneven_light")),
    Case("lamp, 0.3 %", ("{lamp: {fraction: 0.003}}",)),
    Case("lamp and gloss", ("lamp", "gloss"), ("view_dependence", "uneven_light")),
    Case("gloss in an even chamber", ("gloss",), weak=("view_dependence", "uneven_light")),
    Case("tomato, its own gloss", (), weak=("view_dependence", "uneven_light"), scene="tomato"),
    Case("wooden boards", ("textured_background",), ("still_chamber",)),
    Case("wooden boards, a fifth of the contrast", ("{textured_background: {contrast: 0.2}}",), ("still_chamber",)),
    Case("wooden boards, 2 % of the contrast", ("{textured_background: {contrast: 0.02}}",), weak=("still_chamber",)),
    Case("shade of the chamber", ("chamber_shading",), ("uneven_light",)),
    Case("lamps drift by 5 %", ("lamp_drift",), ("lamp_drift",)),
    Case("lamps drift by 0.02 %", ("{lamp_drift: {percent: -0.02}}",)),
    Case("lens, k1 -0.1", ("{lens_distortion: {k1: -0.1}}",), ("lens_distortion",)),
    Case("lens, k1 -0.0005", ("{lens_distortion: {k1: -0.0005}}",)),
    Case("table wobbles by 0.3 degrees", ("wobble",), ("wobble",)),
    Case("table wobbles by 0.001 degrees", ("{wobble: {amplitude_deg: 0.001}}",)),
    Case(
        "highlights brighter than the detector's range",
        ("{lamp: {fraction: 0.5}}", "{gloss: {roughness: 0.1}}", "{saturation: {exposure_factor: 2.0}}",
         "{tarp_exposure: {exposure_factor: 0.4}}"),
        ("view_dependence", "uneven_light", "saturated_highlights"),
    ),
    Case("no markers, wooden boards", ("textured_background",), ("still_chamber", "pose_refinement"), markers=False),
)  # fmt: skip
TRAINED = {
    "nothing but noise": (),
    "lamp, 40 % of the light": ("view_dependence",),
    "lamp, 3 %": ("view_dependence",),
    "gloss in an even chamber": ("view_dependence",),
    "lamp and gloss": ("view_dependence",),
    "wooden boards": ("still_chamber",),
    "wooden boards, 2 % of the contrast": ("still_chamber",),
    "no markers, wooden boards": ("still_chamber", "pose_refinement"),
}
"""Cases that models are trained on, and effects that are left out in turn, or added where they are not chosen."""
DECISIONS = ("effect", "session", "simulated", "evidence", "noise", "threshold", "unit", "decided", "right")
MODELS = ("session", "model", "effects", "SAM, rad", "RMSE", "SAM within", "processor seconds")


@dataclass(frozen=True)
class Effects(PaperTable):
    """Simulate, process, train and judge what is missing; print and write the tables."""

    common: str = "--pipeline.datamanager.train-num-rays-per-batch 1024"
    """Words that every run gets, as in `hsi-sc-nerf benchmark`."""
    iterations: int | None = 600
    """Steps of each run."""
    threads: int | None = 1
    """CPU threads."""
    frames: int = 30
    """Frames of a session."""
    size: int = 96
    """Width and height of the images, pixels."""
    bands: int = 36
    """Spectral bands."""
    seeds: tuple[int, ...] = (0, 1)
    """Of the networks and the drawn pixels, a run each."""
    parts: tuple[Literal["decisions", "models"], ...] = ("decisions", "models")
    """Which tables to make."""
    only: str = ""
    """Sessions whose names contain this."""

    def main(self) -> None:
        """Make the tables."""
        for case in CASES:
            if self.only not in case.name:
                continue
            if "decisions" in self.parts:
                rows = decision_rows(case, open_packed(self.processed(case)).effects)
                write_results("effects", DECISIONS, rows, keys=2, folder=self.results)
            if "models" in self.parts and case.name in TRAINED:
                seeds = f"scene, runs {' '.join(map(str, self.seeds))}"
                rows = self.model_rows(case)
                write_results("effects_of_models", MODELS, rows, keys=2, seed=seeds, folder=self.results)

    def processed(self, case: Case, noise: Sequence[str] = NOISE) -> Path:
        """Dataset of a case; without noise it has markers, for its cubes alone are of use."""
        words = case.name.replace(",", "").replace("%", "percent").replace(" ", "-")
        session = self.output_dir / f"{words}{'' if noise else '-clean'}"
        if not session.exists():
            own = load_scene(case.scene)
            if not case.markers and noise:
                own = replace(own, markers=replace(own.markers, on_container=0, on_disc=0))
            size = self.size if case.markers else FEATURES_PX
            scene = override(own, frames=self.frames, size_px=size, bands=self.bands, effects=(*noise, *case.effects))
            both = sorted((*own.effects, *scene.effects), key=lambda effect: list(EFFECTS).index(effect.name))
            simulate_session(replace(scene, effects=tuple(both)), session)
        return process_session(session, session.with_name(f"{session.name}-data"), PROCESS)

    def model_rows(self, case: Case) -> list[list[str]]:
        """A row for each model that is trained on a case: as decided, all effects, and each one changed."""
        data, clean = self.processed(case), self.processed(case, noise=())
        auto = chosen_effects("auto", open_packed(data))
        models = {"as decided": auto, "all effects": MODEL_EFFECTS}
        for effect in TRAINED[case.name]:
            if effect in auto:
                models[f"without {effect}"] = tuple(name for name in auto if name != effect)
            else:
                models[f"with {effect}"] = tuple(name for name in MODEL_EFFECTS if name in (*auto, effect))
        rows = []
        for title, effects in models.items():
            setting = effects_setting(effects)
            found = [self.judged(setting, data, clean, seed) for seed in self.seeds]
            figures = {name: [one[name] for one in found] for name in found[0]}
            scores = (
                *(mean_and_deviation(figures[name], 4) for name in ("clean_sam", "clean_rmse", "sam")),
                mean_and_deviation(figures["cpu_seconds"], 0),
            )
            rows.append([case.name, title, setting.replace(",", ", "), *scores])
        return rows

    def judged(self, setting: str, data: Path, clean: Path, seed: int) -> dict[str, float]:
        """Scores of one run against noise-free and measured views, and its processor time."""
        name = setting.replace(",", "-").replace("_", "-")
        runs = data.with_name(f"{data.name}-runs-{seed}")
        (run,) = self.trained([own_configuration(f"{name}=--pipeline.model.effects {setting}")], data, runs, seed)
        kept = runs / name / "judged.json"
        if not kept.is_file() or kept.stat().st_mtime < (runs / name / "result.json").stat().st_mtime:
            config = runs / name / "benchmark" / run.method / "run" / "config.yml"
            write_json(kept, noise_free_metrics(config, clean, self.held_out_views))
        last = run.checkpoints[-1]
        scores: dict[str, float] = json.loads(kept.read_text(encoding="utf-8"))
        return scores | {"sam": last.metrics["sam"], "cpu_seconds": last.cpu_seconds}


def decision_rows(case: Case, effects: Sequence[Effect]) -> list[list[str]]:
    """A row for each effect of a session."""
    rows = []
    for effect in effects:
        if effect.name == "spectral_rank":
            continue
        simulated = "clear" if effect.name in case.present else "weak" if effect.name in case.weak else "no"
        right = "-" if simulated == "weak" else "yes" if effect.present == (simulated == "clear") else "no"
        numbers = ("-" if v is None else f"{v:.3g}" for v in (effect.evidence, effect.noise, effect.threshold))
        decided = "yes" if effect.present else "no"
        rows.append([effect.name, case.name, simulated, *numbers, effect.unit, decided, right])
    return rows


if __name__ == "__main__":
    tyro.cli(Effects).main()
