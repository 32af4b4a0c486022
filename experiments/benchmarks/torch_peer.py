"""The same meta-step in PyTorch: what a user of learn2learn, higher or torch.func would run.

Network, losses and update are those of `milx.methods.mil` with a fixed inner rate, images come as uint8.
"""

from collections.abc import Callable

import torch
from torch.nn import functional

from milx.config.schema import Config
from milx.methods.mil import MILConfig
from milx.networks.policy_network import PolicyConfig


def same(x: torch.Tensor, kernel: int, stride: int) -> torch.Tensor:
    """Pads [B, C, H, W] as TensorFlow's SAME does."""
    pads = []
    for size in (x.shape[3], x.shape[2]):
        total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
        pads += [total // 2, total - total // 2]
    return functional.pad(x, pads)


def norm(x: torch.Tensor) -> torch.Tensor:
    """Normalizes over all axes but the first; written out, for the sake of its second derivative."""
    axes = tuple(range(1, x.ndim))
    centered = x - x.mean(axes, keepdim=True)
    return centered * torch.rsqrt(centered.square().mean(axes, keepdim=True) + 1e-6)


def make_params(config: Config, image: tuple[int, int], state: int, action: int) -> dict[str, torch.Tensor]:
    """Samples parameters."""
    net, channels, (height, width) = config.network, 3, image
    assert isinstance(net, PolicyConfig)
    params: dict[str, torch.Tensor] = {}
    for i, (filters, stride) in enumerate(zip(net.filters, net.strides, strict=True)):
        fan_in = channels * net.kernel**2
        params[f"conv{i}"] = torch.randn(filters, channels, net.kernel, net.kernel) / fan_in**0.5
        params[f"bias{i}"], params[f"centre{i}"] = torch.zeros(filters), torch.zeros(filters)
        channels, height, width = filters, -(-height // stride), -(-width // stride)
    features = (2 * channels if net.soft_argmax else channels * height * width) + state + net.bias_transformation
    params["z"] = torch.zeros(net.bias_transformation)
    for i, size in enumerate((*net.fc_layers, *[action] * net.heads)):
        params[f"fc{i}"], params[f"fb{i}"] = torch.randn(features, size) / features**0.5, torch.zeros(size)
        features = size if i < len(net.fc_layers) else features
    return {name: value.cuda() for name, value in params.items()}


def make_step(config: Config, mode: str, bf16: bool) -> Callable[..., dict[str, torch.Tensor]]:
    """Makes a function of (params, images [N, 2, T, H, W, 3] uint8, states, actions) that computes the meta-gradient.

    Args:
        config: network and inner step.
        mode: "loop" over tasks with autograd, "vmap" with torch.func, or "compile", the same through torch.compile.
        bf16: convolve in bfloat16.
    """
    net, mil = config.network, config.method
    assert isinstance(net, PolicyConfig) and isinstance(mil, MILConfig)
    depth = len(net.fc_layers)
    dtype = torch.bfloat16 if bf16 else torch.float32

    def forward(params: dict, image: torch.Tensor, state: torch.Tensor, head: int) -> torch.Tensor:
        x = (image.permute(0, 3, 1, 2).float() / 255).to(dtype).contiguous()
        for i, stride in enumerate(net.strides):
            x = functional.conv2d(same(x, net.kernel, stride), params[f"conv{i}"].to(dtype), stride=stride)
            x = x.float() + params[f"bias{i}"][:, None, None]
            x = norm(x) + params[f"centre{i}"][:, None, None]
            x = functional.relu(x).to(dtype)
        x = x.float()
        if net.soft_argmax:
            height, width = x.shape[2:]
            attention = x.flatten(2).softmax(-1).reshape(x.shape)
            ys, xs = (torch.linspace(-1, 1, n, device=x.device) for n in (height, width))
            x = torch.cat([(attention.sum(2) * xs).sum(-1), (attention.sum(3) * ys).sum(-1)], -1)
        x = torch.cat([x.flatten(1), state, params["z"].expand(len(x), -1)], -1)
        for i in range(depth):
            x = x @ params[f"fc{i}"] + params[f"fb{i}"]
            x = functional.relu(norm(x) if net.fc_norm else x)
        return x @ params[f"fc{depth + head}"] + params[f"fb{depth + head}"]

    def loss(params: dict, image: torch.Tensor, state: torch.Tensor, action: torch.Tensor, head: int) -> torch.Tensor:
        return (mil.loss_scale * (forward(params, image, state, head) - action)).square().mean()

    def update(params: dict, grads: dict) -> dict:
        return {k: p - mil.inner_lr * grads[k].clamp(-mil.inner_clip, mil.inner_clip) for k, p in params.items()}

    def task_loss(params: dict, image: torch.Tensor, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        grads = torch.func.grad(loss)(params, image[0], state[0], action[0], 0)
        return loss(update(params, grads), image[1], state[1], action[1], net.heads - 1)

    def by_vmap(params: dict, image: torch.Tensor, state: torch.Tensor, action: torch.Tensor) -> dict:
        tasks = torch.func.vmap(task_loss, in_dims=(None, 0, 0, 0))
        return torch.func.grad(lambda params: tasks(params, image, state, action).mean())(params)

    def by_loop(params: dict, image: torch.Tensor, state: torch.Tensor, action: torch.Tensor) -> dict:
        # Only here: torch.func would record a graph of its own work for parameters that require gradients.
        params = {name: value.detach().requires_grad_() for name, value in params.items()}
        names, total = list(params), dict.fromkeys(params, 0.0)
        for i, s, a in zip(image, state, action, strict=True):
            inner = loss(params, i[0], s[0], a[0], 0)
            grads = torch.autograd.grad(inner, list(params.values()), create_graph=True, allow_unused=True)
            filled = {k: torch.zeros_like(params[k]) if g is None else g for k, g in zip(names, grads, strict=True)}
            outer = loss(update(params, filled), i[1], s[1], a[1], net.heads - 1) / len(image)
            grads = torch.autograd.grad(outer, list(params.values()), allow_unused=True)
            total = {k: total[k] + (0.0 if g is None else g) for k, g in zip(names, grads, strict=True)}
        return total

    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    torch.backends.cudnn.benchmark = True
    return {"loop": by_loop, "vmap": by_vmap, "compile": torch.compile(by_vmap)}[mode]
