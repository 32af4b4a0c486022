"""Demonstrations are cached under versions of environments and experts: the numbers that every version plans."""

import json
import pathlib

import numpy as np

FILE = pathlib.Path(__file__).parent / "fixtures" / "planned.json"


def check(name: str, version: list[int], found: np.ndarray, atol: float) -> None:
    """Asserts that these versions plan what they planned when their numbers were written down.

    Whoever means to change what is planned raises the version of the environment, or of the experts, and puts the entry
    that this prints into the file.
    """
    entry = {"version": version, "numbers": np.round(np.asarray(found, float).ravel(), 9).tolist()}
    stored = json.loads(FILE.read_text()).get(name, {"version": None, "numbers": []})
    said = f"raise a version, and let {name!r} in {FILE.name} be {json.dumps(entry)}"
    assert stored["version"] == version, said
    np.testing.assert_allclose(entry["numbers"], stored["numbers"], rtol=0, atol=atol, err_msg=said)
