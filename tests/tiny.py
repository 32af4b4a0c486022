"""The smallest run, for tests that need one."""

from rich.console import Console

from milx.config.assemble import make_config
from milx.config.schema import Config

QUIET = Console(quiet=True)


def tiny_config(seed: int = 0, env: str = "reach") -> Config:
    """Returns sizes at which compiling takes far longer than running."""
    config = make_config(env, preset="cpu", seed=seed)
    config.data.tasks, config.data.demos_per_task = 8, 3
    config.data.plan_iterations, config.data.plan_batch = 3, 10
    config.network.fc_layers = (16,)
    if env == "reach":
        config.network.filters, config.network.strides = (4, 4), (2, 2)
    config.train.steps, config.train.log_every, config.train.eval_every = 6, 2, 2
    config.train.meta_batch, config.train.support_frames, config.train.query_frames = 2, 3, 3
    config.evaluation.validation_tasks, config.evaluation.tasks = 3, 3
    config.evaluation.trials, config.evaluation.batch = 2, 3
    return config
