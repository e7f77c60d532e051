"""The command line of the benchmarks: `python -m benchmarks` in a checkout of the repository."""

from benchmarks.app import app
from wlm.cli.app import run

if __name__ == "__main__":
    run(app)
