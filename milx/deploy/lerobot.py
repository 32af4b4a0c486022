"""A policy that LeRobot's evaluation loop can call, after one demonstration of the task.

    policy = LeRobotPolicy(milx.load("runs/demos"))
    policy.reset(demo)
    info = lerobot.scripts.lerobot_eval.eval_policy(worlds, policy, ..., n_episodes=50)

This module needs LeRobot, which brings PyTorch; no other module of milx imports them.
"""

import dataclasses
import pathlib
from typing import Any, NoReturn

from milx.deploy.batched import Batched
from milx.types import Demo

try:
    import torch
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.pretrained import PreTrainedPolicy
except ModuleNotFoundError as error:
    needs = "milx.deploy.lerobot needs LeRobot and PyTorch: pip install 'lerobot>=0.4.4'"
    raise ImportError(f"{needs} ({error})") from error


@PreTrainedConfig.register_subclass("milx")
@dataclasses.dataclass
class LeRobotConfig(PreTrainedConfig):
    """What LeRobot wants to know of every policy; milx's own configuration is the run's.

    Attributes:
        device: where PyTorch has the actions. JAX computes them on its own device.
    """

    device: str | None = "cpu"
    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def get_optimizer_preset(self) -> NoReturn:
        """Raises NotImplementedError."""
        _refuse_training()

    def get_scheduler_preset(self) -> NoReturn:
        """Raises NotImplementedError."""
        _refuse_training()

    def validate_features(self) -> None:
        """Does nothing: every observation is checked when the policy sees it."""


class LeRobotPolicy(PreTrainedPolicy):
    """A policy of milx with the interface of LeRobot's policies, as far as evaluation goes.

    It acts in a batch of environments, each with a memory of its own. It has no processors: in their places pass
    functions that return what they are given. Those of the environment are needed as ever. Actions are not clipped.

    Args:
        policy: what `milx.load` returns, or the `Policy` of an exported folder (`milx.deploy.standalone`).
    """

    config_class = LeRobotConfig
    name = "milx"

    def __init__(self, policy: Any):
        super().__init__(LeRobotConfig())
        self._batched = Batched(policy)

    def reset(self, demo: Demo | None = None) -> None:
        """Begins new episodes; LeRobot does so without a demonstration before every batch of episodes.

        Args:
            demo: one demonstration [T, ...] or several [K, T, ...] of the task of these and the following episodes;
                None if it is the same task as before.

        Raises:
            ValueError: for a field that is missing or has a wrong shape, type or value.
        """
        self._batched.reset(demo)

    def select_action(self, batch: dict[str, Any]) -> torch.Tensor:
        """Returns the actions, a tensor [B, A] on the CPU, for one time step of B environments.

        Args:
            batch: tensors by LeRobot's names, "observation.state" [B, S], and images [B, 3, H, W] in [0, 1] of the
                cameras "observation.images.NAME", or of "observation.image". A policy with one camera takes the only
                one that is there, whatever its name. Larger images of the same proportions are shrunk, as importers
                do. Other entries are ignored.

        Raises:
            ValueError: if there was no demonstration, if the number of environments has changed since the last
                `reset`, or for an entry that is missing or has a wrong shape, type or value.
        """
        arrays = {name: value.cpu().numpy() for name, value in batch.items() if isinstance(value, torch.Tensor)}
        return torch.from_numpy(self._batched.act(arrays))

    def predict_action_chunk(self, batch: dict[str, Any]) -> NoReturn:
        """Raises NotImplementedError."""
        raise NotImplementedError("chunks: milx executes them itself; call `select_action` at every time step")

    def forward(self, batch: dict[str, Any]) -> NoReturn:
        """Raises NotImplementedError."""
        _refuse_training()

    def get_optim_params(self) -> NoReturn:
        """Raises NotImplementedError."""
        _refuse_training()

    def _save_pretrained(self, save_directory: pathlib.Path) -> NoReturn:
        raise NotImplementedError("saving: PyTorch has none of the parameters; write them with `python -m milx.export`")


def _refuse_training() -> NoReturn:
    raise NotImplementedError("training: LeRobot cannot train policies of milx; use `python -m milx.train`")
