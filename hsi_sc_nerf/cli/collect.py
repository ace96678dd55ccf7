"""``hsi-sc-nerf collect``: one table and one page of all objects of a batch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.files import require_writable


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
