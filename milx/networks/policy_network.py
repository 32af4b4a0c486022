"""The policy network of the paper: convolutions, then fully connected layers that also see the robot's state."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from milx.config.schema import LARGEST_SIZE, ConvConfig, NetworkConfig, VisionConfig, number
from milx.networks.goal import Goal, GoalHead, HindsightHead, StateGoalHead
from milx.networks.layers import ConvBlock, Dense, FixedConv, SpatialSoftArgmax
from milx.networks.learned_loss import LearnedLoss
from milx.types import ImageShape, Params, black


@dataclasses.dataclass
class PolicyConfig(VisionConfig):
    """The network of MIL.

    Attributes:
        bias_transformation: size of the learned vector beside the first fully connected layer's input; 0 for none.
        heads: 1, or 2 for a separate output layer in the inner loss.
        inner_first_layer: a first fully connected layer of its own in the inner loss, as in the released code where
            demonstrations are video alone.
        target_head: predict where the episode ends with a linear layer from the first image's features, and show the
            prediction to the layers after it, as the paper does (Section 6.3); its squared error joins all losses.
        hindsight_head: where a demonstration is video alone, learn to tell from its first and last image what the goal
            head is to see in the first, and let that be the goal in the inner step.
        learned_loss: the inner loss where demonstrations show no actions (`MethodConfig.given`): "linear", or
            "temporal" with convolutions over time (`milx.networks.learned_loss`); None where they show them.
    """

    bias_transformation: int = number(10, 0, LARGEST_SIZE)
    heads: int = number(1, 1, 2)
    inner_first_layer: bool = False
    target_head: bool = False
    hindsight_head: bool = False
    learned_loss: str | None = None


BIAS_TRANSFORMATION = "bias_transformation"
"""The parameter that joins the input of the first fully connected layer."""


class PolicyOutput(NamedTuple):
    """What the network says of a batch of observations.

    Attributes:
        action: [B, A] of the head that acts, in the network's units.
        inner_action: [B, A] of the head that the inner loss sees; the same head if there is only one.
        goal: where the episode will end; None without a goal head.
        feature_map: [B, H, W, C] what the convolutions make of the (first camera's) image; None where the policy sees
            no pixels.
        features: [B, F] what the last layer sees in the inner loss.
        target: [B, G] whitened, as a target head has it; None without one.
    """

    action: jax.Array
    inner_action: jax.Array
    goal: Goal | None
    feature_map: jax.Array | None
    features: jax.Array
    target: jax.Array | None = None


class PolicyNetwork(NamedTuple):
    """The network as pure functions.

    Attributes:
        init: key -> params.
        apply: (params, image [B, H, W, 3 N] uint8 or None, whitened state [B, S]) -> PolicyOutput. With several cameras
            `image` is a dictionary of images by name. For a target head it takes two more: `length`, as many
            consecutive images as show one episode, whose first tells the target of all; and `target` [B, G], where it
            is known already, NaN where it is not.
        learned_loss: (params, features [K, T, F]) -> [K], the loss of demonstrations without actions; None without one.
        hindsight: (params, feature maps of videos [K, T, H, W, C]) -> Goal, where the robot went in each; None without
            such a head.
        output_layers: names of the parameters of the last layer of each head.
        has_target: whether there is a target head.
    """

    init: Callable[[jax.Array], Params]
    apply: Callable[..., PolicyOutput]
    learned_loss: Callable[[Params, jax.Array], jax.Array] | None = None
    hindsight: Callable[[Params, jax.Array], Goal] | None = None
    output_layers: tuple[str, ...] = ()
    has_target: bool = False


class ConvStack(nn.Module):
    """All convolutions: images [B, H, W, 3 N] uint8 to a feature map [B, H', W', C] of the parameters' type."""

    config: ConvConfig

    @nn.compact
    def __call__(self, image: jax.Array, dtype: jnp.dtype) -> jax.Array:
        """Computes the features; `dtype` is that of the parameters."""
        config = self.config
        x = image.astype(dtype) / 255.0
        block = nn.remat(ConvBlock) if config.rematerialise else ConvBlock
        for i, (filters, stride) in enumerate(zip(config.filters, config.strides, strict=True)):
            layer = FixedConv if i == 0 and config.fixed_filters else block
            x = layer(filters, config.kernel, stride, config.mixed_precision, name=f"ConvBlock_{i}")(x)
            for j in range(config.residual_blocks):
                first, second = (
                    block(filters, config.kernel, 1, config.mixed_precision, name=f"Residual_{i}_{j}_{k}")
                    for k in range(2)
                )
                x = second(first(x), x)
        return x.astype(dtype)


FeatureMaps = jax.Array | dict[str, jax.Array] | None
"""A feature map [B, H', W', C]; with several cameras one for each by name, None where the policy sees no pixels."""


def see(config: VisionConfig, image: Any, dtype: jnp.dtype) -> FeatureMaps:
    """Applies the convolutions of the module that calls this: to images, those of each camera, or none."""
    if image is None:
        return None
    if not isinstance(image, dict):
        return ConvStack(config, name="vision")(image, dtype)
    if config.share_encoder:
        shared = ConvStack(config, name="vision")
        return {camera: shared(image[camera], dtype) for camera in sorted(image)}
    return {camera: ConvStack(config, name=f"vision_{camera}")(image[camera], dtype) for camera in sorted(image)}


def listed(features: FeatureMaps) -> list[jax.Array]:
    """Lists the feature maps of all cameras, in the order of their names."""
    return jax.tree.leaves(features)


def goal_camera(image_shape: ImageShape) -> str | None:
    """Returns the camera that a goal head looks at, the first of several."""
    return next(iter(image_shape)) if isinstance(image_shape, dict) else None


class Controller(nn.Module):
    """From feature maps and the robot's state to an action.

    Attributes:
        config: its layers.
        action_size: A.
        goal_size: G; 0 for no goal head and no target head, whatever the following say.
        soft_argmax, goal_head: as in `VisionConfig`.
        heads, inner_first_layer, target_head: as in `PolicyConfig`.
        goal_camera: with several cameras, the one whose features the goal head sees.
    """

    config: NetworkConfig
    action_size: int
    goal_size: int
    soft_argmax: bool = False
    goal_head: bool = False
    heads: int = 1
    inner_first_layer: bool = False
    target_head: bool = False
    goal_camera: str | None = None

    @nn.compact
    def __call__(
        self,
        features: FeatureMaps,
        state: jax.Array,
        context: jax.Array,
        query: jax.Array | None = None,
        length: int = 1,
        target: jax.Array | None = None,
    ) -> PolicyOutput:
        """Acts.

        Args:
            features: [B, H, W, C] of one camera or several; None where the policy sees no pixels.
            state: [B, S] whitened.
            context: [B, D], joins the input of the first fully connected layer.
            query: [B, C] or, without features, [B, candidates]: tells the goal head what to look for; None for nothing.
            length: as many consecutive rows are one episode, see `PolicyNetwork.apply`.
            target: [B, G] for a target head, see there; None if it is not known at all.
        """
        config, goal, seen_target = self.config, None, None
        parts, has_goal = [state, context], self.goal_head and self.goal_size
        if features is not None:
            flat = (SpatialSoftArgmax()(x) if self.soft_argmax else x.reshape(len(x), -1) for x in listed(features))
            seen = jnp.concatenate(list(flat), axis=-1)
            parts = [seen, *parts]
            if self.target_head and self.goal_size:
                first = jnp.repeat(seen[::length], length, axis=0)
                seen_target = Dense(self.goal_size, name="target_head")(first)
                if target is not None:
                    seen_target = jnp.where(jnp.isnan(target), seen_target, target)
                parts.append(seen_target)
        main = features[self.goal_camera or min(features)] if isinstance(features, dict) else features
        if has_goal:
            head, on = (StateGoalHead, state) if main is None else (GoalHead, main)
            goal = head(self.goal_size, name="goal_head")(on, query)
            parts.append(goal.mean)
        seen = jnp.concatenate(parts, axis=-1)
        hidden = functools.partial(Dense, hidden=True, norm=config.fc_norm, init_std=config.fc_init_std)
        layers = [hidden(size) for size in config.fc_layers]
        heads = [Dense(self.action_size, init_std=config.fc_init_std) for _ in range(self.heads)]
        x = inner = _through(layers, seen)
        if self.inner_first_layer:
            inner = _through([hidden(config.fc_layers[0], name="inner_first"), *layers[1:]], seen)
        return PolicyOutput(heads[-1](x), heads[0](inner), goal, main, inner, seen_target)


def _through(layers: list[Dense], x: jax.Array) -> jax.Array:
    return functools.reduce(lambda x, layer: layer(x), layers, x)


class _Policy(nn.Module):
    config: PolicyConfig
    action_size: int
    goal_size: int
    goal_camera: str | None

    @nn.compact
    def __call__(self, image: Any, state: jax.Array, length: int = 1, target: jax.Array | None = None) -> PolicyOutput:
        # A learned constant joins the input of the first layer: its gradient gives the layer's bias a step of its own
        # (the paper's bias transformation, Section 4.1).
        config, size = self.config, self.config.bias_transformation
        z = self.param(BIAS_TRANSFORMATION, nn.initializers.zeros, (size,))
        features = see(config, image, state.dtype)
        controller = Controller(
            config,
            self.action_size,
            self.goal_size,
            soft_argmax=config.soft_argmax,
            goal_head=config.goal_head,
            heads=config.heads,
            inner_first_layer=config.inner_first_layer,
            target_head=config.target_head,
            goal_camera=self.goal_camera,
            name="controller",
        )
        return controller(features, state, jnp.broadcast_to(z, (len(state), size)), None, length, target)


def make_policy(
    config: PolicyConfig,
    image_shape: ImageShape,
    state_size: int,
    action_size: int,
    goal_size: int,
    history: int = 1,
) -> PolicyNetwork:
    """Builds the policy network.

    Args:
        config: layers and heads.
        image_shape: (H, W); with several cameras a dictionary of them by name, the first of which the goal head looks
            at; None where the policy sees no pixels.
        state_size: S.
        action_size: A.
        goal_size: G, entries of the state that the goal head predicts.
        history: N, images of a camera that are side by side in the channels.
    """
    module = _Policy(config, action_size, goal_size, goal_camera(image_shape))
    image = black(image_shape, (1,), history)

    loss, head = LearnedLoss(config.learned_loss or "linear"), HindsightHead(goal_size)

    def init(key: jax.Array) -> Params:
        output, variables = module.init_with_output(key, image, jnp.zeros((1, state_size)))
        params = variables["params"]
        if config.learned_loss is not None:
            start = loss.init(jax.random.fold_in(key, 1), output.features[None])
            params = {**params, "learned_loss": start["params"]}
        if config.hindsight_head:
            start = head.init(jax.random.fold_in(key, 2), output.feature_map[None])
            params = {**params, "hindsight": start["params"]}
        return params

    def apply(
        params: Params,
        image: Any,
        state: jax.Array,
        length: int = 1,
        target: jax.Array | None = None,
    ) -> PolicyOutput:
        output = module.apply({"params": params}, image, state, length, target)
        assert isinstance(output, PolicyOutput)
        return output

    def learned_loss(params: Params, features: jax.Array) -> jax.Array:
        value = loss.apply({"params": params["learned_loss"]}, features)
        assert isinstance(value, jax.Array)
        return value

    def hindsight(params: Params, feature_maps: jax.Array) -> Goal:
        goal = head.apply({"params": params["hindsight"]}, feature_maps)
        assert isinstance(goal, Goal)
        return goal

    return PolicyNetwork(
        init,
        apply,
        None if config.learned_loss is None else learned_loss,
        hindsight if config.hindsight_head else None,
        tuple(f"Dense_{len(config.fc_layers) + i}" for i in range(config.heads)),
        bool(config.target_head and goal_size and image_shape),
    )
