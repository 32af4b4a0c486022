"""What `published.py` trains: rows of tables, each the preset `paper` with some fields changed."""

from typing import Any, NamedTuple

from push_controller import let_control

from milx.config import assemble
from milx.config.assemble import make_config
from milx.config.schema import Config, DataConfig


class Row(NamedTuple):
    """A way to train.

    Attributes:
        label: what the table calls it.
        env: the environment.
        changes: what is changed of the preset `paper`, by dotted name.
        published: what the paper reports.
        shots: demonstrations at test, a result for each.
        method: the method.
    """

    label: str
    env: str
    changes: dict[str, Any]
    published: str = ""
    shots: tuple[int, ...] = (1,)
    method: str = "mil"


def configure(row: Row, shots: int, seed: int) -> Config:
    """Configures a cell of a table."""
    config = let_control(make_config(row.env, row.method, "paper", seed))
    config.evaluation.shots = shots
    for name, value in row.changes.items():
        assemble.assign(config, name, value)
    return config


def _without(changes: dict[str, Any], *groups: str) -> dict[str, Any]:
    """Removes from the changes the fields whose names begin so."""
    return {name: value for name, value in changes.items() if not name.startswith(groups)}


_RAW = {"method.whiten_actions": False, "method.loss_scale": 100.0, "method.inner_lr": 1e-3}
RELEASED = _RAW | {
    "network.fc_init_std": 0.01,
    "optimizer.warmup": 0.0,
    "optimizer.cosine": False,
    "optimizer.clip_norm": None,
    "method.imitation_steps": 0,
}
"""What turns reach's `paper` back into the numbers of the released code."""
_AT_ONCE = {"env.action_cost": 1.0}
_NO_IMITATION = {"method.imitation_steps": 0}
_SHORT = {"train.steps": 5000, "train.eval_every": 1000}
_PLATEAU = {
    "released": ("the released numbers", RELEASED),
    "released-long": ("the released numbers, 20,000 updates", RELEASED | {"train.steps": 20_000}),
    "whitened": ("+ whitened actions", _without(RELEASED, *_RAW)),
    "one-rate": (
        "+ whitened actions, the inner rate of the layers before the last",
        _without(RELEASED, *_RAW) | {"method.inner_lr": 1.6e-3},
    ),
    "lecun": ("+ LeCun's start", _without(RELEASED, *_RAW, "network.")),
    "schedule": ("+ clip, warm-up, cosine", _NO_IMITATION),
    "imitation": ("+ imitation first: `paper`", {}),
    "raw": ("`paper` without whitened actions", _RAW),
    "small-start": ("`paper`, weights from N(0, 0.01)", {"network.fc_init_std": 0.01}),
    "five-tasks": ("`paper`, five tasks in a meta-batch", {"train.meta_batch": 5}),
    "three-frames": (
        "`paper`, 3 time steps of 64 tasks",
        {"train.support_frames": 3, "train.query_frames": 3, "train.meta_batch": 64},
    ),
    "at-once-released": ("the released numbers, an expert that moves at once", _AT_ONCE | RELEASED),
    "at-once-released-long": (
        "the released numbers, that expert, 20,000 updates",
        _AT_ONCE | RELEASED | {"train.steps": 20_000},
    ),
    "at-once-whitened": ("+ whitened actions, that expert", _AT_ONCE | _without(RELEASED, *_RAW)),
    "at-once-schedule": ("+ LeCun's start, clip, warm-up, cosine, that expert", _AT_ONCE | _NO_IMITATION),
    "at-once": ("+ imitation first: `paper`, that expert", _AT_ONCE),
}

_MUON = {"optimizer.name": "muon"}
_BEGINNING = _MUON | {"train.frame_exponent": 2.0}
_SMALL_PIXELS = {"env.image_shape": (32, 40), "train.steps": 12_000}
_TEN = {"train.meta_batch": 16, "train.support_frames": 10, "train.query_frames": 10}
_SMALL: dict[str, tuple[str, dict[str, Any]]] = {
    "all": ("`paper`'s batches", {}),
    "all-muon": ("`paper`'s batches, Muon", _MUON),
    "ten": ("16 tasks of 10 + 10 time steps", _TEN),
    "ten-muon": ("16 tasks of 10 + 10 time steps, Muon", _TEN | _MUON),
    "ten-beginning": ("+ more of the beginning", _TEN | _BEGINNING),
    "ten-at-once": ("+ an expert that moves at once", _TEN | _BEGINNING | _AT_ONCE),
}

_VIDEO_STATE = {"method.given": "video+state", "network.learned_loss": "linear"}
_VIDEO = {
    "method.given": "video",
    "network.learned_loss": "linear",
    "network.heads": 2,
    "network.inner_first_layer": True,
}
_ADAM = {"optimizer.name": "adam"}
_ONE_HEAD = {"network.heads": 1}
_RESULTS = {
    "reach": Row("reach, vision", "reach", {}, "a curve"),
    "reach-small": Row("reach, 32x40 pixels, two cores", "reach", _SMALL_PIXELS | _TEN | _BEGINNING, "a curve"),
    "reach-state": Row("reach, states (three possible tasks)", "reach_state", {}, "a curve"),
    "push": Row("push, one head", "push", _ONE_HEAD, "80.6 / 82.6%", (1, 5)),
    "push-adam": Row("push, one head, Adam", "push", _ADAM | _ONE_HEAD, "80.6 / 82.6%", (1, 5)),
    "push-two-heads": Row("push, two heads", "push", {}, "85.8 / 88.8%", (1, 5)),
    "push-two-heads-adam": Row("push, two heads, Adam", "push", _ADAM, "85.8 / 88.8%", (1, 5)),
    "push-video-state": Row("push, video + state", "push", _VIDEO_STATE, "72.5 / 78.2%", (1, 5)),
    "push-video-state-adam": Row("push, video + state, Adam", "push", _ADAM | _VIDEO_STATE, "72.5 / 78.2%", (1, 5)),
    "push-video": Row("push, video", "push", _VIDEO, "66.4 / 70.5%", (1, 5)),
    "push-video-adam": Row("push, video, Adam", "push", _ADAM | _VIDEO, "66.4 / 70.5%", (1, 5)),
    "place-3000": Row("place, 3,000 training tasks", "place", {"data.tasks": 3000, "train.steps": 10_000}, "90%"),
    "place": Row("place", "place", {}, "90%"),
    "place-video": Row("place, video", "place", _VIDEO, "68.3%"),
}

_SLOWER = _ADAM | {"optimizer.learning_rate": 3e-4}
_BASELINES = {
    f"{env}-{method}-{given.replace('+', '-')}{end}": Row(
        f"{env}, {label}, {given}{how}", env, changes | {"method.given": given}, published, shots, method
    )
    for end, how, changes in (("", "", _SLOWER), ("-muon", ", Muon", _MUON))
    for env, shots, method, label, given, published in (
        ("push", (1, 5), "lstm", "LSTM", "video+state+action", "78.4 / 83.1%"),
        ("push", (1, 5), "lstm", "LSTM", "video+state", "37.6 / 39.6%"),
        ("push", (1, 5), "lstm", "LSTM", "video", "34.2 / 32.0%"),
        ("push", (1, 5), "contextual", "contextual", "video+state", "58.1 / 64.6%"),
        ("push", (1, 5), "contextual", "contextual", "video", "57.0 / 59.0%"),
        ("place", (1,), "lstm", "LSTM", "video+state+action", "25%"),
        ("place", (1,), "contextual", "contextual", "video+state+action", "25%"),
    )
}

_GRASP = {
    "grasp": Row("grasp", "grasp", {}),
    "grasp-lstm": Row("grasp, LSTM", "grasp", _MUON, method="lstm"),
    "grasp-contextual": Row("grasp, contextual", "grasp", _MUON, method="contextual"),
}

_LEARNED = {"data.expert": "pretrained", "data.plan_iterations": DataConfig.plan_iterations}
_GOAL_HEAD = {"network.goal_head": True, "method.goal_weight": 1.0, "network.calibrate": False}
_STEPS = {
    "reach": (
        ("sampled", "3 time steps of 64 tasks", _PLATEAU["three-frames"][1]),
        ("redrawn", "looks and distractors redrawn", {"train.redraw": True}),
        ("rates", "learned inner rates", {"method.learn_inner_lr": True}),
        (
            "network",
            "soft-argmax and the network of `fast`",
            {
                "network.soft_argmax": True,
                "network.strides": (2, 2, 1),
                "network.fc_layers": (200, 200),
                "network.fc_norm": True,
                "network.mixed_precision": True,
            },
        ),
        ("goal-head", "goal head", _GOAL_HEAD),
        ("calibrated", "votes from the camera's calibration", {"network.calibrate": True}),
        (
            "fast",
            "more of the beginning, 12,000 updates, none without an inner step: `fast`",
            {
                "data.plan_iterations": 4,
                "train.frame_exponent": 2.0,
                "train.steps": 12_000,
                "train.eval_every": 4000,
            }
            | _NO_IMITATION,
        ),
    ),
    "push": (
        (
            "sampled",
            "4 and 8 time steps of 32 tasks",
            _ONE_HEAD | {"train.support_frames": 4, "train.query_frames": 8, "train.meta_batch": 32},
        ),
        ("redrawn", "looks redrawn", {"train.redraw": True}),
        ("rates", "learned inner rates", {"method.learn_inner_lr": True}),
        (
            "network",
            "the network, optimizer and rate of `fast`",
            _ADAM
            | {
                "network.filters": (32,) * 4,
                "network.strides": (2, 2, 2, 1),
                "network.fc_norm": True,
                "optimizer.learning_rate": 3e-3,
            },
        ),
        ("goal-head", "goal head", _GOAL_HEAD),
        ("calibrated", "votes from the camera's calibration", {"network.calibrate": True}),
        (
            "fast",
            "30,000 updates, none without an inner step, clip 20",
            {"train.steps": 30_000, "method.inner_clip": 20.0} | _NO_IMITATION,
        ),
        (
            "learned",
            "an expert that has learned, goals after 20 time steps, more of the beginning: `fast`",
            _LEARNED | {"env.goal_step": 20, "train.frame_exponent": 2.0},
        ),
    ),
}


def _ladder() -> dict[str, Row]:
    """Builds the rows from `paper` to `fast`: one of milx's changes at a time on top of those before it."""
    rows = {}
    for env, steps in _STEPS.items():
        rows[env] = _RESULTS[env]
        changes: dict[str, Any] = {}
        for name, label, more in steps:
            changes = changes | more
            rows[f"{env}-{name}"] = Row(f"{env}: + {label}", env, changes)
    return rows


_TWO_STEPS = {"method.inner_steps": 2}
_RELATIVES = {env: _RESULTS[env] for env in ("reach", "push")} | {
    f"{env}-{name}": Row(f"{env}: {label}", env, changes | (_ONE_HEAD if env == "push" else {}))
    for env in ("reach", "push")
    for name, label, changes in (
        ("anil", "the last layer only (ANIL)", {"method.variant": "anil"}),
        ("boil", "all but the last layer (BOIL)", {"method.variant": "boil"}),
        ("cavia", "the bias transformation only (CAVIA)", {"method.variant": "cavia"}),
        ("two-steps", "two inner steps", _TWO_STEPS),
        ("multi-step", "two inner steps, the loss after each (MAML++)", _TWO_STEPS | {"method.variant": "multi_step"}),
    )
}

_SAMPLING = {
    "env.goal_step": 20,
    "data.expert": "sampling",
    "data.plan_iterations": 8,
    "data.plan_batch": 512,
    "evaluation.baseline_trials": 1,
}
_LADDER = _ladder()
_SAMPLED = _LADDER["push-fast"].changes | _SAMPLING
_MORE_TASKS = (
    _SAMPLED
    | _BEGINNING
    | {"data.tasks": 2304, "data.demos_per_task": 4, "train.query_frames": 16, "train.steps": 20_000}
)
_EXPERTS = {
    "push-sampling-beginning": Row(
        "push: `fast`, by sampling",
        "push",
        _SAMPLED | {"train.frame_exponent": 2.0},
    ),
    "push-sampling": Row("push: the first row without more of the beginning", "push", _SAMPLED),
    "push-sampling-tasks": Row(
        "push: the first row, but four demonstrations of 2,304 tasks, 16 query time steps, Muon, 20,000 updates",
        "push",
        _MORE_TASKS,
    ),
    "push-sampling-chunks": Row(
        "push: the second row, but with chunks of four actions, of which the mean is executed",
        "push",
        _MORE_TASKS | {"method.chunk": 4, "method.execute": 0},
    ),
    "push-two-heads-learned": Row("push, two heads, by an expert that has learned: `paper`", "push", _LEARNED),
}

TABLES: dict[str, dict[str, Row]] = {
    "results": _RESULTS,
    "plateau": {name: Row(label, "reach", _SHORT | changes) for name, (label, changes) in _PLATEAU.items()},
    "small": {name: Row(label, "reach", _SMALL_PIXELS | changes) for name, (label, changes) in _SMALL.items()},
    "baselines": _BASELINES,
    "ladder": _LADDER,
    "relatives": _RELATIVES,
    "experts": _EXPERTS,
    "grasp": _GRASP,
}
"""The rows of every table, by name; a row that is one of the results, too, is trained there."""
