"""The meta-step of `few_shot.py` in PyTorch: written out, with torch.func, and by libraries for meta-learning.

Parameters are dictionaries as there, with kernels [F, C, 3, 3], and the rows of the last layer in the order of features
[C, H, W]; images are [N, B, C, H, W], in the type of the convolutions, in which biases are added, too.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import nn
from torch.nn import functional

Params = dict[str, torch.Tensor]
Tasks = tuple[torch.Tensor, ...]
"""Images and labels to adapt to, then images and labels to be judged by; all have a leading axis of tasks."""
BLOCKS = 4


def predict(params: Params, x: torch.Tensor) -> torch.Tensor:
    """Computes the logits [B, classes] of images [B, C, H, W]."""
    dtype = x.dtype
    for i in range(BLOCKS):
        kernel, bias = params[f"kernel{i}"].to(dtype), params[f"bias{i}"].to(dtype)
        x = functional.conv2d(x.to(dtype), kernel, bias, padding=1).to(params[f"scale{i}"].dtype)
        x = functional.batch_norm(x, None, None, params[f"scale{i}"], params[f"shift{i}"], training=True, eps=1e-5)
        x = functional.max_pool2d(functional.relu(x), 2)
    return x.flatten(1) @ params["last"] + params["last_bias"]


def loss(params: Params, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Computes the mean cross-entropy."""
    return functional.cross_entropy(predict(params, x), y)


def by_loop(params: Params, tasks: Tasks, steps: int, rate: float) -> Params:
    """Computes the meta-gradient task by task with autograd."""
    leaves = {name: value.detach().requires_grad_() for name, value in params.items()}
    total = [torch.zeros_like(value) for value in leaves.values()]
    for x, y, query, wanted in zip(*tasks, strict=True):
        adapted = leaves
        for _ in range(steps):
            grads = torch.autograd.grad(loss(adapted, x, y), list(adapted.values()), create_graph=True)
            adapted = {name: p - rate * g for (name, p), g in zip(adapted.items(), grads, strict=True)}
        grads = torch.autograd.grad(loss(adapted, query, wanted), list(leaves.values()))
        total = [t + g / len(tasks[0]) for t, g in zip(total, grads, strict=True)]
    return dict(zip(leaves, total, strict=True))


def by_vmap(params: Params, tasks: Tasks, steps: int, rate: float) -> Params:
    """Computes the meta-gradient of all tasks at once with torch.func."""

    def task_loss(params: Params, x: torch.Tensor, y: torch.Tensor, query: torch.Tensor, wanted: torch.Tensor) -> Any:
        for _ in range(steps):
            grads = torch.func.grad(loss)(params, x, y)
            params = {name: p - rate * grads[name] for name, p in params.items()}
        return loss(params, query, wanted)

    of_tasks = torch.func.vmap(task_loss, in_dims=(None, 0, 0, 0, 0))
    return torch.func.grad(lambda params: of_tasks(params, *tasks).mean())(params)


class Classifier(nn.Module):
    """The network as a module, for libraries that want one."""

    def __init__(self, params: Params):
        super().__init__()
        self.params = nn.ParameterDict({name: value.clone() for name, value in params.items()})

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Computes the logits."""
        return predict(dict(self.params.items()), x)


def by_higher(params: Params, tasks: Tasks, steps: int, rate: float) -> Params:
    """Computes the meta-gradient with higher (Grefenstette et al. 2019), task by task as its own example does."""
    import higher

    module = Classifier(params)
    optimizer = torch.optim.SGD(module.parameters(), lr=rate)
    for x, y, query, wanted in zip(*tasks, strict=True):
        with higher.innerloop_ctx(module, optimizer, copy_initial_weights=False) as (adapted, inner):
            for _ in range(steps):
                inner.step(functional.cross_entropy(adapted(x), y))
            (functional.cross_entropy(adapted(query), wanted) / len(tasks[0])).backward()
    return {name: value.grad for name, value in module.params.items()}  # type: ignore[misc]


def by_torchopt(params: Params, tasks: Tasks, steps: int, rate: float) -> Params:
    """Computes the meta-gradient with TorchOpt (Ren et al. 2023), task by task as its own example does."""
    import torchopt

    module = Classifier(params)
    inner = torchopt.MetaSGD(module, lr=rate)
    start = torchopt.extract_state_dict(module, by="reference")
    before = torchopt.extract_state_dict(inner, by="reference")
    leaves = {name: value for name, value in module.params.items()}
    for x, y, query, wanted in zip(*tasks, strict=True):
        for _ in range(steps):
            inner.step(functional.cross_entropy(module(x), y))
        (functional.cross_entropy(module(query), wanted) / len(tasks[0])).backward()
        torchopt.recover_state_dict(module, start)
        torchopt.recover_state_dict(inner, before)
    return {name: value.grad for name, value in leaves.items()}  # type: ignore[misc]


PEERS: dict[str, Callable[..., Params]] = {
    "PyTorch, loop": by_loop,
    "PyTorch, torch.func": by_vmap,
    "PyTorch, torch.func, compiled": torch.compile(by_vmap),
    "higher": by_higher,
    "TorchOpt": by_torchopt,
}
"""Functions of (parameters, tasks, steps, rate) that compute the meta-gradient."""
