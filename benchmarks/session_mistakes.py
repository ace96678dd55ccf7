"""What `inspect` and `process` make of sessions with one spoiling mistake each, and how right the result is.

    uv run python benchmarks/session_mistakes.py --output-dir OUT

The sessions are the path-traced one of benchmarks/independent_session.py and one of our own simulator. Each mistake
is made in a copy. Where `process` ends with status 0, its dataset is compared with the truth.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from results_table import RESULTS, write_results

from hsi_sc_nerf.geometry.camera import rotation_angle_deg
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.simulate.truth import load_truth

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
OTHER_DAY = "26-10-2026"
LONGEST_SENTENCE = 200


@dataclass(frozen=True)
class Mistake:
    """One mistake, and the words with which `process` is called."""

    name: str
    make: Callable[[Path, Path], None]
    """Makes it in the folder of a session; the second folder is a session of another object, of two frames."""
    words: tuple[str, ...] = ()
    replaces_frames: bool = False
    """Whether it replaces frames, which then do not count in the errors."""


@dataclass(frozen=True)
class SessionMistakes:
    """Make every mistake and write the table."""

    output_dir: Path
    """Folder for the sessions and datasets; sessions that are there are used again."""
    independent: Path | None = None
    """An independent session that is there already."""
    sessions: tuple[str, ...] = ("path-traced", "simulated")
    """Which sessions."""
    only: tuple[str, ...] = ()
    """Only these mistakes, by name."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Do what is missing, print the table, write it."""
        self.output_dir.mkdir(parents=True, exist_ok=True)
        for kind in self.sessions:
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

    def _path_traced(self) -> tuple[Path, Path]:
        script = str(Path(__file__).with_name("independent_session.py"))
        session, other = self.independent or self.output_dir / "path-traced", self.output_dir / "path-traced-other"
        if not (session / "truth").is_dir():
            subprocess.run([sys.executable, script, str(session)], check=True)
        if not (other / "truth").is_dir():
            words = [str(other), "--frames", "2", "--fruit", "long", "--seed", "1"]
            subprocess.run([sys.executable, script, *words], check=True)
        return session, other

    def _simulated(self, name: str, effects: tuple[str, ...] = ()) -> tuple[Path, Path]:
        found = []
        for suffix, scene, frames in (("", "pear", FRAMES), ("-other", "apple", 2)):
            found.append(self.output_dir / f"{name}{suffix}")
            if not found[-1].is_dir():
                words = ["simulate", scene, str(found[-1]), "--frames", str(frames), "--size", str(SIZE_PX)]
                _command([*words, "--effects", *EFFECTS, *effects])
                _edit_headers(found[-1], "(?m)^(byte order.*)$", r"\1" "\nacquisition date = 14-10-2026")
        return found[0], found[1]

    def _judged(self, mistake: Mistake, session: Path, other: Path) -> list[str]:
        """The row's cells after the mistake's name."""
        made, data = self.output_dir / "made", self.output_dir / "data"
        for folder in (made, data):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(session, made, ignore=shutil.ignore_patterns("truth"))
        mistake.make(made, other)
        inspected, _, inspect_s = _command(["inspect", str(made), "--output-dir", str(data / "report")])
        found = data / "report" / "inspection.json"
        findings = json.loads(found.read_text(encoding="utf-8"))["findings"] if found.is_file() else []
        red = ", ".join(dict.fromkeys(finding["name"] for finding in findings if finding["level"] == "red"))
        shutil.rmtree(data, ignore_errors=True)
        processed, said, process_s = _command(["process", str(made), "--output-dir", str(data), *mistake.words])
        replaced = [frame.name for frame in _replaced(session)] if mistake.replaces_frames else []
        errors = measured_errors(data, session, replaced) if processed == 0 else [""] * 5
        sentence = said.replace(str(made), "SESSION")
        if len(sentence) > LONGEST_SENTENCE:
            sentence = f"{sentence[:LONGEST_SENTENCE]} ..."
        said = "" if processed == 0 else sentence
        return [str(inspected), red, f"{inspect_s:.0f}", str(processed), said, *errors, f"{process_s:.0f}"]


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


@dataclass(frozen=True)
class SessionTruth:
    """What is known of a path-traced or a simulated session."""

    poses: dict[str, np.ndarray]
    focal_px: float
    wavelengths_nm: np.ndarray
    drift: dict[str, np.ndarray]
    """Light of the lamps in each band, by capture."""
    coverage: Callable[[str], np.ndarray]
    """Fraction of each pixel (h, w) that the object covers, of a capture."""

    @classmethod
    def of(cls, session: Path) -> SessionTruth:
        """Read the truth beside a session."""
        masks = session / "truth" / "masks.npz"
        if masks.is_file():
            values = json.loads((session / "truth" / "truth.json").read_text(encoding="utf-8"))
            coverage = dict(np.load(masks))
            return cls(
                {frame["capture"]: np.array(frame["camera_to_world"]) for frame in values["frames"]},
                values["intrinsics"]["fl_x"],
                np.array(values["wavelengths_nm"]),
                {frame["capture"]: np.array(frame["drift"]) for frame in values["frames"]},
                lambda capture: coverage[capture],
            )
        truth = load_truth(session)
        lamps = {name: np.prod([f[0, 0] for f in truth.light(name).illumination], axis=0) for name in truth.captures}
        poses = dict(zip(truth.captures, truth.camera_to_world, strict=True))
        return cls(poses, truth.intrinsics.fl_x, truth.wavelengths_nm, lamps, truth.object_coverage)


def _nothing(session: Path, other: Path) -> None:
    pass


def _frame_as_white(session: Path, other: Path) -> None:
    white, frame = session / _stated(session)["white_reference"], _frames(session)[3]
    for path in (frame / "capture").iterdir():
        shutil.copy(path, white / "capture" / path.name.replace(frame.name, white.name))


def _another_day(session: Path, other: Path) -> None:
    for frame, of_other in zip(_replaced(session), _frames(other), strict=True):
        for path in (of_other / "capture").iterdir():
            shutil.copy(path, frame / "capture" / path.name.replace(of_other.name, frame.name))
        _edit_headers(frame, r"acquisition date = .*", f"acquisition date = {OTHER_DAY}")


def _replaced(session: Path) -> list[Path]:
    """The frames at the angles of the other object's two."""
    frames = _frames(session)
    return [frames[0], frames[len(frames) // 2]]


def _another_object(session: Path, other: Path) -> None:
    _another_day(session, other)
    _edit_headers(session, r"acquisition date = .*", f"acquisition date = {OTHER_DAY}")


def _without_folder(session: Path, other: Path) -> None:
    frame = _frames(session)[4]
    for path in (frame / "capture").iterdir():
        path.rename(frame / path.name)
    (frame / "capture").rmdir()


def _empty_capture(session: Path, other: Path) -> None:
    for path in (_frames(session)[4] / "capture").iterdir():
        path.unlink()


def _empty_file(session: Path, other: Path) -> None:
    frame = _frames(session)[4]
    (frame / "capture" / f"{frame.name}.raw").write_bytes(b"")


def _no_session_json(session: Path, other: Path) -> None:
    (session / "session.json").unlink()


def _upright_in_specim_iq_folders(session: Path, other: Path) -> None:
    stated = _stated(session)
    del stated["image_rotation_deg"]
    (session / "session.json").write_text(json.dumps(stated), encoding="utf-8")
    for path in [*session.rglob("*.hdr"), *session.rglob("*.xml")]:
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace("simulated SPECIM IQ", "SPECIM IQ"), encoding="utf-8")


WALL = Mistake("textured wall", _nothing)
MISTAKES = [
    Mistake("none", _nothing),
    WALL,
    Mistake("none, --poses colmap", _nothing, ("--poses", "colmap")),
    Mistake("white is one of the frames", _frame_as_white),
    Mistake("two frames of another day and object", _another_day, replaces_frames=True),
    Mistake("two frames of another object", _another_object, replaces_frames=True),
    Mistake("a capture without capture/", _without_folder),
    Mistake("one empty capture", _empty_capture),
    Mistake("one empty capture, --skip-damaged", _empty_capture, ("--skip-damaged",)),
    Mistake("a file of 0 bytes", _empty_file),
    Mistake("no session.json", _no_session_json),
    Mistake("upright pictures as SPECIM IQ", _upright_in_specim_iq_folders),
]


def _stated(session: Path) -> dict[str, str]:
    return json.loads((session / "session.json").read_text(encoding="utf-8"))


def _frames(session: Path) -> list[Path]:
    white = _stated(session)["white_reference"]
    return sorted(path.parent for path in session.glob("*/capture") if path.parent.name != white)


def _edit_headers(folder: Path, pattern: str, replacement: str) -> None:
    for path in folder.rglob("*.hdr"):
        path.write_text(re.sub(pattern, replacement, path.read_text(encoding="utf-8")), encoding="utf-8")


def _command(words: list[str]) -> tuple[int, str, float]:
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
