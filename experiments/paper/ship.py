"""Puts a run's policy among those that ship with milx: python experiments/paper/ship.py runs/push-mil-fast-0 push.

Its test then prints the actions that belong into tests/fixtures/actions.json.
"""

import json
import pathlib
import sys

import milx
from milx.deploy import policy, pretrained


def main(run: str, name: str) -> None:
    """Copies the run's best parameters and its result."""
    milx.configure()
    result = json.loads((pathlib.Path(run) / "evaluation.json").read_text())
    pretrained.save(policy.load_run(run), result, pretrained.FOLDER / name)
    size = (pretrained.FOLDER / name / "params.npz").stat().st_size
    print(f"{name}: {result['success']:.1%}, {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(*sys.argv[1:])
