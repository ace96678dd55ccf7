"""The configurations that the benchmark knows by name, and those that its user adds."""

from __future__ import annotations

import contextlib
import copy
import io
import re
import shlex
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import dropwhile, takewhile
from typing import TYPE_CHECKING

from hsi_sc_nerf.errors import InputError

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

OURS = "hsi-sc-nerf"
PAPER = "hsi-sc-nerf-paper"

# name: (method, words as after `ns-train METHOD`). After `ours`: ours with one departure from the paper taken away.
CONFIGURATIONS: dict[str, tuple[str, str]] = {
    "paper": (PAPER, ""),
    "ours": (OURS, ""),
    "ours-unbounded-scene": (
        OURS,
        "--pipeline.datamanager.dataparser.scene cameras --pipeline.model.disable-scene-contraction False "
        "--pipeline.model.proposal-initial-sampler piecewise --pipeline.model.far-plane 5.0 "
        "--pipeline.model.num-proposal-iterations 2 --pipeline.model.num-proposal-samples-per-ray 256 96 "
        "--pipeline.model.num-nerf-samples-per-ray 48",
    ),
    "ours-proposal-networks": (
        OURS,
        "--pipeline.model.num-proposal-iterations 2 --pipeline.model.num-proposal-samples-per-ray 48 24 "
        "--pipeline.model.num-nerf-samples-per-ray 24 --pipeline.model.distortion-loss-mult 0.02",
    ),
    "ours-direct-head": (OURS, "--pipeline.model.head direct"),
    "ours-plain-background": (OURS, "--pipeline.model.effects view_dependence"),
    "ours-not-view-dependent": (OURS, "--pipeline.model.effects still_chamber"),
    "ours-cosine-loss": (OURS, "--pipeline.model.angular-loss cosine --pipeline.model.angular-loss-mult 0.25"),
    "ours-nerfacto-distortion": (OURS, "--pipeline.model.distortion-loss-mult 0.002"),
    "ours-predicted-normals": (OURS, "--pipeline.model.predict-normals True"),
    "ours-nerfacto-grid": (
        OURS,
        "--pipeline.model.match-resolution False --pipeline.model.max-res 2048 --pipeline.model.log2-hashmap-size 19",
    ),
    "ours-foreground-only": (OURS, "--masked.foreground-ray-fraction 1.0"),
    "ours-no-boundary-rays": (OURS, "--masked.boundary-ray-fraction 0.0"),
    "ours-whole-frames": (OURS, "--full-frame.foreground-ray-fraction None"),
    "ours-discarded-poses": (OURS, "--pipeline.model.camera-optimizer.mode free-discarded"),
    "ours-constant-rate": (OURS, "--full-frame.lr-end 1.0 --masked.lr-start 1.0 --masked.lr-end 1.0"),
    "ours-refined-poses": (OURS, "--pipeline.model.effects view_dependence,still_chamber,pose_refinement"),
}


@dataclass(frozen=True)
class Configuration:
    """A method and what is changed of it.

    Attributes:
        name: what tables and folders call it.
        method: nerfstudio method of this package.
        words: as after ``ns-train METHOD``.
    """

    name: str
    method: str
    words: tuple[str, ...]


def named_configuration(name: str) -> Configuration:
    """The configuration that the table has under a name.

    Raises:
        InputError: it has none.
    """
    if name not in CONFIGURATIONS:
        raise InputError(f"no configuration is named '{name}'; there are {', '.join(CONFIGURATIONS)}.")
    method, words = CONFIGURATIONS[name]
    return Configuration(name, method, split_words(words))


def own_configuration(text: str) -> Configuration:
    """A configuration from ``NAME=WORDS`` (changes of ours) or ``NAME=BASE WORDS`` (of a named one).

    Raises:
        InputError: there is no name that can be a folder's, or no such base.
    """
    name, equals, rest = text.partition("=")
    if not equals or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
        raise InputError(
            f"'{text}' is not a configuration; write NAME=WORDS, a name of letters, digits, dots and dashes, such "
            "as fine=--pipeline.model.max-res 1024."
        )
    words = split_words(rest)
    based = bool(words) and not words[0].startswith("-")
    base = named_configuration(words[0] if based else "ours")
    return Configuration(name, base.method, base.words + words[1 if based else 0 :])


def split_words(text: str) -> tuple[str, ...]:
    """Words as a shell would split them.

    Raises:
        InputError: a quotation mark is left open.
    """
    try:
        return tuple(shlex.split(text))
    except ValueError as error:
        raise InputError(f"'{text}' cannot be split into words ({error}); close the quotation mark.") from error


def training_config(method: str, words: Sequence[str]) -> TrainerConfig:
    """What ``ns-train METHOD WORDS`` would train with.

    Raises:
        InputError: the package has no such method, or it does not take these words.
    """
    import tyro

    # Libraries' warnings about each other's versions would bury the progress.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from nerfstudio.plugins.types import MethodSpecification

        from hsi_sc_nerf import config as plugin

    methods = {
        str(m.config.method_name): m.config for m in vars(plugin).values() if isinstance(m, MethodSpecification)
    }
    if method not in methods:
        raise InputError(f"no method is named '{method}'; there are {', '.join(methods)}.")
    default = copy.deepcopy(methods[method])
    complaint = io.StringIO()
    as_nerfstudio_does = (tyro.conf.SuppressFixed, tyro.conf.FlagConversionOff)
    try:
        with (
            contextlib.redirect_stderr(complaint),
            contextlib.redirect_stdout(complaint),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")  # tyro's, that a function makes the pipeline
            return tyro.cli(type(default), default=default, args=words, config=as_nerfstudio_does)
    except SystemExit as error:
        gist = _gist(complaint.getvalue()) if error.code else "they only ask for help"
        raise InputError(
            f"'{shlex.join(words)}' is not what {method} takes ({gist}); ns-train {method} --help lists the words."
        ) from error


def _gist(complaint: str) -> str:
    """The sentence below the title of tyro's message, whatever its width and whatever the frame is drawn with."""
    lines = [line.strip("│ ") for line in complaint.splitlines() if line.strip("│ ")]
    below_title = dropwhile(_is_rule, lines[1:])
    return " ".join(takewhile(lambda line: not _is_rule(line), below_title)).rstrip(".") or "no reason is given"


def _is_rule(line: str) -> bool:
    return not line.strip("╭╮╰╯├┤─-")
