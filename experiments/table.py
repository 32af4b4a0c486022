"""Prints the results in experiments/results/<experiment>/ as a Markdown table.

python experiments/table.py reach
"""

import json
import pathlib
import sys


def row(result: dict) -> str:
    """One result file as a line of the table."""
    low, high = result["wilson95"]
    floors = result["baselines"]
    cells = [
        result["method"],
        result["preset"],
        str(result["seed"]),
        f"{result['success']:.1%} ({low:.1%} to {high:.1%})",
        str(result["trials"]),
        *(f"{floors[name]:.1%}" for name in ("random", "task_blind", "expert")),
        f"{result['wall_clock_s']['total']:.0f} s",
        result["hardware"].split(",")[0],
    ]
    return f"| {' | '.join(cells)} |"


def main(experiment: str) -> None:
    """Prints the table."""
    folder = pathlib.Path(__file__).parent / "results" / experiment
    print("| method | preset | seed | success (95%) | trials | random | task-blind | expert | from nothing | on |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for path in sorted(folder.glob("*.json")):
        print(row(json.loads(path.read_text())))


if __name__ == "__main__":
    main(sys.argv[1])
