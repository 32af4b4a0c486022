"""Whatever comes in: it works, or a ValueError names the field, what came and what was expected.

Cases are drawn by Hypothesis; CASES says how many of each kind, 2,800 together.
"""

import dataclasses
import json
import pathlib
import re
import shutil

import h5py
import hypothesis.extra.numpy as arrays
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from absl import flags
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from milx.config import assemble
from milx.config.assemble import make_config
from milx.config.check import check_config
from milx.config.registry import PRESETS
from milx.config.schema import GIVEN
from milx.data import lerobot
from milx.data.dataset import DataSet, Writer
from milx.data.lerobot import LeRobot
from milx.data.robomimic import Robomimic
from milx.deploy.policy import check_demo, check_observation
from milx.training import command_line, recorded
from milx.types import Demo, Observation, Spec

CASES = {
    "demos": 700,
    "observations": 300,
    "configs": 500,
    "flags": 300,
    "headers": 400,
    "lerobot": 250,
    "parquet": 200,
    "robomimic": 150,
}
FIXTURES = pathlib.Path(__file__).parent / "fixtures"
SPEC = Spec((4, 5), 3, 2, ((-1.0, -2.0), (1.0, 2.0)), ())
"""Without goals, which JAX would compile for every length."""


def cases(name):
    quiet = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.filter_too_much]
    return settings(max_examples=CASES[name], deadline=10_000, suppress_health_check=quiet, derandomize=True)


def accepted(function):
    """Returns what the function does, or None where an error says what is wrong in the way that all do."""
    try:
        return function()
    except (ValueError, flags.Error) as error:
        text = str(error)
        if isinstance(error, (flags.UnrecognizedFlagError, flags.IllegalFlagValueError)):  # in absl's words
            assert re.search(r"flag '?[\w.-]+", text), text
        else:
            assert re.search(r"^[\w./ '\[\]:()-]+: ", text), text
            assert "expected" in text or "no such" in text, text
        assert len(text) < 5000
        return None


DTYPES = st.sampled_from([np.uint8, np.float32, np.float64, np.int64, np.bool_, np.complex64, "U3", "M8[s]", object])
SHAPES = st.one_of(
    st.sampled_from([(6, 4, 5, 3), (6, 3), (6, 2), (1, 6, 4, 5, 3), (1, 6, 3), (1, 6, 2), (6, 3, 4, 5), (1, 1, 3)]),
    arrays.array_shapes(min_dims=0, max_dims=6, min_side=0, max_side=7),
)
ARRAYS = st.one_of(
    st.none(),
    st.text(max_size=3),
    st.lists(st.lists(st.integers(), max_size=3), max_size=3),
    st.builds(lambda shape, dtype: np.zeros(shape, dtype), SHAPES, DTYPES),
    arrays.arrays(np.float32, st.sampled_from([(6, 3), (6, 2), (1, 6, 2)]), elements=st.floats(width=32)),
    st.just(np.broadcast_to(np.uint8(1), (10**6, 4, 5, 3))),
)


@st.composite
def almost_good_demos(draw):
    """Draws fitting arrays, but for one at most."""
    length = draw(st.sampled_from([1, 2, 6, 10**6]))
    fields = {"image": (np.uint8, (4, 5, 3)), "state": (np.float32, (3,)), "action": (np.float64, (2,))}
    arrays = {name: np.broadcast_to(dtype(1), (length, *shape)) for name, (dtype, shape) in fields.items()}
    changed = draw(st.sampled_from([None, None, *arrays]))
    if changed is not None:
        arrays[changed] = draw(ARRAYS)
    return Demo(**arrays)


@pytest.mark.slow
def test_demos():
    good = []

    @cases("demos")
    @given(st.one_of(st.builds(Demo, ARRAYS, ARRAYS, ARRAYS, st.none()), almost_good_demos()), st.sampled_from(GIVEN))
    def check(demo, shown):
        checked = accepted(lambda: check_demo(demo, SPEC, shown))
        if checked is None:
            return
        good.append(shown)
        length = checked.image.shape[1]
        assert checked.image.shape == (checked.image.shape[0], length, 4, 5, 3)
        assert checked.image.dtype == np.uint8
        for value, size in ((checked.state, 3), (checked.action, 2)):
            assert value is None or (value.shape[1:] == (length, size) and np.isfinite(value).all())
        assert checked.action is None or (np.abs(checked.action) <= [1, 2]).all()

    check()
    assert all(good.count(shown) > 3 for shown in GIVEN)


@pytest.mark.slow
@cases("observations")
@given(ARRAYS, ARRAYS)
def test_observations(image, state):
    checked = accepted(lambda: check_observation(Observation(image, state), SPEC))
    if checked is not None:
        assert checked.image.shape == (4, 5, 3)
        assert checked.state.shape == (3,)


JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-3, 10**12), st.floats(), st.text(max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=5,
)


@pytest.mark.slow
@cases("configs")
@given(data=st.data())
def test_configs(data):
    """Sets a field of a preset to any value: what is accepted comes back, and is a number where it must be one."""
    env, preset = data.draw(st.sampled_from([(env, preset) for env in sorted(PRESETS) for preset in PRESETS[env]]))
    values = assemble.to_dict(make_config(env, preset=preset))
    name = data.draw(st.sampled_from([*assemble.flatten(values), "train", "nope"]))
    *path, last = name.split(".")
    group = values
    for part in path:
        group = group[part]
    group[last] = data.draw(st.one_of(JSON, st.just([3, 3]), st.just([0]), st.integers(1, 5)))
    config = accepted(lambda: assemble.from_dict(values))
    if config is not None:
        assert assemble.from_dict(json.loads(json.dumps(assemble.to_dict(config)))) == config
        for field, value in assemble.flatten(assemble.to_dict(config)).items():
            if isinstance(value, float):
                assert np.isfinite(value), field


@pytest.mark.slow
@cases("flags")
@given(data=st.data())
def test_flags(data):
    """Gives flags and overrides any text: they make a configuration, or an error that names the flag."""
    fields = assemble.flatten(assemble.to_dict(make_config("reach", preset="cpu")))
    names = ["env", "method", "preset", "seed", "data", "nope", *(f"config.{name}" for name in (*fields, "nope"))]
    literal = JSON.map(repr)
    text = st.one_of(
        literal, st.text(max_size=5), st.sampled_from([*PRESETS, "cpu", "paper", "3", "0.5", "(2, 2)", "None"])
    )
    drawn = data.draw(st.lists(st.tuples(st.sampled_from(names), text), max_size=3))

    def parse():
        values = flags.FlagValues()
        command_line.define_flags(values)
        command_line.parse(["train", "--preset=cpu", *(f"--{name}={value}" for name, value in drawn)], values)
        check_config(values.config)
        return values.config

    config = accepted(parse)
    if config is not None:
        assert assemble.from_dict(assemble.to_dict(config)) == config


@pytest.fixture(scope="module")
def data_set(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad") / "set"
    with Writer(folder, (4, 5), 3, 2) as writer:
        for i, split in enumerate(("train", "validation", "test")):
            demos = [Demo(np.zeros((6, 4, 5, 3), np.uint8), np.ones((6, 3)), np.ones((6, 2))) for _ in range(2)]
            writer.add(f"task {i}", split, [6, 6], demos)
    return folder


def mutate(data, values):
    """Puts any value, or nothing, at a random place of nested dictionaries and lists."""
    place, key = None, None
    here = values
    while isinstance(here, dict | list) and here and (place is None or data.draw(st.integers(0, 3))):
        key = data.draw(st.sampled_from(sorted(here) if isinstance(here, dict) else range(len(here))))
        place, here = here, here[key]
    if data.draw(st.booleans()):
        place[key] = data.draw(JSON)
    else:
        del place[key]


@cases("headers")
@given(data=st.data())
def test_headers_of_data_sets(data_set, data):
    values = json.loads((data_set / "zarr.json").read_text())
    mutate(data, values["attributes"])
    folder = data_set.parent / "mutated"
    folder.mkdir(exist_ok=True)
    for task in data_set.glob("0*"):
        if not (folder / task.name).exists():
            shutil.copytree(task, folder / task.name)
    (folder / "zarr.json").write_text(json.dumps(values))

    def read():
        opened = DataSet(folder)
        recorded.config_for(folder, preset="cpu")
        return [opened.read(i, j) for i, task in enumerate(opened.header.tasks) for j in range(len(task.lengths))]

    demos = accepted(read)
    if demos is not None:
        for demo in demos:
            for value in dataclasses.astuple(demo):
                assert value is None or (value.size <= 12 * 60 and np.unique(value).size <= 1)


@pytest.mark.slow
@cases("lerobot")
@given(data=st.data())
def test_metadata_of_lerobot(data, tmp_path_factory):
    root = pathlib.Path(shutil.copytree(FIXTURES / "lerobot", tmp_path_factory.mktemp("bad") / "set"))
    path = root / "meta" / "info.json"
    values = json.loads(path.read_text())
    for unused in ("total_tasks", "splits", "robot_type", "chunks_size"):
        values.pop(unused)
    mutate(data, values)
    path.write_text(json.dumps(values))
    lerobot._read_table.cache_clear()
    camera = data.draw(st.sampled_from([None, "", "observation.images.top", "observation.images.wrist"]))

    def read():
        source = LeRobot(root, camera, "observation.state", "action", 128)
        return [episode.read() for episode in source.episodes("task_index")[:2]]

    demos = accepted(read)
    if demos is not None:
        assert [len(demo.state) for demo in demos] == [12, 9]
    shutil.rmtree(root)


CELLS = st.one_of(
    st.none(),
    st.integers(-2, 3),
    st.integers(-(2**62), 2**62),
    st.floats(),
    st.text(max_size=3),
    st.lists(st.floats(width=32), max_size=4),
    st.lists(st.text(max_size=3), max_size=2),
)


@pytest.mark.slow
@cases("parquet")
@given(data=st.data())
def test_tables_of_lerobot(data, tmp_path_factory):
    """Gives a column any type, or takes some of its values away."""
    root = pathlib.Path(shutil.copytree(FIXTURES / "lerobot", tmp_path_factory.mktemp("bad") / "set"))
    path = data.draw(st.sampled_from(sorted(path.relative_to(root) for path in root.rglob("*.parquet"))))
    table = pyarrow.parquet.read_table(root / path)
    name = data.draw(st.sampled_from(table.column_names))
    if data.draw(st.booleans()):
        column = [data.draw(CELLS)] * len(table)
    else:
        lost = data.draw(st.integers(0, len(table) - 1))
        column = [None if i == lost else value for i, value in enumerate(table[name].to_pylist())]
    changed = table.set_column(table.column_names.index(name), name, pyarrow.array(column))
    pyarrow.parquet.write_table(changed, root / path)
    lerobot._read_table.cache_clear()

    def read():
        source = LeRobot(root, "observation.images.top", "observation.state", "action", 128)
        return [episode.read() for episode in source.episodes("task_index")[:2]]

    demos = accepted(read)
    if demos is not None:
        for demo in demos:
            assert len(demo.image) == len(demo.state) == len(demo.action)
            assert demo.state.dtype.kind == "f"
    shutil.rmtree(root)


@cases("robomimic")
@given(data=st.data())
def test_files_of_robomimic(data, tmp_path_factory):
    path = pathlib.Path(shutil.copy(FIXTURES / "robomimic" / "stack.hdf5", tmp_path_factory.mktemp("bad") / "set.hdf5"))
    names = ("actions", "obs/agentview_image", "obs/robot0_eef_pos", "obs")
    name = f"data/demo_0/{data.draw(st.sampled_from(names))}"
    shape = data.draw(arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=6))
    dtype = data.draw(
        st.sampled_from([np.uint8, np.float32, np.int64, np.bool_, np.complex64, "S3", h5py.string_dtype()])
    )
    with h5py.File(path, "a") as file:
        del file[name]
        if data.draw(st.booleans()):
            file.create_dataset(name, shape, dtype)

    def read():
        source = Robomimic(path, None, "robot0_eef_pos", "actions", 128)
        return source.contents, [episode.read() for episode in source.episodes("file")]

    found = accepted(read)
    if found is not None:
        sizes, demos = found
        assert len(demos) == 2
        for demo in demos:
            assert sizes.image_shape is None or demo.image.shape[1:] == (*sizes.image_shape, 3)
    path.unlink()
