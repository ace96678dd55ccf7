"""Damaged files of every kind that this package reads: each must be refused in one sentence, or be read.

    uv run python benchmarks/damaged_files.py --inputs 100000

Valid files are damaged at random: bytes are changed, parts are cut out, doubled or cut off, numbers and texts are
replaced by such as break programs, values of JSON by others. Each damaged file is read as the commands read it.
Counted are `InputError`, reading without error, any other exception, reading for more than `SLOW_S` of processor
time, and memory beyond what a small file could hold. Inputs that did any of the last three are kept in --keep. With
--progress, a run that was interrupted goes on with the next input.
"""

from __future__ import annotations

import contextlib
import copy
import json
import os
import random
import re
import resource
import signal
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro
from file_kinds import Kind, kinds
from results_table import RESULTS, read_results, write_results

from hsi_sc_nerf.errors import LONGEST_MESSAGE, InputError
from hsi_sc_nerf.files import write_json

COLUMNS = ["kind of file", "inputs", "refused in one sentence", "read", "other exception", "slow", "much memory"]
SLOW_S = 2.0
STOPPED_S = 20.0
MUCH_MEMORY_MB = 200.0
ROOM_BYTES = 3 * 2**30
"""Address space that reading may take beyond what the libraries have."""
HOSTILE_TEXTS = (
    *("", "0", "-1", "1", "2", "3", "255", "65536", "2147483648", "4294967296", "9" * 14, "9" * 20, "1" + "0" * 400),
    *("9" * 5000, "0.5", "-0.0", "1e-320", "1e308", "1e400", "-1e400", "nan", "inf", "1_000", "0x" + "f" * 400),
    *("true", "null", "None", "~", "[]", "{}", "{", "}", "[", "[[[[[[[[", "[" * 3000, "{" * 3000, "{1, 2}", "*a"),
    *("&a [*a]", "<<: *a", "!!python/name:os.system", "a" * 5000, "../../../../etc/passwd", "/", ".", "..", "a/b"),
    *("a|b", "<b>", "\0", "\n", "\r\n", "\t", "\x1b[31m", "\ufeff", "\u2028", "\ud83d", "\u0661\u0662", "é", "%s"),
    *("{0}", "$x$", "°", "end_header", "element vertex 7", "property float x", "lines = 7", "&x;", "<a>", "</a>"),
    "property list uchar int vertex_indices",
)
HOSTILE_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 7, 0.5, -0.0, 1e-320, 1e308, float("nan"), float("inf"), 2**31, 2**63, 10**400),
    *("", "a", "1", "nan", "../a", "/etc/passwd", "a\0b", "a\n|b<c>", "\ud800", "a" * 5000),
    *([], {}, [[]], [None], [0], [1, [2]], [[1, 2], [3]], {"a": 1}, [{}], [1e308] * 4, ["x"] * 5, {"": None}),
)


@dataclass
class Outcome:
    """What became of the inputs of one kind."""

    counts: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)

    @property
    def inputs(self) -> int:
        """Their number."""
        return self.counts.total() - self.counts["slow"] - self.counts["memory"]

    def row(self, name: str) -> list[str]:
        """The line of the table."""
        shown = [str(self.counts[key]) for key in ("refused", "read", "other", "slow", "memory")]
        return [name, str(self.inputs), *shown]

    def save(self, path: Path) -> None:
        """Keep what was counted."""
        write_json(path, {"counts": self.counts, "errors": self.errors})

    @classmethod
    def saved(cls, path: Path | None) -> Outcome:
        """What `save` kept; nothing where there is no such file."""
        if path is None or not path.is_file():
            return cls()
        content = json.loads(path.read_text(encoding="utf-8"))
        return cls(Counter(content["counts"]), Counter(content["errors"]))


class TooSlowError(BaseException):
    """Reading was stopped; no handler of exceptions takes it for one of its own."""


def damaged(content: bytes, rng: random.Random) -> bytes:
    """Content with one to four damages."""
    for _ in range(rng.choice((1, 1, 1, 2, 2, 4))):
        if content[:1] == b"{" and rng.random() < 0.6:
            content = _damaged_json(content, rng)
        elif b"\0" not in content[:2000] and rng.random() < 0.7:
            content = _damaged_text(content, rng)
        else:
            content = _damaged_bytes(content, rng)
    return content


def overwritten(content: bytes, rng: random.Random) -> bytes:
    """Content of the same length with other bytes in one to four places."""
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 4))):
        size = min(len(changed), rng.choice((1, 1, 2, 4, 8, 64)))
        start = rng.randrange(len(changed) - size + 1)
        changed[start : start + size] = rng.choice((rng.randbytes(size), b"\0" * size, b"\xff" * size))
    return bytes(changed)


def _damaged_bytes(content: bytes, rng: random.Random) -> bytes:
    # Headers are at the beginning, and break more.
    start = rng.randrange(min(len(content), rng.choice((64, 512, len(content) + 1))) + 1)
    end = min(len(content), start + rng.choice((1, 1, 2, 4, 8, 64, 1000)))
    some = rng.choice((rng.randbytes(end - start), b"\0" * (end - start), b"\xff" * (end - start), b""))
    doubled = content[start:end] * rng.choice((2, 2, 3, 50))
    return rng.choice(
        (content[:start] + some + content[end:], content[:start] + doubled + content[end:], content[:start])
    )


def _damaged_text(content: bytes, rng: random.Random) -> bytes:
    """A word, a number or a line replaced by a hostile one, by another of the same text, or by nothing."""
    pieces = re.split(rb"(\n)" if rng.random() < 0.25 else rb"([\s,=:<>{}\[\]\"]+)", content)
    at = rng.randrange(len(pieces))
    by = rng.choice((*HOSTILE_TEXTS, *("",) * 5)).encode("utf-8", "surrogatepass")
    pieces[at] = by if rng.random() < 0.7 else rng.choice(pieces)
    return b"".join(pieces)


def _damaged_json(content: bytes, rng: random.Random) -> bytes:
    try:
        values = json.loads(content)
    except (ValueError, RecursionError):
        return _damaged_text(content, rng)
    holders = [(at, key) for at in _containers(values) for key in (at if isinstance(at, dict) else range(len(at)))]
    if not holders:
        return _damaged_text(content, rng)
    # Keys of the first levels break more than the numbers in long lists.
    holder, key = rng.choice(holders[: rng.choice((10, 100, len(holders)))])
    deed = rng.randrange(6)
    if deed == 0:
        del holder[key]
    elif deed == 1 and isinstance(holder, list):
        holder.insert(key, copy.deepcopy(holder[key]))
    elif deed == 2:
        holder[key] = [holder[key]]
    else:
        holder[key] = rng.choice(HOSTILE_VALUES)
    return json.dumps(values).encode("utf-8", "surrogatepass")


def _containers(values: Any) -> Iterator[Any]:
    """All objects and lists that hold something, the outermost first."""
    waiting = [values]
    while waiting:
        one = waiting.pop(0)
        if isinstance(one, dict | list) and one:
            yield one
            waiting += one.values() if isinstance(one, dict) else one


def run_kind(kind: Kind, inputs: int, seed: int, keep: Path | None = None, progress: Path | None = None) -> Outcome:
    """Damage a kind's file ``inputs`` times, read it, and leave the valid file; some may have been done already."""
    outcome, valid = Outcome.saved(progress), kind.path.read_bytes()
    done, rng = outcome.inputs, random.Random(f"{seed} {kind.name}")
    try:
        for number in range(inputs):
            content = (overwritten if kind.same_length else damaged)(valid, rng)
            if number < done:
                continue
            kind.path.write_bytes(content)
            before_mb, started = _peak_mb(), _processor_s()
            said, told = _outcome(kind.read)
            outcome.counts[said] += 1
            took_s, more_mb = _processor_s() - started, _peak_mb() - before_mb
            if said == "other":
                outcome.errors[told] += 1
            for name, bad in (("slow", took_s > SLOW_S), ("memory", more_mb > MUCH_MEMORY_MB)):
                if bad:
                    outcome.counts[name] += 1
                    outcome.errors[f"{name}: {took_s:.1f} s, {more_mb:.0f} MB ({said} {told[:80]})"] += 1
            if keep is not None and (said == "other" or took_s > SLOW_S or more_mb > MUCH_MEMORY_MB):
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f"{kind.name.replace(' ', '_')}-{number}{kind.path.suffix}").write_bytes(content)
            if progress is not None:
                outcome.save(progress)
    finally:
        kind.path.write_bytes(valid)
    return outcome


def _outcome(read: Callable[[], object]) -> tuple[str, str]:
    def stop(*_: object) -> None:
        raise TooSlowError

    earlier = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, STOPPED_S)
    try:
        with _libraries_are_silent():
            read()
        return "read", ""
    except InputError as error:
        told = str(error)
        one_line = told.isprintable() and 0 < len(told) <= LONGEST_MESSAGE
        return ("refused", told) if one_line else ("other", f"message of {len(told)} characters: {told[:200]!r}")
    except TooSlowError:
        return "other", f"not done after {STOPPED_S:g} s"
    except (Exception, SystemExit) as error:
        frame = traceback.extract_tb(error.__traceback__)
        ours = next((f for f in reversed(frame) if "hsi_sc_nerf/" in f.filename), frame[-1])
        return "other", f"{type(error).__name__}: {str(error)[:100]!r} at {Path(ours.filename).name}:{ours.lineno}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, earlier)


@contextlib.contextmanager
def _libraries_are_silent() -> Iterator[None]:
    """Standard error into nothing, where libpng writes past Python."""
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


def _peak_mb() -> float:
    """Of this process and those that it started."""
    return sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1024.0


def _processor_s() -> float:
    """Of this process and those that it started."""
    return sum(os.times()[:4])


def main(
    inputs: int = 100_000,
    seed: int = 0,
    only: str = "",
    keep: Path | None = None,
    progress: Path | None = None,
    results: Path = RESULTS,
) -> None:
    """Damage and read files of every kind, and write the table.

    Args:
        inputs: of all kinds together.
        seed: of the damages.
        only: the kind to run, or part of the names of several, each with its fraction of inputs; other rows are kept.
        keep: folder for inputs that were neither refused nor read in time and memory.
        progress: folder for what was counted so far, after each input; of the same inputs and seed.
        results: folder of the table.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "valid"
        every_kind = kinds(folder)
        alike = [kind for kind in every_kind if only in kind.name]
        found = [kind for kind in alike if kind.name == only] or alike
        for kind in found:  # valid, and compiled and imported before memory is watched
            kind.read()
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + ROOM_BYTES, resource.RLIM_INFINITY))
        weights, rows = sum(kind.weight for kind in every_kind), []
        for kind in found:
            started = time.monotonic()
            counted = None if progress is None else progress / f"{kind.name.replace('/', '_')}.json"
            outcome = run_kind(kind, round(inputs * kind.weight / weights), seed, keep, counted)
            rows.append(outcome.row(kind.name))
            print(f"{kind.name}: {time.monotonic() - started:.0f} s, {dict(outcome.counts)}", flush=True)
            for told, count in outcome.errors.most_common(12):
                print(f"    {count} x {told}", flush=True)
        print(f"written outside: {[path for path in folder.parent.iterdir() if path != folder] or 'nothing'}")
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        kept = (
            {row[0]: row[: len(COLUMNS)] for row in read_results(results / "damaged_files.csv")[1:]} if only else {}
        )
        merged = kept | {row[0]: row for row in rows}
        together = [merged[kind.name] for kind in every_kind if kind.name in merged]
        total = ["all", *(str(sum(int(row[i]) for row in together)) for i in range(1, len(COLUMNS)))]
        write_results("damaged_files", COLUMNS, [*rows, total], keys=bool(only), seed=str(seed), folder=results)


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        tyro.cli(main)
