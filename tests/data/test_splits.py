"""Splits of tasks: by fractions, by families, and by name."""

import json

import numpy as np
import pytest

from milx.data import episodes
from milx.data.dataset import DataSet
from milx.data.episodes import Contents, Episode
from milx.data.splits import assign_splits, by_family, choose, families_of, read_patterns
from milx.types import Demo


def test_some_task_always_trains():
    for count in range(3, 9):
        for validation in (0.1, 0.3, 0.4, 0.49):
            splits = list(assign_splits([f"task {i}" for i in range(count)], validation, 0.5).values())
            assert {"train", "validation", "test"} == set(splits), (count, validation)


def test_splits_depend_on_names_alone_and_have_their_sizes():
    names = [f"task {i}" for i in range(50)]
    first, again = assign_splits(names, 0.1, 0.2), assign_splits(names[::-1], 0.1, 0.2)
    assert first == again
    counts = {split: list(first.values()).count(split) for split in ("train", "validation", "test")}
    assert counts == {"train": 35, "validation": 5, "test": 10}
    assert list(first.values()) != sorted(first.values())
    for parts, message in (((-0.1, 0.1), "validation: got -0.1"), ((0.5, 0.5), r"validation \+ test: got 1.0")):
        with pytest.raises(ValueError, match=message):
            assign_splits(names, *parts)


def test_every_family_is_split_by_itself():
    sizes = {"door": 20, "drawer": 10, "tap": 2}
    families = {f"{family}/{i}": family for family, size in sizes.items() for i in range(size)}
    split = by_family(families, 0.1, 0.2)
    count = lambda family, part: sum(split[name] == part for name in families if families[name] == family)  # noqa: E731
    assert [count("door", part) for part in ("train", "validation", "test")] == [14, 2, 4]
    assert [count("drawer", part) for part in ("train", "validation", "test")] == [7, 1, 2]
    assert [count("tap", part) for part in ("train", "validation", "test")] == [2, 0, 0], "too small to be split"
    for family in ("door", "drawer"):
        alone = [name for name in families if families[name] == family]
        assert {name: split[name] for name in alone} == assign_splits(alone, 0.1, 0.2)


def test_families_that_are_all_too_small_are_split_together():
    families = {f"task {i}": f"family {i}" for i in range(30)}
    assert by_family(families, 0.1, 0.2) == assign_splits(list(families), 0.1, 0.2)


def test_splits_can_be_chosen_by_patterns():
    names = ["door/1", "door/2", "drawer/1", "drawer/2", "tap/1"]
    assert choose(names, {"validation": ["door/2"], "test": ["drawer/*"]}) == dict(
        zip(names, ["train", "validation", "test", "test", "train"], strict=True)
    )
    for patterns, message in (
        ({"test": ["window/*"]}, "splits: test: got 'window/\\*', expected a pattern that some task's name matches"),
        ({"test": ["door/*"], "validation": ["*/1"]}, "splits: 'door/1' is in test and validation, expected one"),
        ({"test": ["*"]}, "splits: all tasks are held out, expected at least one that trains"),
    ):
        with pytest.raises(ValueError, match=message):
            choose(names, patterns)


def test_an_import_keeps_families_and_chosen_splits(tmp_path):
    demo = Demo(state=np.zeros((5, 2), np.float32), action=np.ones((5, 2), np.float32))
    tasks = ("door/1", "door/2", "tap/1", "tap/2")
    found = [Episode("", name, 5, True, lambda: demo) for name in tasks for _ in range(2)]
    names = {episode.task for episode in found}
    (tmp_path / "families.json").write_text(json.dumps({name: name[:2] for name in names}))
    (tmp_path / "splits.json").write_text(json.dumps({"validation": ["tap/1"], "test": ["door/2"]}))
    for number, (rule, expected) in enumerate((("prefix", "door"), (str(tmp_path / "families.json"), "do"), ("", ""))):
        families, chosen = families_of(names, rule), read_patterns(tmp_path / "splits.json")
        out = tmp_path / str(number)
        episodes.write(out, found, Contents(None, 2, 2), (0.1, 0.1), "a test", families, chosen)
        tasks = DataSet(out).header.tasks
        assert [(task.name, task.split) for task in tasks] == [
            ("door/1", "train"),
            ("door/2", "test"),
            ("tap/1", "validation"),
            ("tap/2", "train"),
        ]
        assert tasks[0].family == expected
    assert len({DataSet(tmp_path / str(i)).fingerprint() for i in range(2)}) == 1, "nothing is learned from families"
    (tmp_path / "families.json").write_text(json.dumps({"door/1": "door"}))
    with pytest.raises(ValueError, match=r"family: .* does not say where '.*' belongs, expected all names in it"):
        families_of(names, str(tmp_path / "families.json"))
    for text in ("[]", '{"train": []}', '{"test": "door/*"}', '{"test": [1]}', "{"):
        (tmp_path / "splits.json").write_text(text)
        with pytest.raises(ValueError, match=r"splits: .*expected a JSON"):
            read_patterns(tmp_path / "splits.json")
