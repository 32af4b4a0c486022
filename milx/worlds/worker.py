"""A world in a process of its own. This file needs Python, NumPy and your code, and nothing of milx.

    python worker.py module:function

`function(task)` returns a Gymnasium environment in which the task of that name is to be done. Its observations are
dictionaries with "image", uint8 [H, W, 3], or "state", real numbers [S], or both; LeRobot's names "pixels" and
"agent_pos" mean the same. "image" may be a dictionary of the images of several cameras by name, which are called
"image.NAME" in messages. An array alone is an image if it looks like one, and a state otherwise.
`info["is_success"]`, or else `info["success"]`, tells after every step whether the task is done. Actions are those of a
`gymnasium.spaces.Box`, to whose limits they are clipped. An environment may have a method `demonstrate(seed)`, which
returns a demonstration as a dictionary with the arrays "image", "state" and "action", [T, ...], and raises an error if
it fails, and a `metadata["render_fps"]`, its time steps in a second. The module may have a function `tasks()`, which
lists the names of all tasks.

The process reads requests from standard input and writes a reply to each to standard output. Both are messages: four
bytes, little-endian, hold the length of a JSON object; the object follows, and then the bytes of the arrays that its
"arrays" lists, each as [name, type, shape], in C order. What the world prints goes to standard error.

| request | arrays | reply | arrays |
|---|---|---|---|
| when the process starts | | {"protocol": 1} | |
| {"do": "reset", "task": NAME, "seed": NUMBER} | | {} | the observation |
| {"do": "step"} | "action" [A]; none for a random one | {"success": BOOL, "ended": BOOL} | the observation |
| {"do": "demonstrate", "task": NAME, "seed": NUMBER} | | {"fps": NUMBER or null} | the demonstration, or nothing |
| {"do": "tasks"} | | {"tasks": [NAME, ...]} | |

A reply {"error": TEXT} says what went wrong. The process ends when its input ends.
"""

import importlib
import json
import os
import signal
import struct
import sys
import threading
import time
import traceback

import numpy as np

PROTOCOL = 1
"""The number of the protocol above."""
NAMES = {"image": ("image", "pixels"), "state": ("state", "agent_pos")}
"""Names of the parts of an observation, by the name in messages."""


def send(stream, header, arrays=None):
    """Writes a message."""
    arrays = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    listed = [[name, array.dtype.str, list(array.shape)] for name, array in arrays.items()]
    content = json.dumps({**header, "arrays": listed}).encode()
    stream.write(struct.pack("<I", len(content)) + content)
    for array in arrays.values():
        stream.write(array.tobytes())
    stream.flush()


def receive(read):
    """Reads a message with a function that returns so many bytes; returns the JSON object and the arrays by name."""
    header = json.loads(read(*struct.unpack("<I", read(4))))
    arrays = {}
    for name, dtype, shape in header.pop("arrays"):
        dtype = np.dtype(dtype)
        if dtype.hasobject or dtype.itemsize == 0:
            raise ValueError(f"{name}: got type {dtype}, expected numbers")
        size = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        arrays[name] = np.frombuffer(read(size), dtype).reshape(shape)
    return header, arrays


class World:
    """Answers requests with the environments that the user's function makes."""

    def __init__(self, make, tasks):
        self._make, self._tasks = make, tasks
        self._env = self._task = None

    def reset(self, task, seed):
        """Starts an episode; random actions depend on the seed, too."""
        env = self._of(task)
        env.action_space.seed(seed)
        observation, _ = env.reset(seed=seed)
        return {}, _seen(observation)

    def step(self, action):
        """Does one step, with a random action if there is none."""
        env = self._of(self._task)
        action = env.action_space.sample() if action is None else _within(action, env.action_space)
        observation, _, terminated, truncated, info = env.step(action)
        success = info.get("is_success", info.get("success"))
        if success is None:
            raise ValueError("info: has neither is_success nor success, expected one of them after every step")
        return {"success": bool(success), "ended": bool(terminated or truncated)}, _seen(observation)

    def demonstrate(self, task, seed):
        """Shows the task, if the environment can."""
        env = self._of(task)
        fps = getattr(env, "metadata", {}).get("render_fps")
        while env is not None and not hasattr(type(env), "demonstrate"):
            env = getattr(env, "env", None)
        return {"fps": float(fps) if fps else None}, {} if env is None else _by_field(env.demonstrate(seed))

    def tasks(self):
        """Lists the tasks."""
        if self._tasks is None:
            raise ValueError("tasks: missing, expected a function of this name beside the one that makes environments")
        return {"tasks": list(self._tasks())}, {}

    def close(self):
        """Closes the environment."""
        if self._env is not None:
            self._env.close()

    def _of(self, task):
        if task != self._task or self._env is None:
            if self._env is not None:
                self._env.close()
            self._env, self._task = self._make(task), task
        return self._env


def _within(action, space):
    """Clips an action to a space's limits, in its type."""
    if not hasattr(space, "low") or space.shape != action.shape:
        raise ValueError(f"action: got {list(action.shape)}, expected actions of {space}, a box of the same shape")
    action = np.clip(action, space.low, space.high)
    return (np.rint(action) if np.issubdtype(space.dtype, np.integer) else action).astype(space.dtype)


def _seen(observation):
    """Takes the image and the state out of an observation."""
    if not isinstance(observation, dict):
        array = np.asarray(observation)
        observation = {"image" if array.dtype == np.uint8 and array.ndim == 3 else "state": array}
    found = {}
    for part, names in NAMES.items():
        for name in names:
            if name in observation and part not in found:
                found[part] = observation[name]
    if not found:
        raise ValueError(f"observation: has {sorted(observation)}, expected image, state or both")
    return _by_field(found)


def _by_field(parts):
    """Makes arrays of an observation's or a demonstration's parts; the only one of a dictionary needs no name."""
    found: dict[str, np.ndarray] = {}
    for name, value in parts.items():
        if isinstance(value, dict) and (not value or (name != "image" and len(value) > 1)):
            raise ValueError(f"{name}: has {sorted(value)}, expected an array, or images of several cameras by name")
        each = {f"{name}.{key}": one for key, one in value.items()} if isinstance(value, dict) else {name: value}
        if len(each) == 1:
            each = {name: next(iter(each.values()))}
        found.update((key, np.asarray(one)) for key, one in each.items())
    return found


def answer(world, header, arrays):
    """Does what a request says; returns the reply's JSON object and arrays."""
    if header["do"] == "reset":
        return world.reset(header["task"], header["seed"])
    if header["do"] == "step":
        return world.step(arrays.get("action"))
    if header["do"] == "demonstrate":
        return world.demonstrate(header["task"], header["seed"])
    if header["do"] == "tasks":
        return world.tasks()
    raise ValueError(f"do: got {header['do']!r}, expected reset, step, demonstrate or tasks")


def _outlive_nobody(parent):
    """Ends the process, and all that it has started, when the one that has started it has ended."""
    while os.getppid() == parent:
        time.sleep(1.0)
    _end()


def _end():
    if os.getpid() == os.getpgrp():  # as the client starts it
        os.killpg(0, signal.SIGKILL)
    os._exit(0)


def main():
    """Answers requests until there are no more."""
    # What the world prints must not end up among the replies, and it must not read requests.
    requests, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    threading.Thread(target=_outlive_nobody, args=(os.getppid(),), daemon=True).start()

    def read(size):
        content = requests.read(size)
        if len(content) < size:
            raise EOFError
        return content

    try:
        module, _, name = sys.argv[1].partition(":")
        sys.path[0] = ""  # as `python -m` does, in the place of this file's folder
        found = importlib.import_module(module)
        world = World(getattr(found, name), getattr(found, "tasks", None))
    except Exception:
        send(replies, {"error": traceback.format_exc()})
        return
    send(replies, {"protocol": PROTOCOL})
    while True:
        try:
            header, arrays = receive(read)
        except EOFError:
            world.close()
            _end()
            return
        try:
            reply = answer(world, header, arrays)
        except Exception:
            reply = {"error": traceback.format_exc()}, None
        send(replies, *reply)


if __name__ == "__main__":
    main()
