"""Meta-learning through gradient descent, for any loss and any pytree of parameters: pure functions.

A task's loss is what remains after a few steps of gradient descent on other data of the task; its derivative goes
through these steps (MAML, Finn et al. 2017):

    def task_loss(params, task):
        adapted = meta.adapt(loss, params, *task.support, steps=1, rate=0.1)
        return loss(adapted, *task.query)

    gradient, losses = meta.meta_gradient(task_loss, params, tasks)
"""

from milx.meta.convolution import conv2d
from milx.meta.implicit import implicit_adapt
from milx.meta.objective import meta_gradient, multi_step_loss, tasks_within
from milx.meta.steps import ORDERS, adapt, gradient, inner_step

__all__ = [
    "ORDERS",
    "adapt",
    "conv2d",
    "gradient",
    "implicit_adapt",
    "inner_step",
    "meta_gradient",
    "multi_step_loss",
    "tasks_within",
]
