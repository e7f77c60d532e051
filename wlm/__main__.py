"""`python -m wlm`: the same as the command `wlm`."""

from wlm.cli import main

if __name__ == "__main__":
    main()
