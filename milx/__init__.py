"""milx: one-shot visual imitation by meta-learning, end to end on the accelerator."""

from milx import platform as _platform

_platform.configure()
_platform.import_mjx()

from milx.envs import ENVS, make  # noqa: E402
from milx.methods import METHODS  # noqa: E402
from milx.policy import Policy  # noqa: E402
from milx.pretrained import load  # noqa: E402
from milx.types import Demo, Observation  # noqa: E402

__all__ = ["ENVS", "METHODS", "Demo", "Observation", "Policy", "load", "make"]
