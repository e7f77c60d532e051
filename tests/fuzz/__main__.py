"""Runs cases by hand.

python -m tests.fuzz READER INDEX [--write FILE]    makes a case again, and reads it
python -m tests.fuzz --cases 20000 --json FILE      many cases of all readers, with a table of counts
"""

import argparse
import json
import os
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any

from wlm.errors import WlmError

from .campaign import Tally, campaign
from .worker import FAILURES, ROOT, Bench, Limits

_ROW = "{:26} {:>9} {:>9} {:>9} {:>9}"


def main() -> int:
    """Runs what the command line asks for; 1 where a case failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Fuzz the readers of files.")
    parser.add_argument("reader", nargs="?", help="the reader of one case")
    parser.add_argument("index", nargs="?", type=int, help="its index")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the case there instead of reading it")
    parser.add_argument("--cases", type=int, metavar="N", help="cases a reader")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), metavar="N", help="processes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the counts there")
    words = parser.parse_args()
    os.environ.setdefault("WARP_CACHE_PATH", str(ROOT / ".cache" / "warp"))
    readers = import_module("tests.fuzz.readers").READERS
    if words.cases is None and (words.index is None or words.reader not in readers):
        parser.error(f"expected a reader and an index, or --cases; readers are {', '.join(readers)}")
    if words.cases is None:
        return _one(readers[words.reader], words.index, words.write)
    return _many({name: range(max(words.cases // reader.cost, 1)) for name, reader in readers.items()}, words)


def _one(reader: Any, index: int, target: Path | None) -> int:
    """Writes a case, or reads it here; what it fails with is shown in full."""
    data = reader.case(index)
    if target is not None:
        target.write_bytes(data)
        return 0
    with tempfile.TemporaryDirectory(prefix="wlm-fuzz-") as folder:
        path = Bench(folder, Limits()).write(reader.name, data)
        try:
            with Limits().held():
                reader.read(path)
        except WlmError as error:
            print(f"refused: {error}")
        else:
            print("accepted")
    return 0


def _many(cases: dict[str, range], words: argparse.Namespace) -> int:
    print(_ROW.format("reader", "cases", "refused", "accepted", "failed"), flush=True)

    def show(name: str, tally: Tally) -> None:
        figures = tally.to_json()
        print(_ROW.format(name, *(figures[key] for key in ("cases", "refused", "accepted", "failed"))), flush=True)
        for each in figures["failures"]:
            line = ascii(each["detail"])[1:-1].replace("\\\\", "\\")[:160]
            print(f"    {each['count']} x {each['kind']}, first {each['index']}: {line}", flush=True)

    begin = time.perf_counter()
    tallies = campaign(cases, words.workers, done=show)
    seconds = time.perf_counter() - begin
    rows = {name: tally.to_json() for name, tally in tallies.items()}
    sums = {key: sum(row[key] for row in rows.values()) for key in ("cases", "refused", "accepted", "failed")}
    print(_ROW.format(f"all, in {seconds:.0f} s", *sums.values()))
    if words.json is not None:
        kinds = {kind: sum(tally.counts[kind] for tally in tallies.values()) for kind in FAILURES}
        result = {"seconds": round(seconds, 1)} | sums | {"kinds": kinds, "readers": rows}
        words.json.parent.mkdir(parents=True, exist_ok=True)
        words.json.write_text(json.dumps(result, indent=1) + "\n")
    return 1 if sums["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
