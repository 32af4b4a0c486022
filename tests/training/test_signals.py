"""One trainer for a folder, and a process that is told to stop."""

import os
import pathlib
import signal
import subprocess
import sys
import textwrap
import time

import pytest

from milx.training import signals

HOLD = """
import pathlib, sys, time
from milx.training import signals
with signals.one_trainer(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def start(program, *arguments):
    command = [sys.executable, "-c", textwrap.dedent(program), *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def test_a_second_trainer_is_refused_while_the_first_lives_and_admitted_after_it_died(tmp_path):
    first = start(HOLD, tmp_path)
    assert first.stdout.readline() == "held\n"
    held = rf"workdir: .* is in use by process {first.pid} on .*, expected no other"
    with pytest.raises(ValueError, match=held), signals.one_trainer(tmp_path):
        pass
    first.kill()
    first.wait()
    with signals.one_trainer(tmp_path):
        assert f"process {os.getpid()} " in (tmp_path / "lock").read_text()
        with pytest.raises(ValueError, match=rf"in use by process {os.getpid()} "), signals.one_trainer(tmp_path):
            pass
    with signals.one_trainer(pathlib.Path(tmp_path)):
        pass


def test_the_signal_is_noted_where_it_is_deferred_and_what_was_there_before_comes_back():
    program = """
    import os, signal, time
    from milx.training import signals
    before, stop = signal.getsignal(signal.SIGTERM), signals.Stop()
    with stop.listen(), stop.deferred():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.5)
        print(stop.asked, flush=True)
    print(signal.getsignal(signal.SIGTERM) == before, flush=True)
    os.kill(os.getpid(), signal.SIGTERM)
    """
    process = start(program)
    out, _ = process.communicate()
    assert out.split() == ["True", "True"]
    assert process.returncode == -signal.SIGTERM


def test_elsewhere_the_signal_ends_the_process_at_once_and_well():
    """Signals while the main thread waits for a program of XLA, and another thread would go on for a minute."""
    program = """
    import threading, time
    import jax, jax.numpy as jnp
    from milx.training import signals
    count = jax.jit(lambda n: jax.lax.fori_loop(0, n, lambda i, x: jnp.sin(x), 1.0)).lower(1).compile()
    stop = signals.Stop()
    with stop.listen():
        threading.Thread(target=time.sleep, args=(60,)).start()
        print("ready", flush=True)
        count(2**31 - 1).block_until_ready()
    """
    process = start(program)
    assert process.stdout.readline() == "ready\n"
    began = time.monotonic()
    process.terminate()
    out, _ = process.communicate()
    assert time.monotonic() - began < 10
    assert process.returncode == 0
    assert "the same command goes on" in out
