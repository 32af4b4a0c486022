"""The check of a data set says what will go wrong, and nothing where all is well."""

import dataclasses
import io

import numpy as np
import pytest
from rich.console import Console

from milx.data import check
from milx.data.dataset import DataSet, Writer
from milx.data.splits import assign_splits
from milx.types import Demo

RNG = np.random.default_rng(0)


def good(length=10):
    image = RNG.integers(0, 256, (length, 8, 8, 3), np.uint8)
    return Demo(image, RNG.normal(size=(length, 2)), RNG.normal(size=(length, 2)))


def write(folder, tasks, image_shape=(8, 8)):
    with Writer(folder, image_shape, 2, 2, "a test") as writer:
        for i, (split, demos) in enumerate(tasks):
            writer.add(f"task {i}", split, [len(demo.state) for demo in demos], demos)
    return DataSet(folder)


def few():
    return [("train", [good(), good()]), ("validation", [good(), good()]), ("test", [good(), good()])]


def well():
    return few() + [("train", [good(), good()])] * (check.FEW_TASKS - 1)


def with_column(demo, field, column, value):
    array = getattr(demo, field).copy()
    array[:, column] = value
    return dataclasses.replace(demo, **{field: array})


def test_nothing_is_wrong_with_a_good_set(tmp_path):
    assert check.problems(write(tmp_path / "set", well())) == []


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda tasks: tasks.pop(2), "no test tasks: training refuses this data set"),
        (lambda tasks: tasks.pop(), "19 training tasks: with fewer than about 20"),
        (
            lambda tasks: tasks[1][1].pop(),
            "no validation task with two demonstrations that show actions: training refuses this",
        ),
        (
            lambda tasks: tasks[1][1].__setitem__(0, dataclasses.replace(good(), action=None)),
            "no validation task with two demonstrations that show actions: training refuses this unless method.given "
            "is video+state or video",
        ),
        (lambda tasks: tasks[0][1].pop(), "task 'task 0' has 1 demonstration: one more must be the query"),
        (
            lambda tasks: tasks.__setitem__(0, ("train", [dataclasses.replace(d, action=None) for d in tasks[0][1]])),
            "task 'task 0' shows no actions: it cannot be learned from",
        ),
        (lambda tasks: tasks[1][1].append(good(31)), "lengths from 10 to 31 steps"),
        (
            lambda tasks: tasks[2][1].append(with_column(good(), "state", 1, np.nan)),
            "state[1] is nan in demonstration 2 of task 'task 2', time step 0: training refuses this",
        ),
        (
            lambda tasks: [
                demos.__setitem__(i, with_column(d, "action", 0, 4.0))
                for _, demos in tasks
                for i, d in enumerate(demos)
            ],
            "action[0] is constant: it says nothing",
        ),
        (
            lambda tasks: [
                demos.__setitem__(i, with_column(d, "action", 0, np.arange(len(d.action)) % 2))
                for _, demos in tasks
                for i, d in enumerate(demos)
            ],
            "action[0] takes two values: import it with --classes=0",
        ),
        (
            lambda tasks: tasks[0][1].__setitem__(
                0, dataclasses.replace(good(), image=np.full((10, 8, 8, 3), 7, np.uint8))
            ),
            "task 'task 0': the first image is of one color",
        ),
    ],
)
def test_what_will_go_wrong_is_said(tmp_path, change, problem):
    tasks = well()
    change(tasks)
    found = check.problems(write(tmp_path / "set", tasks))
    assert found[0].startswith(problem), found
    # A task that lacks a demonstration is told beside what that means for its split.
    assert len(found) == (2 if problem.endswith("show actions: training refuses this") else 1)


def test_the_description_counts_and_measures(tmp_path):
    data = write(tmp_path / "set", [*few(), ("train", [good(12)] * 3)])
    console = Console(record=True, width=150, file=io.StringIO())
    check.describe(data, console)
    text = console.export_text()
    assert "4 tasks, 9 demonstrations, from a test" in text
    assert "image 8 x 8; 10 to 12 steps" in text
    assert "train: 2 tasks: task 0, task 3" in text
    column = check.vectors(data)["action"][:, 1]
    row = next(line for line in text.splitlines() if "action[1]" in line)
    numbers = [float(cell) for cell in row.replace("│", " ").split()[1:]]
    np.testing.assert_allclose(numbers, [column.min(), column.mean(), column.max(), column.std()], rtol=1e-3)


def test_names_of_tasks_are_shown_as_they_are(tmp_path, capsys):
    """Shows brackets, which Rich would take for its own."""
    with Writer(tmp_path / "set", (8, 8), 2, 2) as writer:
        for name, split in (("pick [the] cup", "train"), ("[/]", "test")):
            writer.add(name, split, [10], [good()])
    check.main(["check", str(tmp_path / "set")])
    said = capsys.readouterr().out
    assert "train: 1 tasks: pick [the] cup" in said
    assert "task '[/]' has 1 demonstration" in " ".join(said.split())


def test_families_are_counted_and_one_alone_is_reported(tmp_path):
    with Writer(tmp_path / "set", (8, 8), 2, 2, "a test") as writer:
        splits = ["train", "train", "validation", "test", "test"]
        for i, (split, family) in enumerate(zip(splits, ["door", "drawer", "door", "door", "drawer"], strict=True)):
            writer.add(f"task {i}", split, [10, 10], [good(), good()], family)
    data, out = DataSet(tmp_path / "set"), io.StringIO()
    assert check.problems(data)[1:] == ["all validation tasks are of the family 'door': they say nothing of the others"]
    check.describe(data, Console(file=out, width=200))
    assert "families: door (3), drawer (2)" in out.getvalue()


def test_one_sentence_for_a_skill_is_questioned(tmp_path):
    """Says of which entries it speaks by their names, too."""
    names = {"state_names": ["x", "y"], "action_names": ["dx", "grip"], "fps": 30}
    with Writer(tmp_path / "set", None, 2, 2, **names) as writer:
        for split, name in (("train", "lift"), ("validation", "push"), ("test", "pull")):
            demos = [with_column(good(), "action", 1, 1.0)] * 2
            writer.add(name, split, [10, 10], [dataclasses.replace(x, image=None) for x in demos], "", [name] * 2)
    data, out = DataSet(tmp_path / "set"), io.StringIO()
    found = check.problems(data)
    assert found[1].startswith("every task is one sentence")
    assert found[-1] == "action[1] (grip) is constant: it says nothing"
    check.describe(data, Console(file=out, width=200))
    assert "half of them at most 10, 30 a second" in out.getvalue()
    assert "state[1] (y)" in out.getvalue()


def test_names_cannot_speak_to_the_terminal(tmp_path):
    """Names a task and a source with escape sequences and half a character: they are shown escaped."""
    name = "\x1b[31mred\x1b]0;title\x07 \ud800 caf\u00e9"
    with Writer(tmp_path / "set", (8, 8), 2, 2, name) as writer:
        for split, demos in few():
            writer.add(name + split, split, [len(demo.state) for demo in demos], demos)
    out = io.StringIO()
    check.describe(DataSet(tmp_path / "set"), Console(file=out, width=200, markup=False))
    assert "\\x1b[31mred\\x1b]0;title\\x07 \\ud800 caf\u00e9" in out.getvalue()
    assert not {"\x1b", "\x07", "\ud800"} & set(out.getvalue())
    assert set(assign_splits([name, "a", "b"], 0.3, 0.3).values()) == {"train", "validation", "test"}
