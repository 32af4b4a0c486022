"""What the launchers share: flags that everybody sets, and overrides of single configuration fields."""

import functools
import gc
import os
import pathlib
from collections.abc import Callable, Sequence

import jax
from absl import app, flags, logging
from ml_collections import config_flags

from milx.config import assemble
from milx.config.registry import DURATIONS, PRESETS, load_plugins
from milx.config.schema import Config
from milx.core import commands, parallel, platform
from milx.core.messages import fail, say
from milx.data import RECORDED
from milx.envs import ENVS
from milx.methods import METHODS
from milx.training import recorded

FLAGS = flags.FLAGS
_OWN_FLAGS = {"env_name": "env", "method_name": "method", "preset": "preset", "seed": "seed", "train.init": "init"}
flags.disclaim_key_flags()  # so that --help of a launcher lists the flags defined here


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines --env, --method, --preset, --init, --seed, --workdir and what several hosts need."""
    string, integer = (
        functools.partial(define, flag_values=values) for define in (flags.DEFINE_string, flags.DEFINE_integer)
    )
    string("env", "reach", f"Environment: {', '.join(ENVS)}.")
    string("data", None, "Folder of recorded demonstrations (milx.data), instead of an environment.")
    string("method", "mil", f"Method: {', '.join(METHODS)}.")
    string(
        "preset",
        None,
        "Hyperparameters: paper (the method as published), fast (for an accelerator, its default), cpu "
        "(smaller images and networks; the default without an accelerator). --config.path.to.field=value changes any "
        "of them.",
    )
    string(
        "init",
        None,
        "Where parameters come from at the start: a run's folder, a policy that ships with milx, or a .safetensors or "
        ".npz file.",
    )
    integer("seed", 0, "Seed of training tasks, initial parameters and batches.", lower_bound=0)
    string("coordinator", None, "Several hosts outside SLURM and Cloud TPU: address:port of the first one.")
    integer("num_processes", None, "With --coordinator: how many hosts there are.", lower_bound=1)
    integer("process_id", None, "With --coordinator: this host's number, from 0.", lower_bound=0)
    string("workdir", None, "Folder of the run; default runs/<env>-<method>-<preset>-<seed>.")


def run(main: Callable[[Config, str], None]) -> None:
    """Parses the command line, says what will be done, and calls `main(config, workdir)`.

    Bad input ends with a message, not a traceback.
    """
    platform.configure()
    # Tracing makes millions of objects, hardly any of them in cycles, which Python would search for all the time.
    gc.freeze()
    gc.set_threshold(100_000, 50, 50)

    def parse_or_exit(argv: Sequence[str]) -> list[str]:
        try:
            return parse(argv)
        except flags.Error as error:
            fail(error)

    def start(argv: Sequence[str]) -> None:
        logging.set_verbosity(logging.ERROR)  # Orbax warns of things that milx does on purpose
        if len(argv) > 1:
            raise app.UsageError(f"unexpected argument {argv[1]!r}")
        config = FLAGS.config
        what = config.env_name if FLAGS.data is None else pathlib.Path(FLAGS.data).resolve().name
        workdir = FLAGS.workdir or f"runs/{what}-{config.method_name}-{config.preset}-{config.seed}"
        with commands.command():
            if parallel.is_first_host():
                say(_describe(config, what, workdir))
            main(config, workdir)

    app.run(start, flags_parser=parse_or_exit)


def _describe(config: Config, what: str, workdir: str) -> str:
    """Says what will be done, on what hardware, and how long that took where it was measured."""
    device = jax.devices()[0]
    cores = f"{os.cpu_count()} CPU cores"
    hardware = cores if device.platform == "cpu" else f"{jax.device_count()} x {device.device_kind}"
    name = f"{config.method_name} on {what}, preset {config.preset}, seed {config.seed}"
    said = [f"{name}, with {hardware}, in {workdir}."]
    others = [f"--preset={name}" for name in PRESETS[config.env_name] if name != config.preset]
    if FLAGS.preset is None:
        said.append(f"The preset is the default here; also: {', '.join(others)}.")
    duration = DURATIONS.get(config.env_name, {}).get(config.preset)
    if duration and config.method_name == "mil" and not assemble.overrides(config):
        said.append(f"This took {duration}.")
    return " ".join(said)


def parse(argv: Sequence[str], values: flags.FlagValues = FLAGS) -> list[str]:
    """Parses the flags, then the overrides of the configuration that they choose; returns what is left.

    Raises:
        flags.Error: for a flag, field or value that cannot be.
    """
    own = [arg for arg in argv if not arg.startswith(("--config", "-config"))]
    values(own)
    hosts = values.coordinator, values.num_processes, values.process_id
    if None in hosts and hosts != (None, None, None):
        raise flags.Error("--coordinator, --num_processes and --process_id: got some of them, expected all or none")
    try:
        parallel.join_hosts(*hosts)
        platform.require_device()
        load_plugins()
        preset = values.preset or ("cpu" if jax.default_backend() == "cpu" else "fast")
        if values.data is None and values.env == RECORDED:
            raise flags.Error(f"--env: got {RECORDED!r}, expected --data=FOLDER, the folder of the demonstrations")
        if values.data is None and values.preset is None and preset not in PRESETS.get(values.env, [preset]):
            known = ", ".join(PRESETS[values.env])
            raise flags.Error(f"--preset: got none, expected one of {known}: {values.env} has none for this device")
        if values.data is None:
            config = assemble.make_config(values.env, values.method, preset, values.seed)
        else:
            config = recorded.config_for(values.data, values.method, preset, values.seed)
    except (ValueError, OSError) as error:
        raise flags.Error(str(error)) from error
    config.train.init = values.init
    _check_fields(argv, config)
    unset = [arg for arg in argv if arg.startswith("--config.") and arg.endswith("=None")]
    for arg in unset:  # ml_collections has no way to say None
        try:
            assemble.assign(config, arg.removeprefix("--config.").removesuffix("=None"), None)
        except ValueError as error:
            raise flags.Error(str(error)) from error
    rest = [arg for arg in argv if arg not in unset]
    config_flags.DEFINE_config_dataclass("config", config, "Every hyperparameter.", values, sys_argv=rest)
    return values(rest)


def _check_fields(argv: Sequence[str], config: Config) -> None:
    """Raises flags.Error for --config.NAME where there is no such field; lists those that exist."""
    known = assemble.fields(config)
    is_recorded = config.env_name == RECORDED
    unread = ("env.", "data.", "evaluation.", "train.redraw") if is_recorded else ("recorded.", "evaluation.gym")
    worlds = ["config.evaluation.shots", "config.evaluation.gym"]
    if any(arg.lstrip("-").startswith("config.evaluation.gym=") for arg in argv):
        worlds += [f"config.evaluation.{name}" for name in ("gym_python", "gym_workers", "gym_timeout", "trials")]
    for arg in argv[1:]:
        name = arg.lstrip("-").split("=")[0]
        read = not name.removeprefix("config.").startswith(unread) or (is_recorded and name in worlds)
        if name.startswith("config.") and not read:
            where = "without --data" if is_recorded else "with --data"
            raise flags.Error(f"--{name}: expected only {where}; nothing reads it here")
        if name.startswith("config.") and (field := name.removeprefix("config.")) in _OWN_FLAGS:
            raise flags.Error(f"--{name}: expected --{_OWN_FLAGS[field]}, which also chooses the defaults")
        if name.startswith("config.") and name.removeprefix("config.") not in known:
            has = f"no such field with --method={config.method_name}, expected one of"
            raise flags.Error(f"--{name}: {has}\n  " + "\n  ".join(known))
