"""From a user's files to a robot: importing a LeRobot set, and the exported push policy on the CPU.

    python experiments/benchmarks/deploy.py

The set is 50 tasks x 4 episodes of 100 frames at 128x128, made up here in LeRobot's layout. The policy has the network
of a push preset, untrained; it is exported, and loaded and timed in a process without milx.
"""

import json
import pathlib
import subprocess
import sys
import tempfile
import time

import av
import common
import jax
import jax.numpy as jnp
import numpy as np
import pyarrow
import pyarrow.parquet
from absl import app, flags

import milx
from milx import envs, methods
from milx.config.assemble import make_config
from milx.data import episodes
from milx.data.lerobot import LeRobot
from milx.deploy.policy import Policy
from milx.export import export
from milx.methods.whitening import Whitening

_OUT = flags.DEFINE_string("out", "experiments/results/benchmarks", "Folder of the JSON file.")
TASKS, EPISODES, FRAMES, SIZE, FPS = 50, 4, 100, 128, 30
CONTROL = """
import json, sys, time
sys.path.insert(0, sys.argv[1])
import numpy as np
from policy import Policy
began = time.perf_counter()
policy, rng = Policy(sys.argv[1]), np.random.default_rng(0)
draw = lambda shape, name: rng.integers(0, 256, shape, np.uint8) if name == "image" else rng.normal(size=shape)
demo = {name: draw(shape, name) for name, shape in policy.sizes["adapt"].items()}
seen = {name: draw(shape, name) for name, shape in policy.sizes["act"].items()}
task_params = policy.adapt(**demo)
np.asarray(policy.act(task_params, **seen))
ready = time.perf_counter() - began
def timed(function):
    began = time.perf_counter()
    function()
    return time.perf_counter() - began
adapt = lambda: [np.asarray(leaf) for leaf in policy.adapt(**demo)]
act = lambda: np.asarray(policy.act(task_params, **seen))
both = [timed(lambda: (adapt(), [act() for _ in range(100)])) for _ in range(5)]
print(json.dumps([ready, np.median([timed(adapt) for _ in range(5)]), np.median([timed(act) for _ in range(300)]),
                  np.quantile([timed(act) for _ in range(300)], 0.99), np.median(both)]))
"""


CODECS = {"AV1, as LeRobot writes": "libsvtav1", "H.264": "h264"}


def write_lerobot(root: pathlib.Path, codec: str) -> None:
    """Writes a set in LeRobot's layout, version 3: one video, of moving squares on noise, and one table."""
    rng, count = np.random.default_rng(0), TASKS * EPISODES
    video = root / "videos/observation.images.top/chunk-000/file-000.mp4"
    video.parent.mkdir(parents=True)
    with av.open(str(video), "w") as container:
        stream = container.add_stream(codec, rate=FPS, options={"g": "2", "crf": "30"})
        assert isinstance(stream, av.VideoStream)
        stream.width = stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        background = rng.integers(0, 256, (16, 16, 3), np.uint8).repeat(8, axis=0).repeat(8, axis=1)
        for i in range(count * FRAMES):
            image = background.copy()
            at = 5 + i % 100
            image[at : at + 16, at : at + 16] = 255
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    vector = {"dtype": "float32", "shape": [7]}
    features = {"observation.state": vector, "action": vector}
    features["observation.images.top"] = {"dtype": "video", "shape": [SIZE, SIZE, 3]}
    info = {
        "codebase_version": "v3.0",
        "fps": FPS,
        "features": features,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    numbers, episode = np.arange(count), np.repeat(np.arange(count), FRAMES)
    vectors = rng.normal(size=(count * FRAMES, 7)).astype(np.float32).tolist()
    prefix = "videos/observation.images.top"
    tables = {
        "data/chunk-000": {"episode_index": episode, "observation.state": vectors, "action": vectors},
        "meta/episodes/chunk-000": {
            "episode_index": numbers,
            "tasks": [[f"task {i // EPISODES}"] for i in numbers],
            "length": np.full(count, FRAMES),
            **{name: 0 * numbers for name in ("data/chunk_index", "data/file_index")},
            **{name: 0 * numbers for name in (f"{prefix}/chunk_index", f"{prefix}/file_index")},
            f"{prefix}/from_timestamp": numbers * FRAMES / FPS,
        },
    }
    for folder, columns in tables.items():
        (root / folder).mkdir(parents=True)
        pyarrow.parquet.write_table(pyarrow.table(columns), root / folder / "file-000.parquet")
    (root / "meta/info.json").write_text(json.dumps(info))


def measure_import(folder: pathlib.Path, report: common.Report) -> None:
    """Rows of importing a set, by codec."""
    for name, codec in CODECS.items():
        root, out = folder / f"lerobot-{codec}", folder / f"set-{codec}"
        write_lerobot(root, codec)
        began = time.perf_counter()
        source = LeRobot(root, None, "observation.state", "action", SIZE)
        episodes.write(out, source.episodes("task_index"), source.contents, (0.1, 0.1), "benchmark")
        rate = TASKS * EPISODES * FRAMES / (time.perf_counter() - began)
        note = f"{TASKS} x {EPISODES} x {FRAMES} frames of {SIZE}x{SIZE}"
        report.add(f"LeRobot import, {name}", rate, "frames/s", note=note)


def measure_export(preset: str, folder: pathlib.Path, report: common.Report) -> None:
    """Rows of an exported push policy, in a process of its own."""
    config, env = make_config("push", preset=preset), envs.make("push")
    spec = env.spec
    sizes = [spec.state_size] * 2 + [spec.action_size] * 2
    whitening = Whitening(*(jnp.full(n, i % 2, jnp.float32) for i, n in enumerate(sizes)))
    method = methods.make(config, spec)
    policy = Policy(method, spec, jax.jit(method.init)(jax.random.key(0), whitening), config)
    out = folder / preset
    export(policy, out)
    size = sum(path.stat().st_size for path in out.iterdir()) / 1e6
    done = subprocess.run([sys.executable, "-c", CONTROL, str(out)], capture_output=True, text=True, check=True)
    ready, adapt, act, slow, both = json.loads(done.stdout.splitlines()[-1])
    name = f"exported push policy ({preset})"
    report.add(f"{name}: size", size, "MB")
    report.add(f"{name}: loading and compiling", ready, "s")
    report.add(f"{name}: adapt", 1e3 * adapt, "ms", note="one demonstration of 100 steps, 125x125")
    report.add(f"{name}: act", 1e3 * act, "ms")
    report.add(f"{name}: act, 99th percentile", 1e3 * slow, "ms")
    report.add(f"{name}: adapt and 100 acts", both, "s")


def main(_: list[str]) -> None:
    """Measures and writes the JSON file."""
    milx.configure()
    report = common.Report("deploy", pathlib.Path(_OUT.value))
    with tempfile.TemporaryDirectory() as folder:
        measure_import(pathlib.Path(folder), report)
        for preset in ("paper", "fast"):
            measure_export(preset, pathlib.Path(folder), report)


if __name__ == "__main__":
    app.run(main)
