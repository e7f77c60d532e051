"""`python -m benchmarks`, from the checkout: the command line of the benchmarks."""

from benchmarks.app import app
from wlm.cli.app import run

if __name__ == "__main__":
    run(app)
