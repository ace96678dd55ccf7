"""The package's structure in figures and as a picture: folders, their lines, who imports whom, import circles.

uv run python benchmarks/structure.py --picture docs/images/structure.png
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import grimp
import matplotlib
import networkx
import tyro
from rich.console import Console

from hsi_sc_nerf.terminal import screen_table

PACKAGE = "hsi_sc_nerf"
ROOT = Path(__file__).parents[1]
FOLDERS = ("benchmarks", "tests")


@dataclass(frozen=True)
class Structure:
    """Count files, lines and import circles of the checkout; draw its folders and their imports."""

    picture: Path | None = None
    """PNG file for the picture."""

    def main(self) -> None:
        """Print the table, draw the picture."""
        lines = {path: count_lines(path) for path in python_files(ROOT / PACKAGE)}
        imports = module_imports()
        circles = [circle for circle in networkx.strongly_connected_components(imports) if len(circle) > 1]
        figures = {
            "files": len(lines),
            "lines": sum(lines.values()),
            **{f"lines of {name}": sum(map(count_lines, python_files(ROOT / name))) for name in FOLDERS},
            "largest folder, files": max(Counter(path.parent for path in lines).values()),
            "files in import circles": sum(map(len, circles)),
            "import circles": len(circles),
        }
        rows = [[what, str(number)] for what, number in figures.items()]
        Console().print(screen_table(["what", "number"], rows))
        if self.picture is not None:
            sizes = Counter[str]()
            for path, count in lines.items():
                sizes[folder_of(".".join(path.relative_to(ROOT).with_suffix("").parts))] += count
            draw(folder_imports(imports), sizes, self.picture)


def python_files(folder: Path) -> list[Path]:
    """All modules below a folder."""
    return sorted(folder.rglob("*.py"))


def count_lines(path: Path) -> int:
    """Lines of a file."""
    return len(path.read_text(encoding="utf-8").splitlines())


def module_imports() -> networkx.DiGraph:
    """Edges from importing to imported modules, imports inside functions and for type checking included."""
    graph = grimp.build_graph(PACKAGE, cache_dir=None)
    edges = ((name, found) for name in graph.modules for found in graph.find_modules_directly_imported_by(name))
    return networkx.DiGraph(list(edges))


def folder_of(module: str) -> str:
    """Folder of a module below the package; a top-level module's own name."""
    return module.split(".")[1]


def folder_imports(imports: networkx.DiGraph) -> networkx.DiGraph:
    """Imports between folders, with the number of importing pairs of modules as ``weight``."""
    graph = networkx.DiGraph()
    pairs = Counter(
        (folder_of(source), folder_of(target))
        for source, target in imports.edges
        if source.count(".") and target.count(".") and folder_of(source) != folder_of(target)
    )
    graph.add_weighted_edges_from((source, target, count) for (source, target), count in pairs.items())
    return graph


def draw(graph: networkx.DiGraph, sizes: Mapping[str, int], path: Path) -> None:
    """Folders on the floor above all that they import; imports within a circle of folders in red."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    order = networkx.condensation(graph)
    centre = {}
    floors = list(networkx.topological_generations(order.reverse()))
    for floor, circles in enumerate(floors):
        names = sorted(
            (name for circle in circles for name in order.nodes[circle]["members"]), key=lambda n: -sizes[n]
        )
        centre |= {name: ((place - (len(names) - 1) / 2) * 2.6, 1.4 * floor) for place, name in enumerate(names)}
    circle_of = order.graph["mapping"]
    figure, axes = plt.subplots(figsize=(11, 0.9 * len(floors) + 1))
    for source, target in graph.edges:
        circular = circle_of[source] == circle_of[target]
        axes.annotate(
            "",
            centre[target],
            centre[source],
            arrowprops={
                "arrowstyle": "-|>",
                "color": "#c0392b" if circular else "#9aa5b1",
                "lw": 1.4 if circular else 0.7,
                "shrinkA": 14,
                "shrinkB": 14,
                "connectionstyle": "arc3,rad=0.06",
            },
        )
    for name, (x, y) in centre.items():
        text = f"{name}\n{sizes[name]:,} lines"
        axes.text(x, y, text, ha="center", va="center", fontsize=8, bbox={"boxstyle": "round", "fc": "#e8f3f1"})
    axes.set_xlim(min(x for x, _ in centre.values()) - 1.5, max(x for x, _ in centre.values()) + 1.5)
    axes.set_ylim(-0.8, max(y for _, y in centre.values()) + 0.8)
    axes.axis("off")
    figure.savefig(path, dpi=130, bbox_inches="tight")
    plt.close(figure)


if __name__ == "__main__":
    tyro.cli(Structure).main()
