"""Runs many scripts side by side, on one GPU or several: each takes the next one when it is free.

    python experiments/paper/spread.py --gpus=2 --each=3 --logs=logs \
        'published.py --table=results --rows=reach --seeds=1' 'published.py --table=results --rows=push --seeds=1'

The scripts are restartable, so this is, too. Put first what others need: whoever plans demonstrations caches them.
"""

import os
import pathlib
import queue
import shlex
import subprocess
import sys
import threading
import time

from absl import app, flags

_GPUS = flags.DEFINE_integer("gpus", 1, "How many GPUs there are.", lower_bound=1)
_EACH = flags.DEFINE_integer("each", 2, "Processes that share a GPU.", lower_bound=1)
_LOGS = flags.DEFINE_string("logs", "logs", "Folder of what they print, a file for each.")


def main(argv: list[str]) -> None:
    """Runs all, and says which failed."""
    waiting: queue.SimpleQueue[tuple[int, str]] = queue.SimpleQueue()
    for number, command in enumerate(argv[1:]):
        waiting.put((number, command))
    logs, failed = pathlib.Path(_LOGS.value).resolve(), []
    logs.mkdir(parents=True, exist_ok=True)

    def work(gpu: int) -> None:
        while True:
            try:
                number, command = waiting.get_nowait()
            except queue.Empty:
                return
            environment = {**os.environ, "CUDA_VISIBLE_DEVICES": str(gpu), "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
            began = time.perf_counter()
            with (logs / f"{number:03d}.log").open("w") as log:
                script = [sys.executable, "-u", *shlex.split(command)]
                code = subprocess.call(
                    script, env=environment, cwd=pathlib.Path(__file__).parent, stdout=log, stderr=subprocess.STDOUT
                )
            print(f"{code}, {time.perf_counter() - began:.0f} s on GPU {gpu}: {command}", flush=True)
            if code:
                failed.append(command)

    threads = [threading.Thread(target=work, args=(gpu,)) for gpu in range(_GPUS.value) for _ in range(_EACH.value)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failed:
        sys.exit(f"spread: {len(failed)} failed; see {logs}")


if __name__ == "__main__":
    app.run(main)
