"""Writes a run's best policy as two programs that run without milx, on CPU and CUDA (`milx.deploy.export`).

python -m milx.export runs/reach-mil-fast-0 exported
"""

import pathlib

from absl import app, flags, logging

from milx.core import platform
from milx.core.commands import command
from milx.deploy.export import export
from milx.deploy.pretrained import load


def main(argv: list[str]) -> None:
    """Exports the run RUN to the folder OUT."""
    if len(argv) != 3:
        raise app.UsageError("expected two arguments, RUN and OUT")
    logging.set_verbosity(logging.WARNING)
    platform.configure()
    with command():
        platform.require_device()
        export(load(argv[1]), argv[2], flags.FLAGS.shots)
        size = sum(path.stat().st_size for path in pathlib.Path(argv[2]).iterdir())
        print(f"{argv[2]}: {size / 1e6:.1f} MB. To load it, use `from policy import Policy` in that folder.")


if __name__ == "__main__":
    flags.DEFINE_integer("shots", 1, "Number of demonstrations that the exported policy adapts to.", lower_bound=1)
    app.run(main)
