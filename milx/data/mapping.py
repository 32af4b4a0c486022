"""JSON files that map names to names: episodes to tasks, and tasks to families."""

import pathlib
from typing import Any

from milx.core import files
from milx.core.files import FileError


def read_named(path: str | pathlib.Path, field: str) -> Any:
    """Reads a JSON file that a person named, also through links.

    Args:
        path: the file.
        field: what errors call it.

    Raises:
        ValueError: if it cannot be read, or does not hold JSON.
    """
    try:
        return files.read_json(pathlib.Path(path).resolve())
    except FileError as error:
        raise ValueError(f"{field}: expected a JSON file at {path}: {error}") from error


def read_mapping(path: str | pathlib.Path, field: str) -> dict[str, str]:
    """Reads a JSON object from names to names.

    Args:
        path: the file.
        field: what errors call it.

    Raises:
        ValueError: for a file that holds something else.
    """
    mapping = read_named(path, field)
    if not isinstance(mapping, dict) or not all(isinstance(name, str) for name in mapping.values()):
        raise ValueError(f"{field}: {path}: expected a JSON object from names to names")
    return mapping


def lookup(mapping: dict[str, str], name: str, path: str, field: str) -> str:
    """Looks a name up.

    Raises:
        FileError: if the mapping does not say.
    """
    if name not in mapping:
        raise FileError(f"{field}: {path} does not say where {name!r} belongs, expected all names in it")
    return mapping[name]
