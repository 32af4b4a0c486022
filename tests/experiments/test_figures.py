"""What figures and tables make of result files."""

import dataclasses
import json
import pathlib
import re
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "experiments" / "paper"))
import cells
import figure3
import grasp
import pages
import published
import published_rows
import table1
import table2
import table3
import tables

from milx import envs, methods
from milx.config import assemble
from milx.config.assemble import make_config
from milx.training import state


def result(size, success, low, high, method="mil"):
    return {"env": "reach", "method": method, "num_demos_train": size, "success": success, "wilson95": [low, high]}


def test_a_point_is_the_mean_of_its_seeds_within_all_their_intervals():
    results = [result(500, 0.8, 0.7, 0.85), result(100, 0.4, 0.3, 0.5), result(500, 0.6, 0.55, 0.66)]
    curves = figure3.points([*results, result(500, 0.1, 0.0, 0.2, "lstm")])
    assert list(curves["reach", "mil"]) == [100, 500]
    assert curves["reach", "mil"][500] == pytest.approx((0.7, 0.55, 0.85, 2))
    assert curves["reach", "lstm"][500] == pytest.approx((0.1, 0.0, 0.2, 1))


@pytest.mark.parametrize(
    "table", [each.TABLE for each in (table1, table2, table3, grasp)], ids=lambda each: each.folder
)
def test_rows_are_trained_once_for_all_shots_and_each_on_its_own(table, tmp_path, flags):
    spec, runner, programs = envs.make(table.env, (48, 48)).spec, cells.Cells(tmp_path, 1), set()
    for row in table.rows.values():
        of_shots = [tables.configure(table.env, row, shots, seed=0) for shots in table.shots]
        methods.make(of_shots[0], spec)  # refuses what does not fit together
        assert len({runner._programs(config) for config in of_shots}) == 1
        assert tuple(config.evaluation.shots for config in of_shots) == table.shots
        programs.add((runner._programs(of_shots[0]), of_shots[0].data.tasks))
    assert len(programs) == len(table.rows)


def test_an_unknown_row_is_refused(flags):
    flags.rows = ["two-haeds"]
    with pytest.raises(ValueError, match="rows: got 'two-haeds', expected some of mil-video-state-action, two-heads"):
        tables.make(table2.TABLE)


def test_a_table_shows_means_intervals_floors_and_every_criterion(flags):
    def run(success, low, high, near):
        floors = {"random": 0.1, "task_blind": 0.25, "expert": 0.9}
        other = {"success": near, "wilson95": [near - 0.1, near + 0.1], "baselines": floors | {"random": 0.3}}
        mine = {"success": success, "wilson95": [low, high], "baselines": floors, "trials": 50}
        return mine | {"criterion": "on it", "other_criteria": {"near it": other}}

    rows = {name: tables.Row(name.capitalize(), "mil", {}, "80%") for name in ("one", "two")}
    found = {"one-1-0": run(0.5, 0.4, 0.6, 0.7), "one-1-1": run(0.7, 0.65, 0.75, 0.8), "two-5-0": run(0.1, 0, 1, 0)}
    lines = tables.markdown(tables.Table("folder", "push", rows, (1,)), ["one", "two"], found).splitlines()
    assert lines[0] == "| on it | 1-shot | paper |"
    assert lines[2] == "| One | 60.0% (40.0% to 75.0%; 2) | 80% |"
    assert lines[3:6] == ["| *random* | 10.0% | |", "| *task-blind* | 25.0% | |", "| *expert* | 90.0% | |"], "no Two"
    assert lines[7] == "| near it | 1-shot | paper |"
    assert lines[9:11] == ["| One | 75.0% (60.0% to 90.0%; 2) | 80% |", "| *random* | 30.0% | |"]
    assert lines[-1].startswith("50 trials for each seed")


def test_pages_show_what_the_result_files_hold(flags):
    marked = [
        name for page in pages.PAGES for name in re.findall("<!-- ([^ ]+) -->", page.read_text()) if name != "end"
    ]
    assert sorted(marked) == sorted(pages.TABLES)
    for page in pages.PAGES:
        assert pages.filled(page.read_text()) == page.read_text(), f"{page}: run experiments/paper/pages.py"


@pytest.fixture
def flags():
    """Parses the scripts' flags, and undoes what a test sets."""
    from absl import flags

    saved = flags.FLAGS
    saved(["test"])
    yield saved
    saved.unparse_flags()
    saved.rows = None


PAPER = [(name, row) for rows in published_rows.TABLES.values() for name, row in rows.items()]


@pytest.mark.parametrize(("name", "row"), PAPER, ids=[name for name, _ in PAPER])
def test_rows_of_the_published_method_fit_together_and_have_no_addition_unless_they_say_so(name, row):
    config = published_rows.configure(row, row.shots[0], seed=0)
    methods.make(config, envs.make(row.env, (48, 48)).spec)
    state.check_steps(config)
    additions = config.network.goal_head, config.train.redraw, getattr(config.method, "learn_inner_lr", False)
    may = [*published_rows.TABLES["ladder"].values(), *published_rows.TABLES["experts"].values()]
    assert not any(additions) or row in may


@pytest.mark.parametrize("env", ["reach", "push"])
def test_the_ladder_ends_with_fast(env):
    last = [row for name, row in published_rows.TABLES["ladder"].items() if row.env == env][-1]
    config = dataclasses.replace(published_rows.configure(last, 1, seed=0), preset="fast")
    assert config == make_config(env, preset="fast", seed=0)


def test_two_heads_by_an_expert_that_has_learned_are_the_preset_paper():
    row = published_rows.TABLES["experts"]["push-two-heads-learned"]
    assert published_rows.configure(row, 1, seed=0) == make_config("push", preset="paper", seed=0)


def test_demonstrations_by_sampling_are_all_that_their_row_changes():
    row, fast = published_rows.TABLES["experts"]["push-sampling-beginning"], make_config("push", preset="fast")
    config = dataclasses.replace(published_rows.configure(row, 1, seed=0), preset="fast")
    evaluation = dataclasses.replace(fast.evaluation, baseline_trials=1)
    assert config == dataclasses.replace(fast, data=config.data, evaluation=evaluation)
    planned = {"expert": "sampling", "plan_iterations": 8, "plan_batch": 512}
    assert config.data == dataclasses.replace(fast.data, **planned)


@pytest.mark.parametrize("table", ["ladder", "relatives"])
def test_a_table_trains_all_of_its_rows_but_those_that_are_results(table):
    rows = published_rows.TABLES[table]
    trained = published.own(table, rows)
    assert [name for name in rows if name not in trained] == ["reach", "push"]
    assert all(rows[name] == published_rows.TABLES["results"][name] for name in ("reach", "push"))
    assert published.own("results", published_rows.TABLES["results"]) == published_rows.TABLES["results"]


def test_intervals_of_one_table_are_of_one_kind():
    over_things = result(500, 0.8, 0.7, 0.85) | {"bootstrap95": [0.6, 0.9]}
    assert tables.interval([over_things, over_things]) == "80.0% (60.0% to 90.0%; 2)"
    assert tables.interval([over_things, result(500, 0.6, 0.5, 0.7)]) == "70.0% (50.0% to 85.0%; 2)"


def test_push_is_configured_as_when_its_controller_demonstrated():
    """In what its presets have for the demonstrations of another expert since then."""

    def of_expert(config):
        return config.data.expert, config.data.plan_iterations, config.env.goal_step, config.train.frame_exponent

    root = pathlib.Path(__file__).parents[2] / "experiments" / "results"
    paths = [path for folder in ("table1", "figure3_push", "tuning") for path in (root / folder).glob("*.json")]
    found = [assemble.from_dict(json.loads(path.read_text())["config"]) for path in paths]
    found = [config for config in found if config.env_name == "push"]
    assert len(found) == 67
    for config in found:
        now = cells.configure("push", config.method_name, config.preset, config.seed, config.train.steps)
        assert of_expert(now) == of_expert(config)


def test_results_of_the_published_method_are_of_their_rows():
    root = pathlib.Path(__file__).parents[2]
    for table_name, rows in published_rows.TABLES.items():
        folder = root / "experiments" / "results" / f"paper_{table_name}"
        for name, row in rows.items():
            for path in folder.glob(f"{name}-[0-9]-[0-9].json"):
                shots, seed = (int(part) for part in path.stem.split("-")[-2:])
                assert cells.Cells(folder, 1).is_done(path.stem, published_rows.configure(row, shots, seed))
