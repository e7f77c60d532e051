"""Cuts a box out of a set of light probes and writes it as a set of its own, small enough for a repository.

`demos/data/probes/street.npz` is a part of a bake of 15,000 probes:

    python demos/make_probe_crop.py .../city.npz demos/data/probes/street.npz --keys 12.00 21.00 \
        --low 1.75 -1 1.3 --high 3.6 2 3.7
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.probe.data import ProbeSet, load


def crop(sets: list[ProbeSet], out: Path, low: list[float], high: list[float]) -> tuple[int, list[float]]:
    """Writes the probes inside a box: positions as float32, each set's values as half floats.

    Args:
        sets: The same probes, under several keys.
        out: The `.npz` file to write; its folder is made if it is missing.
        low: Lowest corner of the box.
        high: Highest corner; both belong to it.

    Returns:
        Probes written; for each set what rounding to half floats costs, as a PSNR in dB over the range of its values.

    Raises:
        WlmError: The box holds no live probe, a value is beyond half floats, or the file can't be written.
    """
    position = sets[0].position
    inside = ((position >= low) & (position <= high)).all(axis=1)
    arrays, scores = {"position": position[inside].astype(np.float32)}, []
    for probes in sets:
        if not probes.live[inside].any():
            raise WlmError(f"crop: {probes.key}: the box holds no probe with light")
        values = probes.values[inside]
        with np.errstate(over="ignore"):
            rounded = values.astype(np.float16)
        if not np.isfinite(rounded).all():
            raise WlmError(f"crop: {probes.key}: a value is beyond half floats, {np.abs(values).max():.3g}")
        mean_square = np.mean((rounded.astype(np.float64) - values) ** 2)
        scores.append(float(10.0 * np.log10(np.ptp(values) ** 2 / mean_square)) if mean_square else np.inf)
        coefficients = probes.outputs // 3
        shape = (-1, coefficients, 3) if probes.outputs == 3 * coefficients else (-1, probes.outputs)
        arrays[probes.key] = rounded.reshape(shape)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WlmError(f"{out.parent}: cannot make the folder: {error.strerror or error}") from error
    with atomic_path(out) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)
    return int(inside.sum()), scores


def main() -> None:
    """Reads the command line, crops and says what was written."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("input", type=Path, metavar="INPUT_NPZ", help="the whole set")
    parser.add_argument("out", type=Path, metavar="OUT_NPZ", help="the file to write")
    parser.add_argument("--keys", nargs="+", required=True, metavar="KEY", help='such as "12.00" for sh_12.00')
    for name in ("low", "high"):
        help_text = f"{name}est corner of the box, in the unit of the positions"
        parser.add_argument(f"--{name}", type=float, nargs=3, required=True, metavar=("X", "Y", "Z"), help=help_text)
    args = parser.parse_args()
    try:
        sets = [load(args.input, key=key) for key in args.keys]
        count, scores = crop(sets, args.out, args.low, args.high)
    except WlmError as error:
        sys.exit(f"error: {error}")
    rounding = ", ".join(f"{probes.key} {score:.1f} dB" for probes, score in zip(sets, scores, strict=True))
    print(f"{args.out}: {count} probes, {args.out.stat().st_size / 1e3:.0f} kB; rounding: {rounding}")


if __name__ == "__main__":
    main()
