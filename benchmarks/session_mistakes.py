"""What `inspect` and `process` make of sessions with one spoiling mistake each, and how right the result is.

    uv run python benchmarks/session_mistakes.py --output-dir OUT

The sessions are the path-traced one of benchmarks/independent_session.py and one of our own simulator. Each mistake
is made in a copy. Odd objects (odd_objects.py) are sessions of their own. Where `process` ends with status 0, its
dataset is compared with the truth.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from mistakes import MISTAKES, WALL, Mistake, edit_headers, nothing, replaced_frames
from odd_objects import ODD, odd_session
from results_table import Benchmark, write_results
from session_truth import SessionTruth

from hsi_sc_nerf.geometry.camera import rotation_angle_deg
from hsi_sc_nerf.packed.dataset import open_packed

COLUMNS = [
    "session",
    "mistake",
    "inspect: status",
    "red",
    "s",
    "process: status",
    "it says",
    "poses, deg",
    "poses, mm",
    "focal length, %",
    "masks, smallest IoU",
    "drift, %",
    "s, process",
]
SIZE_PX, FRAMES = 112, 24
EFFECTS = ("photon_noise", "read_noise", "dark_pattern", "chamber_shading", "lamp_drift")
ODD_SCENES = {"pear": 41, "apple": 42}
"""Scenes and seeds of the odd objects. Limits were chosen on the pears."""
LONGEST_SENTENCE = 200


@dataclass(frozen=True)
class SessionMistakes(Benchmark):
    """Make every mistake and write the table."""

    output_dir: Path
    """Folder for the sessions and datasets; sessions that are there are used again."""
    independent: Path | None = None
    """An independent session that is there already."""
    sessions: tuple[str, ...] = ("path-traced", "simulated", "odd")
    """Which sessions."""
    only: tuple[str, ...] = ()
    """Only these mistakes, by name."""

    def main(self) -> None:
        """Do what is missing, print the table, write it."""
        self.output_dir.mkdir(parents=True, exist_ok=True)
        for kind in self.sessions:
            if kind == "odd":
                self._odd_objects()
                continue
            session, other = self._path_traced() if kind == "path-traced" else self._simulated(kind)
            for mistake in MISTAKES:
                if self.only and mistake.name not in self.only:
                    continue
                made_from = session
                if mistake is WALL:
                    # The path-traced session has a wall of wood as it is.
                    if kind == "path-traced":
                        continue
                    made_from, _ = self._simulated(f"{kind}-wall", ("textured_background",))
                row = [kind, mistake.name, *self._judged(mistake, made_from, other)]
                write_results("session_mistakes", COLUMNS, [row], keys=2, folder=self.results)

    def _odd_objects(self) -> None:
        for scene, seed in ODD_SCENES.items():
            for odd in ODD:
                if self.only and odd.name not in self.only:
                    continue
                session = odd_session(odd, scene, seed, self.output_dir / f"{scene}-{odd.name.replace(' ', '_')}")
                row = [f"odd {scene}", odd.name, *self._judged(Mistake(odd.name, nothing), session, session)]
                write_results("session_mistakes", COLUMNS, [row], keys=2, folder=self.results)

    def _path_traced(self) -> tuple[Path, Path]:
        from independent_session import IndependentSession  # needs Mitsuba

        session, other = self.independent or self.output_dir / "path-traced", self.output_dir / "path-traced-other"
        if not (session / "truth").is_dir():
            IndependentSession(session).main()
        if not (other / "truth").is_dir():
            IndependentSession(other, frames=2, fruit="long", seed=1).main()
        return session, other

    def _simulated(self, name: str, effects: tuple[str, ...] = ()) -> tuple[Path, Path]:
        found = []
        for suffix, scene, frames in (("", "pear", FRAMES), ("-other", "apple", 2)):
            found.append(self.output_dir / f"{name}{suffix}")
            if not found[-1].is_dir():
                words = ["simulate", scene, str(found[-1]), "--frames", str(frames), "--size", str(SIZE_PX)]
                run_command([*words, "--effects", *EFFECTS, *effects])
                edit_headers(found[-1], "(?m)^(byte order.*)$", r"\1" "\nacquisition date = 14-10-2026")
        return found[0], found[1]

    def _judged(self, mistake: Mistake, session: Path, other: Path) -> list[str]:
        """The row's cells after the mistake's name."""
        made, data = self.output_dir / "made", self.output_dir / "data"
        for folder in (made, data):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(session, made, ignore=shutil.ignore_patterns("truth"))
        mistake.make(made, session, other)
        inspected, _, inspect_s = run_command(["inspect", str(made), "--output-dir", str(data / "report")])
        found = data / "report" / "inspection.json"
        red = findings_of_level(found, "red")
        shutil.rmtree(data, ignore_errors=True)
        processed, said, process_s = run_command(["process", str(made), "--output-dir", str(data), *mistake.words])
        replaced = [frame.name for frame in replaced_frames(session)] if mistake.replaces_frames else []
        errors = measured_errors(data, session, replaced) if processed == 0 else [""] * 5
        sentence = said.replace(str(made), "SESSION")
        if len(sentence) > LONGEST_SENTENCE:
            sentence = f"{sentence[:LONGEST_SENTENCE]} ..."
        amber = findings_of_level(found, "amber")
        said = sentence if processed != 0 else f"amber: {amber}" if amber else ""
        return [str(inspected), red, f"{inspect_s:.0f}", str(processed), said, *errors, f"{process_s:.0f}"]


def findings_of_level(inspection: Path, level: str) -> str:
    """The names of the findings of a level, each once, in the file of an inspection; none without the file."""
    found = json.loads(inspection.read_text(encoding="utf-8"))["findings"] if inspection.is_file() else []
    return ", ".join(dict.fromkeys(one["name"] for one in found if one["level"] == level))


def measured_errors(data: Path, session: Path, left_out: Sequence[str] = ()) -> list[str]:
    """Largest errors of rotation (degrees), position (mm), focal length (%), smallest IoU, largest error of drift."""
    dataset, truth = open_packed(data), SessionTruth.of(session)
    used = [frame for frame in dataset.frames if frame.capture not in left_out]
    turned = max(float(rotation_angle_deg(f.camera_to_world, truth.poses[f.capture])) for f in used)
    moved_m = max(float(np.linalg.norm((f.camera_to_world - truth.poses[f.capture])[:3, 3])) for f in used)
    ious = []
    for frame in used:
        mask, true = frame.mask(), truth.coverage(frame.capture) > 0.5
        ious.append(float((mask & true).sum() / max((mask | true).sum(), 1)))
    calibration = json.loads((data / "calibration.json").read_text(encoding="utf-8"))
    drift = calibration["lamp_drift"]
    off = "not measured"
    if drift["measured"]:
        kept = np.isin(np.round(truth.wavelengths_nm, 2), np.round(calibration["wavelengths_nm"], 2))
        names = [name for name in drift["factor"] if name not in left_out]
        true = np.array([truth.drift[name][kept] for name in names])
        ratio = np.array([drift["factor"][name] for name in names]) / (true / true[0])
        off = f"{100.0 * np.abs(ratio / ratio[0] - 1.0).max():.2f}"
    focal = 100.0 * (dataset.intrinsics.fl_x / truth.focal_px - 1.0)
    return [f"{turned:.3f}", f"{1e3 * moved_m:.2f}", f"{focal:+.2f}", f"{min(ious):.3f}", off]


def run_command(words: list[str]) -> tuple[int, str, float]:
    """Status, last sentence and seconds of a command of ours."""
    started = time.perf_counter()
    environment = os.environ | {"COLUMNS": "1000", "PYTHONWARNINGS": "ignore"}
    argv = [sys.executable, "-m", "hsi_sc_nerf.cli.main", *words]
    done = subprocess.run(argv, capture_output=True, text=True, env=environment, check=False)
    lines = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    if done.returncode:
        print("\n".join(lines[-12:]))
    errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error:")]
    last = (errors or lines or [""])[-1]
    return done.returncode, last, time.perf_counter() - started


if __name__ == "__main__":
    tyro.cli(SessionMistakes).main()
