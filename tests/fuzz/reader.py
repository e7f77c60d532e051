"""The description of a fuzzed file reader, and functions that all tables of readers share."""

import functools
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from builders.resigned import index_bytes

from .containers import compact_digest
from .mutate import corrupt

CORPUS = Path(__file__).parent / "corpus"
FILES = Path(__file__).resolve().parents[1] / "files"


@dataclass(frozen=True)
class Reader:
    """A function of the package that reads a file."""

    name: str
    file: str
    seeds: Callable[[], Sequence[bytes]]
    vary: Callable[[Random, bytes], bytes]
    read: Callable[[Path], Any]
    beside: Callable[[], Mapping[str, bytes]] = field(default=dict)
    cost: int = 1
    blind: float = 0.2

    def case(self, index: int) -> bytes:
        """Makes case `index`."""
        draw, seeds = Random(f"{self.name}:{index}"), self.seeds()
        seed = draw.choice(seeds)
        return corrupt(draw, seed, seeds) if draw.random() < self.blind else self.vary(draw, seed)


def corpus(*names: str) -> Callable[[], Sequence[bytes]]:
    """The committed good files of these names."""
    return functools.cache(lambda: tuple((CORPUS / name).read_bytes() for name in names))


def stored(*names: str) -> Callable[[], Sequence[bytes]]:
    """Good files of the other tests."""
    return functools.cache(lambda: tuple((FILES / name).read_bytes() for name in names))


def check_finite(**arrays: Any) -> None:
    """Fails where an accepted array holds NaN or infinity."""
    for name, array in arrays.items():
        assert np.isfinite(np.asarray(array)).all(), f"accepted, but {name} holds NaN or infinity"


def check_digest(path: Path) -> None:
    """Fails where an accepted artifact's digest isn't that of its bytes."""
    data = path.read_bytes()
    if data[:3] == b"wlm":
        assert data[4:8] == compact_digest(data[:4], data[8:]), "accepted, but its digest is another's"
        return
    header = data[8 : 8 + int.from_bytes(data[:8], "little")]
    digest = next(word[:32] for word in header.split(b" ")[3:] if word[32:33] == b'"')
    content = data[: index_bytes(data)].replace(b" " + digest + b'"', b" " + b"0" * 32 + b'"', 1)
    actual = hashlib.blake2b(content, digest_size=16).hexdigest()
    assert digest.decode() == actual, "accepted, but its digest is another's"
