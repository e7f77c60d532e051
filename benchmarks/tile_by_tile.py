"""Decodes tiles of a lightmap file one by one, at all times, and prints the peak memory of this process as JSON.

`benchmarks.lightmap_file` runs it as a process of its own, which imports nothing that a decoder does not need.
"""

import json
import re
import sys
import time
from pathlib import Path

from wlm.system import load


def peak_memory() -> float:
    """Returns the largest memory that this process has had so far, in MiB.

    `resource.getrusage` would include the memory of the process that started this one.
    """
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"^VmHWM:\s*(\d+) kB$", status, re.MULTILINE)[1]) / 1024


def measure(path: str, device: str, count: int) -> dict[str, float]:
    """Decodes the first `count` tiles of the first sheet of a file, each alone, and returns the figures."""
    before = peak_memory()
    model = load(path)
    sheet = next(iter(model.sheets))
    start = time.perf_counter()
    for number in range(count):
        decoder = model.decoder(device, tiles={sheet: [number]}).light
        for hour in model.times.tolist():
            decoder.tiles([number], hour)
    milliseconds = 1e3 * (time.perf_counter() - start) / (count * len(model.times))
    return {"memory": peak_memory(), "memory_before": before, "decode_ms": milliseconds, "tiles_timed": count}


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], sys.argv[2], int(sys.argv[3]))))
