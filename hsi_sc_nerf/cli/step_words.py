"""Words for the steps of a session, refused before the first step if their commands do not take them."""

from __future__ import annotations

import io
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import tyro

from hsi_sc_nerf.batch.session_steps import WORDED_STEPS, SessionSettings, session_steps
from hsi_sc_nerf.benchmark.configurations import OURS, split_words, training_config
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.settings_file import check_options

if TYPE_CHECKING:
    from hsi_sc_nerf.models.staged_trainer import StagedTrainerConfig

_GIVEN = ("--output-dir", "--output", "--load-config", "--experiment-name", "--timestamp", "--method-name")
"""Options that say where a step reads or writes: the other steps go by them."""


def check_words(settings: SessionSettings, outs: Sequence[Path] = ()) -> None:
    """Check the words for the commands.

    Args:
        settings: with the words.
        outs: folders for the results of the sessions that they are for.

    Raises:
        InputError: a command does not take its words, a number lies outside its range, or words name a file that
            their own step replaces or another place for its results.
    """
    for name in WORDED_STEPS:
        for word in split_words(getattr(settings, name)):
            option = word.partition("=")[0].replace("_", "-")
            if option in _GIVEN:
                raise InputError(f"--{name}: {option} is given by the step itself; leave it out.")
    for out in outs:
        _require_inputs_kept(settings, out)
    from hsi_sc_nerf.cli.clouds import TraitsCommand
    from hsi_sc_nerf.cli.light import MaterialCommand
    from hsi_sc_nerf.cli.sessions import ProcessCommand

    # What the steps give themselves: any text will do.
    process = _read("process", settings.process, ProcessCommand, "session", "--output-dir", "out")
    material = _read("material", settings.material, MaterialCommand, "cloud", "--load-config", "config.yml")
    traits = _read("traits", settings.traits, TraitsCommand, "cloud", "--output-dir", "out")
    for name, check in (
        ("train", partial(_require_trainable, split_words(settings.train))),
        ("process", partial(check_options, process.config)),
        ("material", material.checked_light),
        ("traits", traits.check),
    ):
        try:
            check()
        except InputError as error:
            raise InputError(f"--{name}: {error}") from error
    for out in outs:
        try:
            replace(traits, output_dir=out / "traits").require_inputs_kept()
        except InputError as error:
            raise InputError(f"--traits: {error}") from error


def _require_trainable(words: Sequence[str]) -> None:
    """Refuse words that ns-train does not take; without any, its libraries need not be loaded."""
    if words:
        cast("StagedTrainerConfig", training_config(OURS, words)).plan()


def _require_inputs_kept(settings: SessionSettings, out: Path) -> None:
    """Refuse words that name a result of their own step, which would be outdated by it for ever."""
    for step in session_steps(Path(), out, settings):
        written = [path.resolve() for path in step.outputs]
        for path in step.inputs:
            if path.resolve() in written:
                raise InputError(
                    f"--{step.name}: {path} is what this step of {out} itself writes; copy it to another folder and "
                    "name the copy."
                )


def _read(name: str, words: str, command: Any, *given: str) -> Any:
    try:
        with redirect_stderr(io.StringIO()), redirect_stdout(io.StringIO()):
            return tyro.cli(command, args=[*given, *split_words(words)])
    except SystemExit as end:
        raise InputError(
            f"--{name}: the step '{name}' cannot be called with {words}; see `hsi-sc-nerf {name} --help`."
        ) from end
