"""Ctrl-C and SIGTERM: what they stop, when, and the exit code."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from wlm.cli.signals import deferred_interrupt, exit_code, handled

SIGNALS = {signal.SIGINT: 130, signal.SIGTERM: 143}

# A command that gets signals at exact places.
_COMMAND = """
import atexit, os, sys
from wlm.cli import app, console, main

def press(*_):
    os.kill(os.getpid(), {number})

@app.command()
def work():
    {work}

sys.argv = ["wlm", "work"]
main()
"""


def run(number, *work):
    """Runs a command of these lines in a process of its own; returns its exit code, stdout and stderr."""
    code = _COMMAND.format(number=int(number), work="\n    ".join(work))
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=60)
    return process.returncode, process.stdout, process.stderr


def test_a_signal_ends_a_command_with_its_exit_code():
    assert run(signal.SIGTERM, "press()", "print('not stopped')") == (143, "", "")
    # Printing is as good a place as any.
    show = ["rows = console.table('', ['a'])", "console.escape = press", "rows.add_row(console.escape('x') or 'x')"]
    assert run(signal.SIGINT, *show, "console.show(rows)")[::2] == (130, "")


def test_a_signal_after_the_end_changes_nothing():
    assert run(signal.SIGINT, "atexit.register(press)", "print('done')") == (0, "done\n", "")


def test_a_signal_waits_for_the_end_of_a_step():
    work = ["with console.running('work', console.Path('none')) as report:", "    press()", "    print('whole')"]
    assert run(signal.SIGTERM, *work, "print('not stopped')") == (143, "whole\n", "")
    # The second one doesn't, and what is written is removed on the way out.
    work[1:] = ["    try:", "        press()", "        press()", "    finally:", "        print('cleaned')"]
    assert run(signal.SIGINT, *work) == (130, "cleaned\n", "")


def test_a_third_signal_ends_the_process_where_it_is():
    work = ["try:", "    press()", "except KeyboardInterrupt:", "    try:", "        press()", "    finally:"]
    code, text, errors = run(signal.SIGTERM, *work, "        press()", "        print('not stopped')")
    assert (code, text, errors) == (-signal.SIGTERM, "", "")


@pytest.mark.parametrize("number", SIGNALS)
def test_handlers_are_put_back(number):
    before = [signal.getsignal(each) for each in SIGNALS]
    with pytest.raises(KeyboardInterrupt), handled():
        with deferred_interrupt() as check:
            check()
        os.kill(os.getpid(), number)
    assert exit_code() == SIGNALS[number]
    assert [signal.getsignal(each) for each in SIGNALS] == before
    # The next command knows nothing of it.
    with deferred_interrupt() as check:
        check()
