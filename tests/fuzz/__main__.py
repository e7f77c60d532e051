"""Makes a case again, and reads it: python -m tests.fuzz READER INDEX [--write FILE]."""

import argparse
import os
import tempfile
from pathlib import Path

from wlm.errors import WlmError

from .bench import ROOT, Bench, Limits


def main() -> None:
    """Writes a case, or reads it here; what it fails with is shown in full."""
    os.environ.setdefault("WARP_CACHE_PATH", str(ROOT / ".cache" / "warp"))
    from .readers import READERS

    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Fuzz a reader of files.")
    parser.add_argument("reader", choices=READERS, metavar="READER", help=f"one of {', '.join(READERS)}")
    parser.add_argument("index", type=int, help="index of the case")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the case there instead of reading it")
    words = parser.parse_args()
    reader = READERS[words.reader]
    if words.write is not None:
        words.write.write_bytes(reader.case(words.index))
        return
    with tempfile.TemporaryDirectory(prefix="wlm-fuzz-") as folder:
        path = Bench(folder, Limits(), READERS).write(words.reader, reader.case(words.index))
        try:
            with Limits().held():
                reader.read(path)
            print("accepted")
        except WlmError as error:
            print(f"refused: {error}")


if __name__ == "__main__":
    main()
