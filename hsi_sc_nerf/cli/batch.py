"""Commands on many sessions: ``batch``, a workflow that Snakemake runs here or on a cluster, and ``collect``."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from socket import gethostname
from tempfile import TemporaryDirectory
from uuid import uuid4

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf import batch
from hsi_sc_nerf.batch.plan import OBJECTS_NAME, STEPS, outdated, read_plan, settings_of, unlisted, write_plan
from hsi_sc_nerf.batch.session_list import OBJECT, Row, read_sessions
from hsi_sc_nerf.batch.session_steps import SessionSettings
from hsi_sc_nerf.benchmark.steps import require_posix
from hsi_sc_nerf.cli.step_words import check_words
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import make_folder, read_json, require_writable
from hsi_sc_nerf.settings_file import check_options

SNAKEFILE = Path(batch.__file__).with_name("Snakefile")
_LOCKS = Path(".snakemake", "locks")
_ELSEWHERE = ("--executor", "-e", "--profile", "--workflow-profile")
"""Words of Snakemake after which another than this machine, or the user's profile, says how many jobs may run."""


@dataclass(frozen=True)
class BatchCommand(SessionSettings):
    """Do the steps of `run` on many sessions, here or on a cluster, and collect them in one table and one page.

    A session that fails does not stop the others; the table has its sentence. Started again, the command does what is
    missing, and what failed where its session or its words were changed. Words that it does not know, after its own,
    go to Snakemake unchanged, such as --executor slurm --jobs 50.
    """

    sessions: tyro.conf.Positional[Path | None] = None
    """Folder of the sessions' folders, or a CSV with the columns object and session, and others of your own. Its
    columns preset, process and train hold settings of single sessions; their words follow those of the options."""
    output_dir: Path | None = None
    """Folder for the results: sessions.csv, objects/NAME, traits.csv and index.html."""
    dry_run: bool = False
    """Show what would be done, and do and write nothing."""
    retry: bool = False
    """Try the steps again that failed."""
    gpu: bool = shutil.which("nvidia-smi") is not None
    """Ask for a GPU for each step that computes on one; by default where this machine has one."""
    snakefile: bool = False
    """Print where the workflow lies, and end."""
    other_words: tyro.conf.Suppress[tuple[str, ...]] = ()
    """Words for Snakemake."""

    def main(self) -> None:
        """Start the workflow.

        Raises:
            InputError: the list or the folder cannot be used, another batch works there, or a job was lost.
        """
        check_options(self)
        if self.snakefile:
            print(SNAKEFILE)
            return
        if self.sessions is None or self.output_dir is None:
            raise InputError(
                "sessions or --output-dir are missing; write hsi-sc-nerf batch SESSIONS --output-dir OUT."
            )
        require_posix()
        if find_spec("snakemake") is None:
            raise InputError("Snakemake is not installed; pip install 'hsi-sc-nerf[batch]' (Python 3.11 or newer).")
        out, rows = self.output_dir, read_sessions(self.sessions)
        settings = SessionSettings(**{name: getattr(self, name) for name in SessionSettings.__dataclass_fields__})
        check_words(settings)
        objects: dict[SessionSettings, list[str]] = {}
        for row in rows:
            objects.setdefault(settings_of(row, settings), []).append(row[OBJECT])
        for own, names in objects.items():
            try:
                check_words(own, [out / OBJECTS_NAME / name for name in names])
            except InputError as error:
                raise InputError(f"the object {names[0]}: {error}") from error
        locking = not {"--unlock", "--nolock"} & {*self.other_words}
        if locking and any((out / _LOCKS).glob("*")):
            raise _taken(out)
        if self.dry_run:
            with TemporaryDirectory() as folder:
                kept = Path(folder) / "plan"
                write_plan(out, rows, settings, kept)
                self._start(out, rows, kept, _stand_in(out, Path(folder) / "out"))
        else:
            with _lock(out) if locking else nullcontext():
                write_plan(out, rows, settings)
                self._start(out, rows, out, out)
            _show_failures(out)

    def _start(self, out: Path, rows: Sequence[Row], kept: Path, directory: Path) -> None:
        """Run Snakemake.

        Args:
            out: folder of the batch.
            rows: its objects.
            kept: folder of its plan.
            directory: that Snakemake works in.

        Raises:
            InputError: Snakemake ended early.
        """
        if left := unlisted(out, rows):
            told = ", ".join(left[:5]) + (", …" if len(left) > 5 else "")
            Console(stderr=True, highlight=False, soft_wrap=True).print(
                f"[yellow]{escape(str(out))}: holds results that the list does not name ({escape(told)}); they stay, "
                "and the table leaves them out."
            )
        again = [str(path.relative_to(out.resolve())) for path in outdated(read_plan(out, kept), self.retry)]
        words = ["--config", f"gpu={self.gpu}", *([f"plan={kept.resolve()}", "--dry-run"] if self.dry_run else [])]
        words += ["--keep-going", "--rerun-incomplete", "--rerun-triggers", "mtime", "input"]
        words += ["--forcerun", *again] if again else []
        others = [*self.other_words]
        if not any(word.split("=")[0] in _ELSEWHERE for word in others):
            memory_mb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 10**6
            resources = ["gpu=1", f"mem_mb={memory_mb}"]
            words += ["--resources", *resources, "--cores", "all"]
            others = _before_own_resources(resources, others)
        # Last a word that takes one value: the user's may begin with the name of a rule.
        words += ["--snakefile", str(SNAKEFILE.resolve()), "--directory", str(directory)]
        if _snakemake([*words, *others]) != 0:
            raise InputError(f"{out}: Snakemake ended early, see above; the same command goes on where it stopped.")


def _before_own_resources(resources: Sequence[str], words: Sequence[str]) -> list[str]:
    """The user's words for Snakemake, which takes the last --resources whole, with ours before each of theirs."""
    found = []
    for word in words:
        option, _, value = word.partition("=")
        own = option in ("--resources", "--res")
        found += [option, *resources, *([value] if value else [])] if own else [word]
    return found


@contextmanager
def _lock(out: Path) -> Iterator[None]:
    """Keep other batches out of a folder from before the plan is written, which is seconds before Snakemake does it.

    The lock lies among Snakemake's own, so that its --unlock removes it. Folders made for it go with it, if nothing
    else came to lie there.

    Raises:
        InputError: another batch has it, or the folder cannot be written to.
    """
    path, owner = out / _LOCKS / "plan.lock", f"{gethostname()} {os.getpid()} {uuid4()}\n"
    made = [folder for folder in (path.parent, path.parent.parent, out) if not folder.exists()]
    try:
        make_folder(path.parent)
        _claim(path, owner, out)
        yield
    finally:
        # Snakemake removes all locks at its end; by now this one can be that of the next batch.
        with suppress(FileNotFoundError):
            if path.read_text(encoding="utf-8") == owner:
                path.unlink()
        for folder in made:
            with suppress(OSError):
                folder.rmdir()


def _claim(path: Path, owner: str, out: Path) -> None:
    """Write the lock, which only one of two machines on a shared folder succeeds with."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(owner)
    except FileExistsError as error:
        raise _taken(out) from error
    except OSError as error:
        path.unlink(missing_ok=True)  # begun on a full disk, it would keep all later batches out
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); free some space or choose another folder."
        ) from error


def _taken(out: Path) -> InputError:
    return InputError(
        f"{out}: another batch works there, or was killed; if none runs on any machine, start this one once with "
        "--unlock, and again."
    )


def _stand_in(out: Path, folder: Path) -> Path:
    """Where Snakemake can look at a batch's folder without leaving its own files there: links to what lies in it.

    A folder that Snakemake has worked in stands for itself, because what it keeps there tells what has changed.
    """
    if (out / ".snakemake").is_dir():
        return out
    folder.mkdir()
    for one in out.iterdir() if out.is_dir() else ():
        (folder / one.name).symlink_to(one.resolve())
    return folder


def _snakemake(words: list[str]) -> int:
    """Run Snakemake in this process, so that what ends one ends the other; its exit status."""
    from snakemake.cli import main

    try:
        main(words)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def _show_failures(out: Path) -> None:
    """Print the sentence of each step that failed, and how many objects are done."""
    console = Console(highlight=False, soft_wrap=True)
    plan, done = read_plan(out), 0
    for name, one in plan.items():
        failed = {}
        for step in STEPS:
            path = one.record(step)
            record = read_json(path, "delete it and start again") if path.is_file() else {}
            done += step == STEPS[-1] and record.get("status") == "done"
            if record.get("status") == "failed":
                failed[step] = record["sentence"]
        needed = {step: sentence for step, sentence in failed.items() if one.step(step).needed}
        # What `inspect` cannot read, `process` cannot either: one sentence is enough.
        for step, sentence in (needed or failed).items():
            without = "" if needed else " The other steps do without."
            console.print(f"[yellow]{escape(name)}, {step}: {escape(sentence)}{without}")
    console.print(f"{done} of {len(plan)} objects are done.", style="bold")


@dataclass(frozen=True)
class CollectCommand:
    """Write one table and one page of all objects of a batch, failed ones with the sentence that says why.

    Writes index.html (start here), traits.csv, traits_dictionary.csv and, where pyarrow is installed, traits.parquet.
    `hsi-sc-nerf batch` ends with it; called again, it takes what is there by then.
    """

    output_dir: tyro.conf.Positional[Path]
    """Folder of the batch, with sessions.csv and objects/."""

    def main(self) -> None:
        """Collect and write.

        Raises:
            InputError: there is no batch, or the results cannot be written.
        """
        from hsi_sc_nerf.batch.page import write_overview
        from hsi_sc_nerf.batch.tables import CSV_NAME, listed_sessions, read_table, write_tables
        from hsi_sc_nerf.terminal import progress_bar

        out = self.output_dir
        count = len(listed_sessions(out))
        require_writable(out)
        with progress_bar("reading", "objects", count) as done:
            table = read_table(out, done)
        parquet = write_tables(table, out)
        with progress_bar("pictures", "objects", len(table.rows)) as done:
            page = write_overview(table, out, done)
        console = Console(highlight=False, soft_wrap=True)
        if not parquet:
            console.print(
                "[yellow]traits.parquet is not written, because pyarrow is not installed; run `pip install "
                "'hsi-sc-nerf\\[batch]'` to have it."
            )
        console.print(f"{len(table.rows)} objects. Open {escape(str(page))} in a browser; {CSV_NAME} holds the same.")
