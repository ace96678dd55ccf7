"""``hsi-sc-nerf compare``: accuracy of a reconstruction against a reference."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import track

from hsi_sc_nerf.evaluation.comparison import CompareConfig, compare, read_reference


@dataclass(frozen=True)
class CompareCommand:
    """Compare a reconstructed cloud or mesh with a reference: precision, recall and F-score over thresholds.

    Writes comparison.md with its pictures, comparison.json, and distances.ply, the cloud coloured by distance.
    """

    cloud: tyro.conf.Positional[Path]
    """The reconstruction, in metres: a point cloud (PLY) or a mesh (PLY, OBJ, STL)."""
    reference: tyro.conf.Positional[Path]
    """The reference: a cloud or mesh, or the folder of a simulated session, whose true surface is known."""
    output_dir: Path
    """Folder for the results."""
    config: Annotated[CompareConfig, tyro.conf.arg(name="")] = field(default_factory=CompareConfig)
    """Settings; the defaults are the paper's where it prints them."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: a file or a setting cannot be used, or the two cannot be aligned.
        """
        console = Console(stderr=True)

        def shown(items: Sequence[Any], doing: str) -> Iterable[Any]:
            return track(items, doing, console=console, transient=True)

        # Slow to import.
        from hsi_sc_nerf.evaluation.comparison_report import screen_tables, write_comparison
        from hsi_sc_nerf.simulate.scores.surface import true_reference

        if self.reference.is_dir():
            reference = true_reference(self.reference, self.config, shown)
        else:
            reference = read_reference(self.reference, self.config)
        comparison = compare(self.cloud, reference, self.config, shown)
        write_comparison(self.output_dir, comparison, self.cloud.name, self.reference.name)
        Console().print(*screen_tables(comparison))
        page = escape(str(self.output_dir / "comparison.md"))
        Console().print(f"Everything, and the pictures: {page}", soft_wrap=True)
