"""Writes the tables of README and docs/results/ from the result files, between <!-- NAME --> and <!-- end -->.

python experiments/paper/pages.py    # after new results; a test says when it has been forgotten
"""

import pathlib
import re
import statistics
import sys
from collections.abc import Callable
from typing import Any

import ablations
import cells
import figure3
import grasp
import published
import published_rows
import table
import table1
import table2
import table3
import tables
from absl import app

ROOT = pathlib.Path(__file__).parents[2]
RESULTS = ROOT / "experiments" / "results"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "results").glob("*.md"))]
sys.path[:0] = [str(ROOT / "experiments" / folder) for folder in ("benchmarks", "metaworld")]
import board  # noqa: E402
import summary  # noqa: E402


def headline() -> str:
    """Writes one row for each environment and method, of all seeds."""
    fast, of_push, of_place = (cells.read(RESULTS / name) for name in ("reach", "table1", "table3"))
    of_paper = cells.read(published.RESULTS)
    rows = {
        "reach, MIL": (_named(of_paper, "reach-1"), "a curve"),
        "reach, MIL + goal head": (_named(fast, "mil-fast"), "a curve"),
        "push, MIL": (_named(of_paper, "push-two-heads-1"), "85.8%"),
        "push, MIL + goal head": (_named(of_push, "mil-video-state-action-1"), "80.6%"),
        "place, MIL": (_named(of_paper, "place-1"), "90%"),
        "place, MIL + goal head": (_named(of_place, "mil-1"), "90%"),
    }
    lines = ["| | success (95%; seeds) | random | task-blind | expert | paper |", "|---|---|---|---|---|---|"]
    for label, (runs, paper) in rows.items():
        baselines = [
            f"{statistics.mean(run['baselines'][name] for run in runs):.1%}"
            for name in ("random", "task_blind", "expert")
        ]
        lines.append(f"| {label} | {tables.interval(runs)} | {' | '.join(baselines)} | {paper} |")
    return "\n".join(lines)


def _named(found: dict[str, dict[str, Any]], name: str) -> list[dict[str, Any]]:
    return [run for cell, run in found.items() if re.fullmatch(rf"{name}-(seed)?\d", cell)]


def _paper_table(which: tables.Table) -> str:
    """Writes a table by the first of its criteria."""
    return tables.markdown(which, list(which.rows), cells.read(RESULTS / which.folder)).split("\n\n")[0]


def _published(beginning: str, name: str = "results") -> str:
    """Writes the rows of a table of the method as published whose names begin so."""
    rows = {row: changes for row, changes in published.TABLES[name].items() if row.startswith(beginning)}
    return published.markdown(rows, cells.read(published.RESULTS) | cells.read(RESULTS / f"paper_{name}"))


def _grasp() -> str:
    """Writes the rows of grasp as those of the method as published, with another task's demonstration."""
    rows = {name: published_rows.Row(row.label, "grasp", row.changes) for name, row in grasp.TABLE.rows.items()}
    return published.markdown(rows, cells.read(RESULTS / grasp.TABLE.folder))


TABLES: dict[str, Callable[[], str]] = {
    "headline": headline,
    "reach": lambda: table.markdown(RESULTS / "reach"),
    "push": lambda: table.markdown(RESULTS / "push"),
    "place": lambda: table.markdown(RESULTS / "place"),
    "grasp": _grasp,
    "table1": lambda: _paper_table(table1.TABLE),
    "table2": lambda: _paper_table(table2.TABLE),
    "table3": lambda: _paper_table(table3.TABLE),
    "published": lambda: _published(""),
    "published-small": lambda: _published("", "small"),
    "published-reach": lambda: _published("reach"),
    "published-push": lambda: _published("push"),
    "published-plateau": lambda: _published("", "plateau"),
    "published-baselines": lambda: _published("", "baselines"),
    "published-ladder": lambda: _published("", "ladder"),
    "published-relatives": lambda: _published("", "relatives"),
    "published-experts": lambda: _published("", "experts"),
    "figure3": lambda: figure3.markdown(list(cells.read(RESULTS / "figure3").values())),
    "figure3-paper": lambda: figure3.markdown(list(cells.read(RESULTS / "figure3_paper").values())),
    "figure3-push": lambda: figure3.markdown(list(cells.read(RESULTS / "figure3_push").values())),
    "ablations": lambda: ablations.markdown(cells.read(RESULTS / "ablations"), list(ablations.ABLATIONS), seeds=2),
    "meta-world": lambda: board.markdown(board.read()),
    "meta-world-unseen": lambda: board.markdown(board.read("unseen:make")),
    "benchmarks": lambda: summary.table(list(cells.read(RESULTS / "benchmarks").values())),
    "benchmarks-origins": lambda: summary.origins(list(cells.read(RESULTS / "benchmarks").values())),
}
"""What makes the table of each name."""


def filled(text: str) -> str:
    """Fills a page's tables from the result files."""
    return re.sub(r"<!-- ([\w-]+) -->\n.*?<!-- end -->", lambda found: f"{_marked(found[1])}", text, flags=re.DOTALL)


def _marked(name: str) -> str:
    return f"<!-- {name} -->\n{TABLES[name]()}\n<!-- end -->"


def main(_: list[str]) -> None:
    """Rewrites the pages."""
    for page in PAGES:
        before = page.read_text()
        after = filled(before)
        if after != before:
            page.write_text(after)
            print(page.relative_to(ROOT))


if __name__ == "__main__":
    app.run(main)
