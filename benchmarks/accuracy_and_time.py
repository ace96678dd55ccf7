"""What accuracy costs in time: budgets, presets, one setting at a time, views and pictures, with three seeds.

    uv run python benchmarks/accuracy_and_time.py --output-dir /tmp/front
    uv run python benchmarks/accuracy_and_time.py --output-dir /tmp/front --parts views --scene maize
    uv run python benchmarks/accuracy_and_time.py --output-dir /tmp/front --parts presets \
        --size 256 --bands 25

A simulated noisy session is trained for the same time with every setting, and judged against what is known:
held-out views without the noise, the true surface, its area and volume. A row is the mean over the seeds and their
range. Ranges that overlap are no difference. What is finished is not done again.

Other work on the machine changes seconds by a third from hour to hour, and steps not at all. So the seconds of a step
are measured once for all rows of a part, in turns in one process, and each row is trained for the steps that its time
buys. Rows that train with the default settings on pictures of the default size have the default's step.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch
import tyro
from accuracy_front import DEFAULT, TITLES, draw_front, table_rows
from beyond_the_paper import SHADING, noise_free_metrics
from jaxtyping import Float
from paper_tables import PaperTable, judged_once
from results_table import read_results, write_results
from traits_accuracy import spots_on
from true_object import TrueObject, relative_rms

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed_mesh
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.analysis.size import size_of
from hsi_sc_nerf.analysis.spectral_mesh import with_spectra
from hsi_sc_nerf.analysis.traits import classified, region_spectrum
from hsi_sc_nerf.benchmark.configurations import own_configuration, split_words
from hsi_sc_nerf.benchmark.run import Job, build_trainer
from hsi_sc_nerf.evaluation.comparison import CompareConfig
from hsi_sc_nerf.evaluation.spatial import Surface, score_at
from hsi_sc_nerf.export.cloud import MAX_INCIDENCE_DEG, SpectralCloud, read_spectral_ply
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.export.spectral_export import export_cloud
from hsi_sc_nerf.files import read_json, write_json
from hsi_sc_nerf.models.presets import ITERATIONS, PRESETS
from hsi_sc_nerf.models.trained_run import open_trained_run
from hsi_sc_nerf.simulate.effects.detector import ReadNoise
from hsi_sc_nerf.simulate.scene import Fruit, load_scene
from hsi_sc_nerf.simulate.scores import true_reference
from hsi_sc_nerf.simulate.truth import load_truth

Part = Literal["budgets", "settings", "presets", "views", "spacing", "pictures"]
CLOUD_POINTS = 150_000
STEPS_A_TURN = 10
SETTLING_TURNS = 12
"""Turns that are not timed: by then the occupancy grid has emptied most of the hull."""
TIMED_TURNS = 8
REFERENCE_TURNS = 4
"""Runs after which it is the first one's turn again: all ratios are to its step, so it is timed more often."""
TIMED_RUN = 10_000
"""Steps of the run that the timed turns are a part of."""
_RAYS = "--pipeline.datamanager.train-num-rays-per-batch"
_MODEL = "--pipeline.model"

# Name of a row: what it changes of the default.
SETTINGS: dict[str, str] = {
    DEFAULT: "",
    "2048 rays a step": f"{_RAYS} 2048",
    "8 samples a ray": f"{_MODEL}.num-nerf-samples-per-ray 8",
    "16 samples a ray": f"{_MODEL}.num-nerf-samples-per-ray 16 --full-frame.samples-per-ray 16",
    "32 samples a ray": "--full-frame.samples-per-ray 32",
    "64 samples a ray": f"{_MODEL}.num-nerf-samples-per-ray 64",
    "no opaque rises": "--masked.rise-length 0",
    "every band a channel": f"{_MODEL}.head direct",
    **{f"basis of {size}": f"{_MODEL}.basis-size {size}" for size in (4, 8, 16, 32)},
    "the paper's hash grid": f"{_MODEL}.match-resolution False",
    "first stage a quarter": "--full-frame.fraction 0.25 --masked.fraction 0.75",
    "first stage three quarters": "--full-frame.fraction 0.75 --masked.fraction 0.25",
    "twice the angular loss": f"{_MODEL}.angular-loss-mult 0.06",
    "no angular loss": f"{_MODEL}.angular-loss-mult 0",
    "the paper's losses": f"{_MODEL}.angular-loss cosine {_MODEL}.angular-loss-mult 0.25",
    "predicted normals": f"{_MODEL}.predict-normals True",
    "pose refinement": f"{_MODEL}.effects pose_refinement",
    "view dependence": f"{_MODEL}.effects view_dependence",
    "still chamber": f"{_MODEL}.effects still_chamber",
    "all three effects": f"{_MODEL}.effects view_dependence,still_chamber,pose_refinement",
}
BUDGETS_S = (10, 20, 40, 80, 160)
VIEWS = (8, 12, 20, 30, 60)
SPACINGS: dict[str, dict[str, Any]] = {
    "20 views": {"frames": 20},
    "20 of 30 views": {"frames": 30, "motion": "{missing_frames: {count: 10}}"},
    "20 views of half a turn": {"frames": 20, "motion": "{partial_turn: {span_deg: 180}}"},
}
PICTURES: dict[str, dict[str, int]] = {
    DEFAULT: {},
    **{f"{size} x {size} pixels": {"size": size} for size in (64, 96, 192)},
    **{f"{bands} bands": {"bands": bands} for bands in (102, 51, 25)},
}

BRUISE_M = 0.02
"""Diameter of the bruise on a pear or apple of the parts "views" and "spacing", whose area is measured as a trait."""


@dataclass(frozen=True)
class AccuracyAndTime(PaperTable):
    """Train, judge, write the table and the picture."""

    common: str = f"{_RAYS} 1024"
    """Words that every run gets, as in `hsi-sc-nerf benchmark`."""
    train_seconds: float = 40.0
    """Training of a setting."""
    threads: int | None = 1
    """CPU threads."""
    scene: str = "pear"
    """Of `hsi-sc-nerf simulate`."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the networks and the drawn pixels."""
    held_out_views: int | None = 3
    """Evaluate this many of the held-out views."""
    parts: tuple[Part, ...] = ("budgets", "settings", "presets", "views", "spacing", "pictures")
    """What is measured; none: only draw."""
    names: tuple[str, ...] = ()
    """Rows of the parts that are measured; all where none is named."""
    default_step_seconds: float | None = None
    """Seconds of a step with the default settings, as measured in an earlier run; those of the other rows are taken
    by their ratio to it, so that rows of several runs can be compared."""
    bruised: tyro.conf.Suppress[bool] = False
    """Whether a pear or apple has a bruise."""
    motion: tyro.conf.Suppress[str] = ""
    """Effect of the turntable as YAML, with which views are not evenly spaced over a turn."""
    picture: Path | None = None
    """PNG file to draw the table to."""

    def main(self) -> None:
        """Do what is missing, write the table, draw it."""
        for part in self.parts:
            seconds = self._step_seconds(part)
            rows = self._rows(part, seconds)
            found: dict[str, list[dict[str, float]]] = {name: [] for name, *_ in rows}
            for seed in self.seeds:
                for name, command, words in rows:
                    judged = command.judged(name, words, seed)
                    cost = seconds.get(name, seconds[DEFAULT])
                    found[name].append(judged | {"seconds": judged["steps"] * cost})
            write_results(
                *("accuracy_and_time", TITLES, table_rows(self._title(part), found)),
                keys=2,
                seed=f"scene, runs {' '.join(map(str, self.seeds))}",
                folder=self.results,
            )
        if self.picture is not None:
            draw_front(self.picture, read_results(self.results / "accuracy_and_time.csv")[1:])

    @property
    def binning(self) -> int:
        """Bands of the sensor that make one of the session: their electrons, and their noise."""
        return paper.BANDS // self.bands

    def _title(self, part: Part) -> str:
        """Name of the part in the table: with the object and the pictures where they are not the usual ones."""
        words = [self.scene] if self.scene != AccuracyAndTime.scene else []
        if (self.size, self.bands) != (AccuracyAndTime.size, AccuracyAndTime.bands):
            words.append(f"{self.size} px, {self.bands} bands")
        return ", ".join((part, *words))

    def _step_seconds(self, part: Part) -> dict[str, float]:
        """Seconds of a step of the default and of the part's rows that have another, by name."""
        once = dict.fromkeys((DEFAULT, *SETTINGS, *PICTURES), 1.0)
        differ = [row for row in self._rows(part, once) if row[0] != DEFAULT and part in ("settings", "pictures")]
        if not differ and self.default_step_seconds is not None:
            return {DEFAULT: self.default_step_seconds}
        kept = self.output_dir / "step_seconds.json"
        known = read_json(kept, "delete it to measure again") if kept.is_file() else {}
        missing = {name: (command._sessions()[0], words) for name, command, words in differ if name not in known}
        if missing or not known:
            measured = step_seconds({DEFAULT: (self._sessions()[0], ""), **missing}, self.common)
            scale = known.get(DEFAULT, measured[DEFAULT]) / measured[DEFAULT]
            known = {name: scale * one for name, one in measured.items()} | known
            write_json(kept, known)
        scale = 1.0 if self.default_step_seconds is None else self.default_step_seconds / known[DEFAULT]
        return {name: scale * one for name, one in known.items()}

    def _rows(self, part: Part, seconds: Mapping[str, float]) -> list[tuple[str, AccuracyAndTime, str]]:
        """Name, options and words of each row that is asked for.

        Args:
            seconds: of a step, of the default and of each row of the parts "settings" and "pictures".
        """
        parts: Mapping[Part, Mapping[str, Mapping[str, Any]]] = {
            "settings": {name: {} for name in SETTINGS},
            "budgets": {f"{budget} s": {"iterations": round(budget / seconds[DEFAULT])} for budget in BUDGETS_S},
            "presets": {name: {"iterations": preset[ITERATIONS]} for name, preset in PRESETS["cpu"].items()},
            "views": {f"{frames} views": {"frames": frames, "bruised": True} for frames in VIEWS},
            "spacing": {name: {**change, "bruised": True} for name, change in SPACINGS.items()},
            "pictures": PICTURES,
        }
        rows = []
        for name, change in parts[part].items():
            if name in self.names or not self.names:
                own = seconds[name] if part in ("settings", "pictures") else seconds[DEFAULT]
                command = replace(self, **{"iterations": round(self.train_seconds / own), **change})
                rows.append((name, command, SETTINGS[name] if part == "settings" else ""))
        return rows

    def _sessions(self) -> tuple[Path, Path]:
        """Dataset of the noisy session; folder of all that belongs to it."""
        kind = f"{self.scene}-{self.size}-{self.bands}-{self.frames}{'-bruised' * self.bruised} {self.motion}"
        folder = self.output_dir / _folder_name(kind)
        scene = load_scene(self.scene)
        if self.bruised and isinstance(scene.object, Fruit):
            scene = replace(scene, object=replace(scene.object, bruise_diameter_m=BRUISE_M))
        full_well = scene.sensor.full_well_electrons * self.binning
        scene = replace(scene, sensor=replace(scene.sensor, full_well_electrons=full_well))
        read_noise = f"{{read_noise: {{electrons: {ReadNoise().electrons * self.binning**0.5:.1f}}}}}"
        always = (*SHADING, self.motion) if self.motion else SHADING
        self.simulated(scene, folder / "noise-free", always)
        return self.simulated(scene, folder / "session", ("photon_noise", read_noise, *always)), folder

    def judged(self, name: str, words: str, seed: int) -> dict[str, float]:
        """Figures of one run."""
        data, folder = self._sessions()
        folder_name = _folder_name(name) if words else DEFAULT
        runs = folder / f"runs-{self.iterations}-{seed}"
        (run,) = self.trained([own_configuration(f"{folder_name}={words}")], data, runs, seed)
        last = run.checkpoints[-1]
        known = {"steps": float(last.iteration), "memory_mib": last.peak_memory_mib}
        known |= {metric: last.metrics[metric] for metric in ("sam", "rmse")}

        def judge(config: Path) -> dict[str, float]:
            views = noise_free_metrics(config, folder / "noise-free-data", self.held_out_views)
            return known | views | surface_figures(config, folder / "session")

        return judged_once(runs, run, judge)


def _folder_name(text: str) -> str:
    return re.sub("[^a-z0-9]+", "-", text).strip("-")


def step_seconds(runs: Mapping[str, tuple[Path, str]], common: str) -> dict[str, float]:
    """Processor seconds of a step of each run: in turns, so that other work on the machine meets all alike.

    Args:
        runs: dataset and words of each, by name. The first is timed more often: ratios are to its step.
        common: words of all.
    """
    torch.set_num_threads(1)
    with TemporaryDirectory() as temporary:
        trainers: dict[str, Any] = {}
        for name, (data, words) in runs.items():
            all_words = tuple(split_words(f"{common} {words}"))
            folder = str(Path(temporary, str(len(trainers))))
            job = Job("hsi-sc-nerf", all_words, str(data), folder, TIMED_RUN, None, "cpu", (), 1, None)
            trainers[name] = build_trainer(job)
            trainers[name]._show_progress = lambda step, psnr_db: None
        seconds, steps = dict.fromkeys(trainers, 0.0), dict.fromkeys(trainers, 0)
        reference, *others = trainers
        blocks = [others[start : start + REFERENCE_TURNS] for start in range(0, len(others), REFERENCE_TURNS)]
        order = [name for block in blocks or [[]] for name in (reference, *block)]
        for turn in range(SETTLING_TURNS + TIMED_TURNS):
            for name in order:
                trainer = trainers[name]
                trainer.pipeline.train()
                # Timed turns are spread over the whole run: a step's cost differs between the stages.
                timed = turn - SETTLING_TURNS
                first = turn * STEPS_A_TURN if timed < 0 else int(TIMED_RUN * (timed + 0.5) / TIMED_TURNS)
                before = time.process_time()
                for step in range(first, first + STEPS_A_TURN):
                    trainer.train_iteration(step)
                if timed >= 0:
                    seconds[name] += time.process_time() - before
                    steps[name] += STEPS_A_TURN
    return {name: seconds[name] / steps[name] for name in trainers}


def surface_figures(config: Path, session: Path) -> dict[str, float]:
    """F-scores of what a camera sees, percent, and errors of area and volume of the closed cloud, percent."""
    truth = load_truth(session)
    with TemporaryDirectory() as temporary:
        cloud = read_spectral_ply(
            export_cloud(open_trained_run(config), Path(temporary), CloudOptions(num_points=CLOUD_POINTS))
        )
    reference = true_reference(session, CompareConfig(whole_reference=False))
    assert reference.seen is not None
    surface = Surface(cloud.points)
    distances_m = (
        reference.surface.distances_m(cloud.points),
        surface.distances_m(reference.surface.points_m[reference.seen]),
    )
    f_scores = [score_at(*distances_m, threshold_m).f_score for threshold_m in (0.002, 0.0005)]
    figures = dict(zip(("f_2_mm", "f_half_mm"), f_scores, strict=True))
    return figures | trait_errors(cloud, TrueObject.of(truth), truth.camera_to_world[:, :3, 3])


def trait_errors(cloud: SpectralCloud, true: TrueObject, eyes_m: Float[np.ndarray, "frames 3"]) -> dict[str, float]:
    """Errors of what a laboratory reports, percent: area and volume, spectra of spots, area of a bruise.

    Spots are 10 mm wide; the figure is the median over them of the relative root mean square error. The bruise is
    told by mixture, and is absent from the figures of a fruit without one.
    """
    stands_at_m = float(true.mesh.vertices[:, 2].min())
    config = MeshConfig(base_height_m=stands_at_m)
    mesh = closed_mesh(cloud.points, cloud.normals, config)
    surface = with_spectra(mesh, cloud, config.smoothing_radius_m, MAX_INCIDENCE_DEG)
    ideal = true.spectral_mesh(eyes_m)
    found, expected = size_of(mesh), size_of(true.mesh)
    spots = [
        relative_rms(*(region_spectrum(one, spot.of(one)).mean for one in (surface, ideal)))
        for spot in spots_on(ideal)
    ]
    errors = {
        "area_percent": 100.0 * (found.area_m2 / expected.area_m2 - 1.0),
        "volume_percent": 100.0 * (found.volume_l / expected.volume_l - 1.0),
        "spots_percent": 100.0 * float(np.median(spots)),
    }
    is_bruise = np.array(true.materials) == "bruise"
    bruised_m2 = float(ideal.areas_m2[ideal.seen & (true.weights[:, is_bruise].sum(axis=1) > 0.5)].sum())
    if bruised_m2 > 0.0:
        library = SpectralLibrary(true.materials, true.wavelengths_nm, true.endmembers)
        classes = classified(surface, library, paper.CLASSIFICATION_ANGLE_RAD)
        found_m2 = classes.mixture_areas_m2[classes.names.index("bruise")]
        errors["bruise_percent"] = 100.0 * (found_m2 / bruised_m2 - 1.0)
    return errors


if __name__ == "__main__":
    tyro.cli(AccuracyAndTime).main()
