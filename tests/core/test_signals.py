"""A process that is told to stop."""

import os
import pathlib
import pty
import signal
import subprocess
import sys
import textwrap
import time

import pytest

import milx

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


LIGHT = f"""
import sys, types
sys.modules["milx"] = types.ModuleType("milx")
sys.modules["milx"].__path__ = [{str(pathlib.Path(milx.__file__).parent)!r}]
"""
"""Makes the modules of milx importable without what `import milx` imports, which takes a second."""


def start(program, *arguments):
    """Starts a Python program that ignores no signal, whatever this process ignores."""
    command = [sys.executable, "-c", LIGHT + textwrap.dedent(program), *map(str, arguments)]
    defaults = lambda: [signal.signal(number, signal.SIG_DFL) for number in SIGNALS]  # noqa: E731
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, **pipes, preexec_fn=defaults, env=environment)


NUMBERS = pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)


@NUMBERS
def test_the_signal_is_noted_where_it_is_deferred_and_what_was_there_before_comes_back(number):
    program = """
    import os, signal, sys, time
    from milx.core import signals
    number = int(sys.argv[1])
    before, stop = signal.getsignal(number), signals.Stop()
    with stop.listen(), stop.deferred():
        os.kill(os.getpid(), number)
        time.sleep(0.5)
        print(stop.asked == number, stop.exit_code == 128 + number, flush=True)
    print(signal.getsignal(number) == before, flush=True)
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
    """
    process = start(program, int(number))
    out, _ = process.communicate()
    assert out.split()[-3:] == ["True"] * 3
    assert process.returncode == -number


@NUMBERS
def test_elsewhere_the_signal_ends_the_process_at_once_with_its_exit_code(number):
    """Signals while the main thread waits for a program of XLA, and another thread would go on for a minute."""
    program = """
    import threading, time
    import jax, jax.numpy as jnp
    from milx.core import signals
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
    process.send_signal(number)
    out, _ = process.communicate()
    assert time.monotonic() - began < 10
    assert process.returncode == 128 + number
    assert out.splitlines()[-1] == "milx: stopped"


def test_a_second_interrupt_ends_the_process_at_once_even_where_the_first_is_deferred():
    program = """
    import time
    from milx.core import signals
    stop = signals.Stop()
    with stop.listen(), stop.deferred():
        print("ready", flush=True)
        time.sleep(0.5)
        print("going on", flush=True)
        time.sleep(60)
    """
    process = start(program)
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline() == "milx: stopping after the updates under way; Ctrl-C again ends at once\n"
    assert process.stdout.readline() == "going on\n"
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.communicate()
    assert time.monotonic() - began < 10
    assert process.returncode == 130


@pytest.mark.parametrize("deferred", ["stop.deferred()", "contextlib.nullcontext()"])
def test_a_terminal_that_closes_stops_the_process_in_order(deferred):
    """Closes the terminal that a process writes to: SIGHUP comes, and nothing can be printed any more."""
    program = f"""
    import contextlib, os, sys, time
    from milx.core import commands, signals
    stop = signals.Stop()
    with commands.command(), stop.listen(), {deferred}:
        print("ready", flush=True)
        for _ in range(100):
            print("working", flush=True)
            print("working", file=sys.stderr, flush=True)
            time.sleep(0.1)
            if stop.asked:
                print("stopped in order")
                sys.exit(stop.exit_code + 100)
    """
    command = [sys.executable, "-c", LIGHT + textwrap.dedent(program)]
    pid, terminal = pty.fork()
    if pid == 0:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        os.execv(command[0], command)
    said = b""
    while b"ready" not in said:
        said += os.read(terminal, 100)
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == (229 if "stop" in deferred else 129)


@pytest.mark.parametrize("deferred", [True, False])
def test_a_pipe_that_nobody_reads_does_not_keep_the_process_alive(deferred):
    """Fills the pipe of the output; then one signal, or two where the first is deferred, end the process."""
    program = f"""
    import contextlib, os, threading, time
    from milx.core import signals
    stop = signals.Stop()
    with stop.listen(), stop.deferred() if {deferred} else contextlib.nullcontext():
        print("ready", flush=True)
        threading.Thread(target=os.write, args=(1, b"x" * 2**20), daemon=True).start()
        time.sleep(60)
    """
    process = start(program)
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.3)
    for _ in range(1 + deferred):
        process.send_signal(signal.SIGINT)
        time.sleep(0.3)
    assert process.wait(10) == 130


@pytest.mark.parametrize("lines", [1, 200])
def test_a_closed_pipe_does_not_end_a_command(lines):
    """Reads one line of a process and closes the pipe; the process goes on to its end."""
    program = f"""
    import sys
    from milx.core import commands
    with commands.command():
        print("ready", flush=True)
        sys.stdin.readline()
        for _ in range({lines}):
            print("x" * 1000)
    sys.exit(7)
    """
    process = start(program)
    assert process.stdout.readline() == "ready\n"
    process.stdout.close()
    process.communicate("closed\n")
    assert process.returncode == 7


def test_signals_that_were_ignored_stay_ignored():
    """As SIGHUP is under nohup."""
    program = """
    import os, signal, time
    from milx.core import signals
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    stop = signals.Stop()
    with stop.listen():
        os.kill(os.getpid(), signal.SIGHUP)
        time.sleep(0.5)
        print(stop.asked, flush=True)
    """
    process = start(program)
    out, _ = process.communicate()
    assert (out, process.returncode) == ("0\n", 0)


def test_in_an_interactive_session_an_interrupt_leaves_the_process_alive():
    program = """
    import os, signal, sys, time
    from milx.core import signals
    sys.ps1 = "> "
    try:
        with signals.Stop().listen():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(60)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
    """
    process = start(program)
    out, _ = process.communicate(timeout=30)
    assert (out, process.returncode) == ("interrupted\n", 0)
