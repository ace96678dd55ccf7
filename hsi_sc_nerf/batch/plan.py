"""What a batch is to do: its objects with their steps, kept in its folder where every machine reads them."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast, get_args

from hsi_sc_nerf.batch.session_list import OBJECT, SESSION, Row, read_sessions, sessions_table
from hsi_sc_nerf.batch.session_steps import STEPS_NAME, SessionSettings, Step, is_up_to_date, session_steps
from hsi_sc_nerf.benchmark.configurations import split_words
from hsi_sc_nerf.errors import InputError, shown
from hsi_sc_nerf.files import atomic_write, make_folder, read_json, write_json
from hsi_sc_nerf.findings import INSPECTION_NAME
from hsi_sc_nerf.models.presets import Preset

LIST_NAME, SETTINGS_NAME, OBJECTS_NAME = "sessions.csv", "settings.json", "objects"
STEPS = ("inspect", "process", "train", "evaluate", "export", "material", "traits", "report")
"""The steps of an object, in order."""
_CALLER = "folder"
"""Key of the folder that the batch was started in, beside the settings."""
_AGAIN = "start `hsi-sc-nerf batch` again"


@dataclass(frozen=True)
class PlannedObject:
    """One object of a batch.

    Attributes:
        session: folder of its captures.
        folder: folder of its results.
        settings: settings of its steps.
        caller: folder that the batch was started in, where relative paths in the words start.
    """

    session: Path
    folder: Path
    settings: SessionSettings
    caller: Path

    def step(self, name: str) -> Step:
        """The command of a step, as things stand in the folder."""
        if name == "inspect":
            words = ("hsi-sc-nerf", "inspect", self.session, "--output-dir", self.folder)
            # What is red there may have been accepted for `process`, which makes the same checks and decides.
            return Step(name, words, (self.session,), (self.folder / INSPECTION_NAME,))
        steps = session_steps(self.session, self.folder, self.settings, self.caller)
        return {step.name: step for step in steps}[name]

    def record(self, step: str) -> Path:
        """The file that says how a step ended."""
        return self.folder / "steps" / f"{step}.json"


def write_plan(out: Path, rows: Sequence[Row], settings: SessionSettings, kept: Path | None = None) -> None:
    """Keep what is to be done in ``out``, where `read_plan` finds it; what is unchanged is not written anew.

    Args:
        out: folder of the batch.
        rows: its objects.
        settings: settings of all.
        kept: folder to keep the plan in instead; ``out`` stays as it is.

    Raises:
        InputError: words of a row cannot be used, or ``out`` holds other sessions under the names of these, lies in
            one of them, or has a list that no batch wrote.
    """
    for row in rows:
        settings_of(row, settings)
    _require_free(out, rows)
    kept = out if kept is None else kept
    make_folder(kept)
    # The settings first: a list without them is not of a batch.
    write_json(kept / SETTINGS_NAME, asdict(settings) | {_CALLER: str(Path.cwd())})
    table = sessions_table(rows)
    path = kept / LIST_NAME
    if not path.is_file() or path.read_text(encoding="utf-8") != table:
        with atomic_write(path) as (temporary,):
            temporary.write_text(table, encoding="utf-8")


def read_plan(out: Path, kept: Path | None = None) -> dict[str, PlannedObject]:
    """The objects of a batch by their names.

    Args:
        out: folder of the batch.
        kept: folder of the plan, if that is another.

    Raises:
        InputError: there is no batch, or its files were changed.

    Example:
        >>> read_plan(Path("season"))["pear_01"].step("process").words[:2]
        ('hsi-sc-nerf', 'process')
    """
    kept = out if kept is None else kept
    known: dict[str, Any] = read_json(kept / SETTINGS_NAME, _AGAIN)
    try:
        caller = Path(known.pop(_CALLER, out))
        settings = SessionSettings(**known)
        _check_types(settings)
    except TypeError as error:
        raise InputError(f"{kept / SETTINGS_NAME}: are no settings of a batch; {_AGAIN}.") from error
    root = out.resolve() / OBJECTS_NAME
    return {
        row[OBJECT]: PlannedObject(Path(row[SESSION]), root / row[OBJECT], settings_of(row, settings), caller)
        for row in read_sessions(kept / LIST_NAME, may_be_gone=True)
    }


def outdated(objects: Mapping[str, PlannedObject], retry: bool) -> list[Path]:
    """Records of steps that are to be made again: inputs, words or results are not those of the record.

    Args:
        objects: objects of the batch.
        retry: also of the steps that failed.
    """
    found = []
    for one in objects.values():
        for name in STEPS:
            if not one.record(name).is_file():
                continue
            status = read_json(one.record(name), f"delete it and {_AGAIN}").get("status")
            step = one.step(name)
            if status == "done" and not _has_results(step, one.folder):
                found.append(one.record(name))
            if status == "failed" and (retry or not step.was_tried(one.folder)):
                found.append(one.record(name))
    return found


def _has_results(step: Step, folder: Path) -> bool:
    """Whether results of the same command and inputs are there; `inspect` that found something red has them too."""
    if step.name == "inspect":
        return step.was_tried(folder) and step.outputs[0].is_file()
    return is_up_to_date(step, folder)


def unlisted(out: Path, rows: Sequence[Row]) -> list[str]:
    """Names of objects whose results lie in ``out``, but that the list does not name; the table leaves them out."""
    folder = out / OBJECTS_NAME
    listed = {row[OBJECT] for row in rows}
    return sorted(one.name for one in folder.iterdir() if one.name not in listed) if folder.is_dir() else []


def _require_free(out: Path, rows: Sequence[Row]) -> None:
    """Check that nothing of the user's is replaced in ``out``."""
    for row in rows:
        if out.resolve().is_relative_to(row[SESSION]):
            raise InputError(f"{out}: lies in the session {row[SESSION]}; choose another --output-dir.")
    path = out / LIST_NAME
    if not path.is_file():
        return
    if not (out / SETTINGS_NAME).is_file():
        raise InputError(f"{path}: is not of a batch and would be replaced; move it, or choose another --output-dir.")
    try:
        earlier = {row[OBJECT]: row[SESSION] for row in read_sessions(path, may_be_gone=True)}
    except InputError:
        return  # damaged, and now written anew
    for row in rows:
        results = out / OBJECTS_NAME / row[OBJECT]
        before = earlier.get(row[OBJECT]) or _session_of(results) or row[SESSION]
        # A session that is no longer there was moved.
        if before != row[SESSION] and Path(before).is_dir() and results.is_dir():
            raise InputError(
                f"{results}: is of another session, {before}; choose another --output-dir, or delete it first."
            )


def _session_of(results: Path) -> str:
    """The session that results are of, also where the last list does not name them; empty where nothing tells."""
    path = results / STEPS_NAME
    try:
        return shlex.split(read_json(path, _AGAIN)["inspect"]["command"])[2] if path.is_file() else ""
    except (InputError, LookupError, TypeError, AttributeError, ValueError):
        return ""


def _check_types(settings: SessionSettings) -> None:
    texts = (settings.process, settings.train, settings.material, settings.traits)
    numbers = (settings.num_points, 1 if settings.max_num_iterations is None else settings.max_num_iterations)
    if not all(type(text) is str for text in texts) or not all(type(number) is int for number in numbers):
        raise TypeError("a setting has the type of another")


def settings_of(row: Row, settings: SessionSettings) -> SessionSettings:
    """The settings of an object: the batch's, its own preset, and its own words after the batch's.

    Raises:
        InputError: there is no such preset, or words cannot be split.
    """
    preset = row.get("preset") or settings.preset
    if preset not in get_args(Preset):
        choices = ", ".join(get_args(Preset))
        raise InputError(f"the object {row[OBJECT]}: its preset {shown(preset)} is none; there are {choices}.")
    process, train = (f"{getattr(settings, key)} {row.get(key, '')}".strip() for key in ("process", "train"))
    for text in (process, train):
        try:
            split_words(text)
        except InputError as error:
            raise InputError(f"the object {row[OBJECT]}: {error}") from error
    return replace(settings, preset=cast(Preset, preset), process=process, train=train)
