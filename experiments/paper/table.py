"""Prints the results in experiments/results/<experiment>/ as a Markdown table, with the mean over runs.

python experiments/paper/table.py reach
"""

import collections
import json
import pathlib
import statistics
import sys

LABELS = {"mil": "MIL", "lstm": "LSTM", "lstm_attention": "LSTM with attention"}


def method(result: dict) -> str:
    """Names what was trained, and whether with milx's goal head, which attention does not have."""
    name = result["method"]
    has_goal_head = name != "lstm_attention" and result["config"]["network"]["goal_head"]
    return LABELS.get(name, name) + (" + goal head" if has_goal_head else "")


def setting(result: dict) -> str:
    """Names the preset, and what was changed in it."""
    return f"{result['preset']} {result['variant']}".strip()


def row(result: dict) -> str:
    """Writes one result file as a line of the table."""
    low, high = result["wilson95"]
    baselines = result["baselines"]
    cells = [
        method(result),
        setting(result),
        str(result["seed"]),
        f"{result['success']:.1%} ({low:.1%} to {high:.1%})",
        str(result["trials"]),
        *(f"{baselines[name]:.1%}" for name in ("random", "task_blind", "expert")),
        f"{result['wall_clock_s']['total']:.0f} s",
        result["hardware"],
    ]
    return f"| {' | '.join(cells)} |"


def mean(group: list[dict]) -> str:
    """Writes the mean over the runs of one setting as a line of the table."""
    successes = [result["success"] for result in group]
    baselines = [statistics.mean(r["baselines"][name] for r in group) for name in ("random", "task_blind", "expert")]
    cells = [
        method(group[0]),
        setting(group[0]),
        f"mean of {len(group)}, range",
        f"**{statistics.mean(successes):.1%}** ({min(successes):.1%} to {max(successes):.1%})",
        str(sum(result["trials"] for result in group)),
        *(f"{baseline:.1%}" for baseline in baselines),
        f"{statistics.mean(result['wall_clock_s']['total'] for result in group):.0f} s",
        "",
    ]
    return f"| {' | '.join(cells)} |"


def markdown(folder: pathlib.Path) -> str:
    """Writes all results of a folder, and the mean of each setting's seeds."""
    groups = collections.defaultdict(list)
    for path in sorted(folder.glob("*.json")):
        result = json.loads(path.read_text())
        groups[result["method"], result["preset"], result["variant"]].append(result)
    lines = ["| method | preset | seed | success (95%) | trials | random | task-blind | expert | from nothing | on |"]
    lines.append("|---|---|---|---|---|---|---|---|---|---|")
    for group in groups.values():
        lines += [row(result) for result in group]
        if len(group) > 1:
            lines.append(mean(group))
    return "\n".join(lines)


if __name__ == "__main__":
    print(markdown(pathlib.Path(__file__).parents[1] / "results" / sys.argv[1]))
