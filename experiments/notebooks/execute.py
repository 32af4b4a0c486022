"""Executes the notebooks from top to bottom at their full size and stores their outputs in them.

python experiments/notebooks/execute.py               # executes all of them
python experiments/notebooks/execute.py quickstart    # executes one
"""

import pathlib
import sys
import tempfile

import nbformat
from absl import app
from nbclient import NotebookClient

FOLDER = pathlib.Path(__file__).parent
WIDGET = "application/vnd.jupyter.widget-view+json"


def executed(name: str, folder: pathlib.Path) -> nbformat.NotebookNode:
    """Executes a notebook in `folder` and returns it with its outputs.

    The kernel is the interpreter that runs this function, whatever kernels are installed.

    Raises:
        nbclient.exceptions.CellExecutionError: if a cell fails.
    """
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    client = NotebookClient(notebook, timeout=3600, record_timing=False, resources={"metadata": {"path": str(folder)}})
    client.create_kernel_manager()
    client.km.kernel_spec.argv[0] = sys.executable
    return client.execute()


def _is_shown(output: nbformat.NotebookNode) -> bool:
    """Tells whether an output is worth storing; progress bars and messages of libraries are not."""
    if output.output_type == "stream":
        return output.name == "stdout"
    return WIDGET not in output.data and output.data.get("text/plain") != ""


def main(argv: list[str]) -> None:
    """Executes the named notebooks, or all of them."""
    for name in argv[1:] or sorted(path.stem for path in FOLDER.glob("*.ipynb")):
        with tempfile.TemporaryDirectory() as folder:
            notebook = executed(name, pathlib.Path(folder))
        for cell in notebook.cells:
            if cell.cell_type == "code":
                cell.outputs = [output for output in cell.outputs if _is_shown(output)]
        notebook.metadata.pop("widgets", None)
        nbformat.write(notebook, FOLDER / f"{name}.ipynb")
        print(f"{name}: done", flush=True)


if __name__ == "__main__":
    app.run(main)
