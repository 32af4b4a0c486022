"""What the launchers share: flags that everybody sets, and overrides of single configuration fields."""

import functools
import pathlib
import sys
from collections.abc import Callable, Sequence

import jax
from absl import app, flags, logging
from ml_collections import config_flags

from milx.config import assemble
from milx.config.registry import PRESETS, load_plugins
from milx.config.schema import Config
from milx.core import parallel, platform
from milx.envs import ENVS
from milx.methods import METHODS
from milx.training import recorded, signals

FLAGS = flags.FLAGS
_OWN_FLAGS = {"env_name": "env", "method_name": "method", "preset": "preset", "seed": "seed"}
flags.disclaim_key_flags()  # so that --help of a launcher lists the flags defined here


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines --env, --method, --preset, --seed, --workdir and what several hosts need."""
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
    integer("seed", 0, "Seed of training tasks, initial parameters and batches.", lower_bound=0)
    string("coordinator", None, "Several hosts outside SLURM and Cloud TPU: address:port of the first one.")
    integer("num_processes", None, "With --coordinator: how many hosts there are.", lower_bound=1)
    integer("process_id", None, "With --coordinator: this host's number, from 0.", lower_bound=0)
    string("workdir", None, "Folder of the run; default runs/<env>-<method>-<preset>-<seed>.")


def run(main: Callable[[Config, str], None]) -> None:
    """Parses the command line and calls `main(config, workdir)`; bad input ends with a message, not a traceback."""
    platform.configure()

    def parse_or_exit(argv: Sequence[str]) -> list[str]:
        try:
            return parse(argv)
        except flags.Error as error:
            sys.exit(f"milx: {error}")

    def start(argv: Sequence[str]) -> None:
        logging.set_verbosity(logging.WARNING)
        if len(argv) > 1:
            raise app.UsageError(f"unexpected argument {argv[1]!r}")
        config = FLAGS.config
        if FLAGS.preset is None:
            others = ", ".join(f"--preset={name}" for name in PRESETS[config.env_name] if name != config.preset)
            print(f"Running on {jax.default_backend()} with its default, --preset={config.preset}; also: {others}.")
        what = config.env_name if FLAGS.data is None else pathlib.Path(FLAGS.data).resolve().name
        name = f"{what}-{config.method_name}-{config.preset}-{config.seed}"
        try:
            with signals.Stop().listen():
                main(config, FLAGS.workdir or f"runs/{name}")
        except (ValueError, OSError) as error:
            sys.exit(f"milx: {error}")

    app.run(start, flags_parser=parse_or_exit)


def parse(argv: Sequence[str], values: flags.FlagValues = FLAGS) -> list[str]:
    """Parses the flags, then the overrides of the configuration that they choose; returns what is left.

    Raises:
        flags.Error: for a flag, field or value that cannot be.
    """
    own = [arg for arg in argv if not arg.startswith(("--config", "-config"))]
    values(own)
    parallel.join_hosts(values.coordinator, values.num_processes, values.process_id)
    load_plugins()
    preset = values.preset or ("cpu" if jax.default_backend() == "cpu" else "fast")
    try:
        if values.data is None:
            config = assemble.make_config(values.env, values.method, preset, values.seed)
        else:
            config = recorded.make_config(values.data, values.method, preset, values.seed)
    except (ValueError, OSError) as error:
        raise flags.Error(str(error)) from error
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
    for arg in argv[1:]:
        name = arg.lstrip("-").split("=")[0]
        if name.startswith("config.") and (field := name.removeprefix("config.")) in _OWN_FLAGS:
            raise flags.Error(f"--{name}: expected --{_OWN_FLAGS[field]}, which also chooses the defaults")
        if name.startswith("config.") and name.removeprefix("config.") not in known:
            has = f"no such field with --method={config.method_name}, expected one of"
            raise flags.Error(f"--{name}: {has}\n  " + "\n  ".join(known))
