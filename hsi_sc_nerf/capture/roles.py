"""The part of a capture by its name: the white, those that are left out, and the order of the turn."""

from __future__ import annotations

import filecmp
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from hsi_sc_nerf.capture.instrument import natural_order
from hsi_sc_nerf.capture.session_info import SessionInfo

# Words in the name of a white reference that nobody named in session.json.
_WHITE_WORDS = ("white", "tarp", "spectralon", "panel")


def white_name(info: SessionInfo, names: Sequence[str]) -> str:
    """The stated name of the white reference; if none is stated, that of the only capture named like a white."""
    stated = info.white_reference != SessionInfo.white_reference
    if stated or info.white_reference in (name.lower() for name in names):
        return info.white_reference
    telling = [name for name in names if any(word in name.lower() for word in _WHITE_WORDS)]
    return telling[0] if len(telling) == 1 else info.white_reference


def in_short(damaged: Mapping[str, str]) -> str:
    """Captures that cannot be used, each with the reason."""
    return ", ".join(f"{name} ({reason.split(': ', 1)[-1].split('; ')[0]})" for name, reason in damaged.items())


def damaged_captures(path: Path, damaged: Mapping[str, str]) -> str:
    """The sentence that refuses a session with captures that cannot be used."""
    return (
        f"{path}: {in_short(damaged)} cannot be used; copy the captures again, or leave them out with --skip-damaged."
    )


def turn_of(frames: Sequence[str], left_out: Collection[str]) -> tuple[str, ...]:
    """Names of all captures of the turning object in their order: the frames, and those that are left out.

    A capture that is left out and named like a white is none of them.
    """
    words = [word for word in _WHITE_WORDS if not any(word in name.lower() for name in frames)]
    objects = {name for name in left_out if not any(word in name.lower() for word in words)}
    return tuple(sorted(objects.union(frames), key=natural_order))


def copies_of_others(kept: Iterable[Path], left_out: Mapping[str, Path]) -> set[str]:
    """Names of captures that are left out and copies of others: the table did not turn for them.

    Args:
        kept: data files of the captures that are kept.
        left_out: data files of those that are left out, by name.
    """
    others, copies = list(kept), set()
    for name, path in left_out.items():
        if any(_are_equal(path, other) for other in others):
            copies.add(name)
        others.append(path)
    return copies


def _are_equal(one: Path, other: Path) -> bool:
    """Whether two files hold the same bytes; files of different captures differ in the first of them."""
    try:
        return filecmp.cmp(one, other, shallow=False)
    except OSError:  # what is left out need not be readable
        return False


def with_angles_of(info: SessionInfo, frames: Sequence[str], turn: Sequence[str]) -> SessionInfo:
    """The content of ``session.json`` with the frames' angles, where it gives those of all captures of the turn."""
    if info.frame_angles_deg is None or len(info.frame_angles_deg) != len(turn):
        return info
    angles_deg = dict(zip(turn, info.frame_angles_deg, strict=True))
    return replace(info, frame_angles_deg=tuple(angles_deg[name] for name in frames))
