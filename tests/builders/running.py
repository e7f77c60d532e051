"""Running the command line in this process."""

from typer.testing import CliRunner

from wlm.cli import app


def call(*words, code=0):
    """Runs the command in this process and returns what it printed to stdout; ``call.stderr`` has the rest."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    assert "\x1b" not in result.output, "no control codes where there is no terminal"
    call.stderr = result.stderr
    return result.stdout


def fails(*words):
    """Runs a command that must end with exit code 2 and one line, which is returned."""
    assert call(*words, code=2) == ""
    lines = call.stderr.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: "), call.stderr
    return lines[0]
