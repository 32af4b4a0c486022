"""Prints the results in experiments/results/<experiment>/ as a Markdown table, with the mean over seeds.

python experiments/table.py reach
"""

import collections
import json
import pathlib
import statistics
import sys


def row(result: dict) -> str:
    """One result file as a line of the table."""
    low, high = result["wilson95"]
    floors = result["baselines"]
    cells = [
        result["method"],
        " ".join(filter(None, [result["preset"], result["variant"]])),
        str(result["seed"]),
        f"{result['success']:.1%} ({low:.1%} to {high:.1%})",
        str(result["trials"]),
        *(f"{floors[name]:.1%}" for name in ("random", "task_blind", "expert")),
        f"{result['wall_clock_s']['total']:.0f} s",
        result["hardware"],
    ]
    return f"| {' | '.join(cells)} |"


def mean(group: list[dict]) -> str:
    """The mean over the seeds of one setting as a line of the table."""
    success = statistics.mean(result["success"] for result in group)
    seconds = statistics.mean(result["wall_clock_s"]["total"] for result in group)
    trials = sum(result["trials"] for result in group)
    name = " ".join(filter(None, [group[0]["preset"], group[0]["variant"]]))
    cells = [group[0]["method"], name, f"mean of {len(group)}", f"**{success:.1%}**", str(trials), "", "", ""]
    return f"| {' | '.join([*cells, f'{seconds:.0f} s', ''])} |"


def main(experiment: str) -> None:
    """Prints the table."""
    folder = pathlib.Path(__file__).parent / "results" / experiment
    groups = collections.defaultdict(list)
    for path in sorted(folder.glob("*.json")):
        result = json.loads(path.read_text())
        groups[result["method"], result["preset"], result["variant"]].append(result)
    print("| method | preset | seed | success (95%) | trials | random | task-blind | expert | from nothing | on |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for group in groups.values():
        print("\n".join(row(result) for result in group))
        if len(group) > 1:
            print(mean(group))


if __name__ == "__main__":
    main(sys.argv[1])
