"""The interface of every method: trainer, evaluator and users know nothing else."""

import abc
import dataclasses

import jax

from milx.methods.whitening import Whitening
from milx.types import Demo, Memory, Observation, Params, TaskBatch, TaskParams


class Method(abc.ABC):
    """One way to learn from one demonstration. All methods are pure; the object holds only configuration.

    `params` is what meta-training learns; `task_params` is what the policy needs once it has seen a demonstration.
    """

    chunk = 1
    """C, the number of time steps whose actions demonstrations hold for each of theirs, one after the other."""
    history = 1
    """N, the number of observations that demonstrations hold for each of their time steps, the latest first."""

    @property
    def predictor(self) -> "Method":
        """The method inside that is trained: it sees, and predicts, what demonstrations hold in training."""
        return self

    @property
    def imitation_steps(self) -> int:
        """Number of meta-updates at the start that minimize `imitation` instead of `loss`."""
        return 0

    @abc.abstractmethod
    def init(self, key: jax.Array, whitening: Whitening) -> Params:
        """Draws the parameters at the start of meta-training; they carry the whitening of states and actions."""

    @abc.abstractmethod
    def loss(
        self, params: Params, batch: TaskBatch, progress: jax.Array | float = 1.0
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Computes the meta-objective of a batch of N tasks, a scalar, and metrics, [N] each, "loss" among them.

        `progress` is the fraction of the run that is done, in [0, 1].
        """

    def imitation(self, params: Params, batch: TaskBatch) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Computes the loss without an inner step, which the first `imitation_steps` meta-updates minimize.

        Raises:
            NotImplementedError: if the method has no such loss; its `imitation_steps` is then 0.
        """
        raise NotImplementedError

    @abc.abstractmethod
    def adapt(self, params: Params, demo: Demo) -> TaskParams:
        """Learns a task from demonstrations with axes [K, T, ...]; returns `task_params`."""

    def unadapted(self, params: Params) -> TaskParams | None:
        """Returns `task_params` before any demonstration, with the structure of what `adapt` returns, or None."""
        del params
        return None

    @abc.abstractmethod
    def act(self, task_params: TaskParams, observation: Observation, memory: Memory) -> tuple[jax.Array, Memory]:
        """Chooses the action [A], in the environment's units, for one observation; returns it and the next memory."""

    def initial_memory(self, key: jax.Array) -> Memory:
        """Returns the memory at the start of an episode; `key` is for methods that act at random."""
        del key
        return ()


@dataclasses.dataclass(frozen=True, eq=False)
class Wrapper(Method):
    """A method that learns as another one does, and differs from it in what it is given, or in how it acts.

    Attributes:
        method: the other one.
    """

    method: Method

    @property
    def predictor(self) -> Method:
        """As the method's."""
        return self.method.predictor

    @property
    def imitation_steps(self) -> int:
        """As the method's."""
        return self.method.imitation_steps

    def init(self, key: jax.Array, whitening: Whitening) -> Params:
        """As the method's, with the whitening of what demonstrations hold."""
        return self.method.init(key, whitening)

    def loss(
        self, params: Params, batch: TaskBatch, progress: jax.Array | float = 1.0
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """As the method's."""
        return self.method.loss(params, batch, progress)

    def imitation(self, params: Params, batch: TaskBatch) -> tuple[jax.Array, dict[str, jax.Array]]:
        """As the method's."""
        return self.method.imitation(params, batch)

    def adapt(self, params: Params, demo: Demo) -> TaskParams:
        """As the method's."""
        return self.method.adapt(params, demo)

    def unadapted(self, params: Params) -> TaskParams | None:
        """As the method's."""
        return self.method.unadapted(params)
