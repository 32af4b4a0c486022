"""Executes the notebooks from top to bottom at their full size and stores their outputs in them.

python experiments/notebooks/execute.py               # executes all of them
python experiments/notebooks/execute.py quickstart    # executes one
"""

import pathlib
import re
import sys
import tempfile

import nbformat
from absl import app
from nbclient import NotebookClient

FOLDER = pathlib.Path(__file__).parent
WIDGET = "application/vnd.jupyter.widget-view+json"
TEMPORARY = re.compile(re.escape(tempfile.gettempdir()) + r"/tmp\w{8}")
"""The path of a folder that `tempfile` has made."""


def executed(name: str, folder: pathlib.Path) -> nbformat.NotebookNode:
    """Executes a notebook in `folder` and returns it with its outputs.

    The kernel is the interpreter that runs this function, whatever kernels are installed.

    Raises:
        nbclient.exceptions.CellExecutionError: if a cell fails.
    """
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    client = NotebookClient(notebook, timeout=3600, record_timing=False, resources={"metadata": {"path": str(folder)}})
    client.create_kernel_manager()
    assert client.km is not None and client.km.kernel_spec is not None
    client.km.kernel_spec.argv[0] = sys.executable
    return client.execute()


def _is_shown(output: nbformat.NotebookNode) -> bool:
    """Tells whether an output is worth storing; progress bars and messages of libraries are not."""
    if output.output_type == "stream":
        return output.name == "stdout"
    return WIDGET not in output.data and output.data.get("text/plain") != ""


def neutral(text: str) -> str:
    """Replaces the paths of temporary folders, which are others in every run, by one that stays the same."""
    return TEMPORARY.sub("/tmp/notebook", text)


def main(argv: list[str]) -> None:
    """Executes the named notebooks, or all of them."""
    for name in argv[1:] or sorted(path.stem for path in FOLDER.glob("*.ipynb")):
        with tempfile.TemporaryDirectory() as folder:
            notebook = executed(name, pathlib.Path(folder))
        for cell in notebook.cells:
            if cell.cell_type == "code":
                cell.outputs = [output for output in cell.outputs if _is_shown(output)]
        notebook.metadata.pop("widgets", None)
        (FOLDER / f"{name}.ipynb").write_text(neutral(nbformat.writes(notebook)) + "\n")
        print(f"{name}: done", flush=True)


if __name__ == "__main__":
    app.run(main)
