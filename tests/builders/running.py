"""Running the command line in this process."""

import os
import signal
from contextlib import contextmanager

import numpy as np
from PIL import Image
from typer.testing import CliRunner

import wlm.cli.console
from wlm.cli import app
from wlm.system import Meter


def call(*words, code=0):
    """Runs the command in this process and returns what it printed to stdout; `call.stderr` has the rest, without the
    line about kernels that are compiled, which depends on the tests before."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    assert "\x1b" not in result.output, "no control codes where there is no terminal"
    call.stderr = result.stderr.replace(f"{wlm.cli.console.COMPILING}\n", "")
    return result.stdout


def fails(*words):
    """Runs a command that must end with exit code 2 and one line beside warnings, which is returned."""
    assert call(*words, code=2) == ""
    lines = [line for line in call.stderr.splitlines() if not line.startswith("warning: ")]
    assert len(lines) == 1 and lines[0].startswith("error: "), call.stderr
    return lines[0]


def png(path):
    """Reads a picture: uint8 [H, W, channels]."""
    with Image.open(path) as image:
        return np.asarray(image)


def report_always(monkeypatch):
    """Makes long work report whenever it could, not twice a second."""
    monkeypatch.setattr(Meter, "due", lambda self, done: True)


def check_a_stop_is_resumed(monkeypatch, folder, words):
    """Stops a compression by Ctrl-C: it is kept, not taken for one of another seed, and resumed to the same bytes."""
    whole, out = folder / "whole.wlm", folder / "a.wlm"

    @contextmanager
    def bar(what):
        yield lambda done, total, text: os.kill(os.getpid(), signal.SIGINT)

    call(*words, "-o", whole)
    with monkeypatch.context() as patched:
        report_always(patched)
        patched.setattr(wlm.cli.console, "progress_bar", bar)
        assert call(*words, "-o", out, code=130) == ""
    stopped = f"stopped at step 5: repeat the command with --resume to continue from {out}.partial"
    assert [line for line in call.stderr.splitlines() if not line.startswith("warning: ")] == [stopped]
    assert sorted(path.name for path in folder.iterdir()) == ["a.wlm.partial", "whole.wlm"]

    assert "made with seed 0, not 1" in fails(*words, "-o", out, "--resume", "--seed", 1)
    call(*words, "-o", out, "--resume")
    assert out.read_bytes() == whole.read_bytes()
    assert sorted(path.name for path in folder.iterdir()) == ["a.wlm", "whole.wlm"]
    call(*words, "-o", out, "--resume")
    assert "there is nothing to resume; starting at step 0" in call.stderr
