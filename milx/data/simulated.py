"""Simulated demonstrations: states, actions and tasks on the device; pixels are rendered when they are needed."""

import dataclasses
import functools
import itertools
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from milx.config.schema import DataConfig, TrainConfig
from milx.core import files, pytrees
from milx.core.batching import map_in_chunks
from milx.core.messages import warn
from milx.data import experts
from milx.data.augment import mirrored
from milx.data.frames import frame_indices, in_chunks
from milx.data.goals import goals
from milx.envs.base import Env, State, Task
from milx.trajopt.episode import judge
from milx.types import SPLITS, Demo, TaskBatch


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class DemoSet:
    """D demonstrations of each of N tasks, those that succeed before those that do not.

    Attributes:
        task: the tasks, with a leading axis [N].
        states: with leading axes [N, D, T + 1].
        action: [N, D, T, A].
        success: [N, D] bool, whether the expert reached the goal.
    """

    task: Task
    states: State
    action: jax.Array
    success: jax.Array

    @property
    def num_tasks(self) -> int:
        """N."""
        return self.action.shape[0]

    @property
    def num_demos(self) -> int:
        """D."""
        return self.action.shape[1]


def collect(
    env: Env,
    key: jax.Array,
    split: str,
    num_tasks: int,
    num_demos: int,
    config: DataConfig,
    parts: pathlib.Path | None = None,
) -> DemoSet:
    """Draws tasks of a split and plans demonstrations of each in scenes of their own.

    Args:
        env: the environment.
        key: the set is a function of this key and the split.
        split: "train", "validation" or "test".
        num_tasks: N.
        num_demos: D.
        config: noise on the actions, and settings of the planner.
        parts: how the names of files begin that keep what is planned at once, so that a process that was killed goes on
            with the next; None for no files.

    Raises:
        ValueError: as `experts.expert_of`.
    """
    expert, numbers = experts.expert_of(env, config), itertools.count()
    tasks, each, state, keys = _draw(env, jax.random.fold_in(key, SPLITS.index(split)), split, num_tasks, num_demos)

    def plan_part(task: Task, state: State, key: jax.Array) -> tuple[State, jax.Array]:
        make = functools.partial(expert.perform, env, task, state, key, config.noise)
        if parts is None:
            return make()
        path = parts.with_name(f"{parts.name}-{next(numbers)}.npz")
        return pytrees.kept(path, make, lambda: _of_one_task(shapes(env, 1, len(key))))

    states, action = map_in_chunks(plan_part, (each, state, keys), config.plan_batch)
    success, _ = map_in_chunks(functools.partial(judge, env), (each, states), config.plan_batch)
    demos, diverged = _arrange(tasks, states, action, success)
    if diverged:
        warn(f"{diverged} of {len(action)} demonstrations diverged and are dropped")
    return demos


def _of_one_task(demos: DemoSet) -> tuple[State, jax.Array]:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), (demos.states, demos.action))


@jax.jit
def _arrange(tasks: Task, states: State, action: jax.Array, success: jax.Array) -> tuple[DemoSet, jax.Array]:
    """Sorts N D demonstrations by task, those that succeed first, and counts those that are not finite.

    What is not finite becomes zero, so that they count as failed.
    """
    flat = [x.reshape(len(x), -1) for x in jax.tree.leaves((states, action)) if x.size]
    finite = jnp.stack([jnp.isfinite(x).all(axis=1) for x in flat]).all(axis=0)
    keep = lambda x: jnp.where(finite.reshape(-1, *[1] * (x.ndim - 1)), x, jnp.zeros((), x.dtype))  # noqa: E731
    kept = *jax.tree.map(keep, (states, action)), success & finite
    num_tasks = len(jax.tree.leaves(tasks)[0])
    shape = num_tasks, len(success) // num_tasks  # in full, as -1 stands for nothing where a leaf is empty
    of_task = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), kept)
    order = jnp.argsort(~of_task[-1], axis=1)
    rows = jnp.arange(num_tasks)[:, None]
    return DemoSet(tasks, *jax.tree.map(lambda x: x[rows, order], of_task)), (~finite).sum()


@functools.partial(jax.jit, static_argnums=(0, 2, 3, 4))
def _draw(env: Env, key: jax.Array, split: str, num_tasks: int, num_demos: int) -> tuple[Task, Task, State, jax.Array]:
    """Samples tasks [N] and, for each of the N D demonstrations, its task, its first scene, and a key for noise."""
    task_key, scene_key, noise_key = jax.random.split(key, 3)
    total = num_tasks * num_demos
    tasks = jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(task_key, num_tasks), split)
    each = jax.tree.map(lambda x: jnp.repeat(x, num_demos, axis=0), tasks)
    state = jax.vmap(env.reset)(jax.random.split(scene_key, total), each)
    return tasks, each, state, jax.random.split(noise_key, total)


def render_demo(
    env: Env, task: Task, states: State, action: jax.Array, index: jax.Array | None = None, chunk: int = 1
) -> Demo:
    """Observes one demonstration: states with a leading axis T + 1, actions [T, A].

    Args:
        env: the environment.
        task: what the demonstration shows.
        states: visited states.
        action: actions taken.
        index: [F] time steps to keep; all T if None.
        chunk: number C of time steps whose actions each of them holds, [C A].
    """
    index = jnp.arange(len(action)) if index is None else index
    return render_demos(env, task, [(states, action, index)], chunk)[0]


def render_demos(env: Env, task: Task, demos: list[tuple[State, jax.Array, jax.Array]], chunk: int = 1) -> list[Demo]:
    """Observes several demonstrations of a task, each of states, actions and time steps to keep, as `render_demo`.

    All images are drawn together, so that a program has only one copy of the renderer.
    """
    kept = [jax.tree.map(lambda x, index=index: x[index], states) for states, _, index in demos]
    images: list[jax.Array | None] = [None] * len(demos)
    if env.vision:
        drawn = jax.vmap(env.render, in_axes=(None, 0))(task, jax.tree.map(lambda *xs: jnp.concatenate(xs), *kept))
        images = list(jnp.split(drawn, np.cumsum([len(index) for *_, index in demos])[:-1]))
    observed = []
    for image, (states, action, index) in zip(images, demos, strict=True):
        before = jax.tree.map(lambda x, action=action: x[: len(action)], states)
        robot = jax.vmap(env.robot_state)(before)
        goal = goals(robot, env.goal_indices, env.height_index, env.goal_step)[index]
        observed.append(Demo(image=image, state=robot[index], action=in_chunks(action, chunk)[index], goal=goal))
    return observed


def sample_batch(
    env: Env,
    demos: DemoSet,
    keys: jax.Array,
    shots: int,
    support_frames: int | None = None,
    query_frames: int | None = None,
    redraw: bool = False,
    exponent: float = 1.0,
    chunk: int = 1,
) -> TaskBatch:
    """Draws tasks and different demonstrations of each that succeed, and renders them.

    Args:
        env: the environment that renders.
        demos: where to draw from.
        keys: [N] keys; each draws one task, with replacement.
        shots: K, support demonstrations; one more of the same task becomes the query.
        support_frames: time steps drawn from each support demonstration; None for all.
        query_frames: time steps drawn from the query demonstration; None for all.
        redraw: show a task in a new appearance of the training split, each of its demonstrations in a new scene, and
            half of the tasks in a mirror, where the environment has one.
        exponent: see `frame_indices`.
        chunk: see `render_demo`.
    """
    enough = (demos.success.sum(axis=1) > shots).astype(float)

    def sample_task(key: jax.Array) -> TaskBatch:
        task_key, demo_key, support_key, query_key, mirror_key = jax.random.split(key, 5)
        n = jax.random.choice(task_key, demos.num_tasks, p=enough / enough.sum())
        chosen = jax.random.choice(demo_key, demos.num_demos, (shots + 1,), replace=False, p=demos.success[n] / 1.0)
        task = jax.tree.map(lambda x: x[n], demos.task)
        if redraw:
            task = env.redraw_appearance(jax.random.fold_in(key, 1), task)

        def load(d: jax.Array, key: jax.Array, frames: int | None) -> tuple[State, jax.Array, jax.Array]:
            states, action = jax.tree.map(lambda x: x[n, d], (demos.states, demos.action))
            if redraw:
                states = env.redraw_scene(jax.random.fold_in(key, 1), task, states)
            return states, action, frame_indices(key, action.shape[0], frames, exponent)

        shown = [load(chosen[k], jax.random.fold_in(support_key, k), support_frames) for k in range(shots)]
        observed = render_demos(env, task, [*shown, load(chosen[shots], query_key, query_frames)], chunk)
        if redraw and env.mirror is not None:
            turned = [mirrored(demo, env.mirror, env.goal_indices) for demo in observed]
            observed = jax.tree.map(functools.partial(jnp.where, jax.random.bernoulli(mirror_key)), turned, observed)
        *support, query = observed
        return TaskBatch(
            support=jax.tree.map(lambda *xs: jnp.stack(xs), *support),
            query=jax.tree.map(lambda x: x[None], query),
            task=n,
        )

    return jax.vmap(sample_task)(keys)


def sampler(env: Env, train: TrainConfig, chunk: int = 1) -> Callable[[DemoSet, jax.Array], TaskBatch]:
    """Configures `sample_batch` for a run, and returns a function of demonstrations and keys."""

    def sample(demos: DemoSet, keys: jax.Array) -> TaskBatch:
        frames = train.support_frames, train.query_frames
        return sample_batch(env, demos, keys, train.shots, *frames, train.redraw, train.frame_exponent, chunk)

    return sample


def shapes(env: Env, num_tasks: int, num_demos: int) -> DemoSet:
    """Returns shapes and types of a set of D = `num_demos` demonstrations of each of N = `num_tasks` tasks."""

    def expand(tree: Any, *axes: int) -> Any:
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct((*axes, *x.shape), x.dtype), tree)

    key = jax.random.key(0)
    task = jax.eval_shape(lambda key: env.sample_task(key, "train"), key)
    state = jax.eval_shape(env.reset, key, task)
    action, success = (jax.ShapeDtypeStruct(*x) for x in (((env.action_size,), state.qpos.dtype), ((), jnp.bool_)))
    return DemoSet(
        expand(task, num_tasks),
        expand(state, num_tasks, num_demos, env.horizon + 1),
        expand(action, num_tasks, num_demos, env.horizon),
        expand(success, num_tasks, num_demos),
    )


def cached(
    folder: pathlib.Path, env: Env, seed: int, split: str, num_tasks: int, num_demos: int, config: DataConfig
) -> DemoSet:
    """Returns what `collect` does, from `folder` if it is there: sets are kept under a hash of all that they depend on.

    The hash covers the arguments, the kind of device, and the versions of JAX, MuJoCo, the environment and the experts.
    How many demonstrations are planned at once is left out: it changes no more than rounding, by which an expert by
    sampling may choose another of two plans that are nearly as good. A network that learns on another kind of GPU may
    differ by more, since rounding grows while it learns.
    """
    digest = experts.digest(env, seed, split, num_tasks, num_demos, *experts.description(env, config))
    path = folder / f"{env.name}-{split}-{digest}.npz"
    parts = folder / f"{path.stem}.part-{config.plan_batch}"
    make = functools.partial(collect, env, jax.random.key(seed), split, num_tasks, num_demos, config, parts)
    demos = pytrees.kept(path, make, lambda: shapes(env, num_tasks, num_demos))
    if path.is_file():  # or the parts are all that is kept
        for part in folder.glob(f"{parts.name}-*.npz"):
            files.remove(part)
    return demos
