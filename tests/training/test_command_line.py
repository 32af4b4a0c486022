"""The command line: help, and bad input that ends with a message instead of a traceback."""

import re
import subprocess
import sys

import pytest


def train(folder, *arguments):
    """Runs `python -m milx.train` in `folder`."""
    return subprocess.run(
        [sys.executable, "-m", "milx.train", *arguments], cwd=folder, capture_output=True, text=True, timeout=120
    )


@pytest.mark.parametrize(
    ("argument", "message", "valid"),
    [
        ("--env=nope", "env: got 'nope'", ["reach"]),
        ("--preset=nope", "preset: got 'nope'", ["paper", "fast", "cpu"]),
        ("--config.train.nope=1", "--config.train.nope: no such field", ["train.steps", "mil.inner_lr", "seed"]),
    ],
)
def test_bad_input_ends_with_a_message_that_lists_what_is_valid(tmp_path, argument, message, valid):
    process = train(tmp_path, argument)
    said = process.stdout + process.stderr
    assert process.returncode != 0
    assert message in said
    assert "Traceback" not in said
    listed = re.split(r"[,\s]+", said.split("expected one of")[1])
    assert set(valid) <= set(listed)
    assert list(tmp_path.iterdir()) == [], "no run was begun"


def test_value_of_another_type_ends_with_a_message(tmp_path):
    process = train(tmp_path, "--config.train.steps=many")
    said = process.stdout + process.stderr
    assert process.returncode != 0
    assert "Traceback" not in said
    assert "train.steps" in said and "many" in said


def test_help_shows_the_flags_and_their_choices(tmp_path):
    said = train(tmp_path, "--help").stdout
    for flag in ("env", "method", "preset", "seed", "workdir"):
        assert re.search(rf"^\s*--(\[no\])?{flag}:", said, re.MULTILINE), flag
    assert "--config.path.to.field=value" in re.sub(r"\s+", "", said)
    assert "Plans demonstrations, meta-trains, evaluates" in said
