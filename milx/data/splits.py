"""Which tasks train, validate and test: by fractions of all tasks or of every family, or by name."""

import fnmatch
import hashlib
import pathlib
from collections.abc import Iterable, Mapping

from milx.data.mapping import lookup, read_mapping, read_named

PREFIX = "prefix"
"""The rule by which a task's family is the part of its name before the first "/"."""


def assign_splits(names: list[str], validation: float, test: float) -> dict[str, str]:
    """Assigns a split to every task, in an order that depends on nothing but the names; at least one trains.

    Raises:
        ValueError: unless the fractions are at least 0 and leave something for training.
    """
    for field, part in (("validation", validation), ("test", test)):
        if not 0 <= part < 1:
            raise ValueError(f"{field}: got {part}, expected a fraction of the tasks, at least 0 and less than 1")
    if validation + test >= 1:
        raise ValueError(f"validation + test: got {validation + test}, expected less than 1: the rest is for training")
    if (needed := 1 + (validation > 0) + (test > 0)) > len(names):
        raise ValueError(f"tasks: got {len(names)}, expected at least {needed}: one for each split")
    shuffled = sorted(names, key=lambda name: hashlib.sha256(name.encode(errors="surrogatepass")).digest())
    second = min(max(round((validation + test) * len(names)), needed - 1), len(names) - 1)
    first = min(max(round(validation * len(names)), validation > 0), second - (test > 0))
    of = lambda i: "validation" if i < first else "test" if i < second else "train"  # noqa: E731
    return {name: of(i) for i, name in enumerate(shuffled)}


def by_family(families: Mapping[str, str], validation: float, test: float) -> dict[str, str]:
    """Assigns a split to every task, as `assign_splits` does in every family by itself.

    So a family holds out at least one task for validation and one for the test, if these are wanted. The tasks of a
    family that is too small for that all train; if every family is, the tasks are split without regard to families.

    Args:
        families: by the names of tasks.
        validation: the fraction of the tasks that becomes validation tasks.
        test: the fraction that becomes test tasks.

    Raises:
        ValueError: as `assign_splits`.
    """
    whole = assign_splits(list(families), validation, test)
    groups = [[name for name in families if families[name] == family] for family in sorted(set(families.values()))]
    enough = 1 + (validation > 0) + (test > 0)
    split = dict.fromkeys(families, "train")
    for group in groups:
        if len(group) >= enough:
            split |= assign_splits(group, validation, test)
    return split if any(len(group) >= enough for group in groups) else whole


def choose(names: list[str], patterns: Mapping[str, list[str]]) -> dict[str, str]:
    """Assigns "validation" and "test" to the tasks whose names match, and "train" to all others.

    Args:
        names: of the tasks.
        patterns: names, or patterns with "*", "?" and "[...]", by split.

    Raises:
        ValueError: for a pattern that no name matches, a task in two splits, or if no task is left to train.
    """
    split = dict.fromkeys(names, "train")
    for part, wanted in patterns.items():
        for pattern in wanted:
            found = [name for name in names if name == pattern or fnmatch.fnmatchcase(name, pattern)]
            if not found:
                raise ValueError(f"splits: {part}: got {pattern!r}, expected a pattern that some task's name matches")
            for name in found:
                if split[name] not in ("train", part):
                    raise ValueError(f"splits: {name!r} is in {split[name]} and {part}, expected one of them")
                split[name] = part
    if "train" not in split.values():
        raise ValueError("splits: all tasks are held out, expected at least one that trains")
    return split


def read_patterns(path: str | pathlib.Path) -> dict[str, list[str]]:
    """Reads the patterns of `choose` from a JSON file.

    Raises:
        ValueError: for a file that holds something else.
    """
    patterns = read_named(path, "splits")
    good = isinstance(patterns, dict) and set(patterns) <= {"validation", "test"}
    if not good or not all(
        isinstance(names, list) and all(isinstance(n, str) for n in names) for names in patterns.values()
    ):
        raise ValueError(f'splits: {path}: expected a JSON object with lists of names, "validation" and "test"')
    return patterns


def families_of(names: Iterable[str], rule: str) -> dict[str, str]:
    """Finds the families of tasks.

    Args:
        names: of the tasks.
        rule: PREFIX, the path of a JSON file that maps names to families, or "" for no families.

    Raises:
        ValueError: for a file that holds something else, or that lacks a task.
    """
    if not rule:
        return dict.fromkeys(names, "")
    if rule == PREFIX:
        return {name: name.partition("/")[0] for name in names}
    mapping = read_mapping(rule, "family")
    return {name: lookup(mapping, name, rule, "family") for name in names}
