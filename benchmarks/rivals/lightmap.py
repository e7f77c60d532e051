"""Rivals of compressed lightmaps over time, each tuned as carefully as our method.

`RIVALS` has them by name: block codecs that engines ship (`lightmap_blocks`), principal components over the hours
(`lightmap_pca`), neural texture compression (`lightmap_ntc`), and a video codec (`lightmap_video`). `bytes` is the
size in a GPU's memory of all that a decoder needs; `disk_bytes` is the size after lossless compression, of each
lightmap on its own for block codecs. A video has no random access, so only its size on disk counts.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from benchmarks.rivals.lightmap_blocks import encode_astc, encode_bc6h, encode_bc7
from benchmarks.rivals.lightmap_ntc import LADDER, encode_ntc
from benchmarks.rivals.lightmap_pca import encode_pca_bc4
from benchmarks.rivals.lightmap_video import encode_av1
from benchmarks.rivals.rival import Rival
from wlm.errors import WlmError
from wlm.lightmap.data import SheetFrames

_Scored = TypeVar("_Scored")


@dataclass(frozen=True)
class Method:
    """One way to compress a set of lightmaps.

    Attributes:
        title, option: Names of the method and of its setting, as the results table prints them.
        encode: Function that compresses lightmaps with their mask [H, W] and returns a `Rival`.
        alone: Whether `encode` takes one lightmap [H, W, 3] at a time, instead of all T lightmaps [T, H, W, 3].
        fitted: Whether `encode` takes the argument `device`, on which it fits and decodes.
        random_access: Whether a GPU can read a single texel at any hour without decoding more.
    """

    title: str
    option: str
    encode: Callable[..., Rival]
    alone: bool = True
    fitted: bool = False
    random_access: bool = True

    @property
    def label(self) -> str:
        """The title and the option as one text, for lines of progress."""
        return f"{self.title} {self.option}".strip()


RIVALS: dict[str, Method] = {
    "bc6h": Method("BC6H", "", encode_bc6h),
    "bc7": Method("BC7", "", encode_bc7),
    **{
        f"astc{side}": Method("ASTC", f"{side}x{side}", functools.partial(encode_astc, block=side))
        for side in (4, 5, 6, 8, 10, 12)
    },
    **{
        f"pca-bc4-{count}": Method(
            "PCA in BC4", f"{count}", functools.partial(encode_pca_bc4, components=count), alone=False
        )
        for count in (2, 4, 8, 16)
    },
    **{
        f"ntc-{name}": Method("NTC", name, functools.partial(encode_ntc, latents=name), alone=False, fitted=True)
        for name in LADDER
    },
    **{
        f"av1-{quality}": Method(
            "AV1", f"{quality}", functools.partial(encode_av1, quality=quality), alone=False, random_access=False
        )
        for quality in (50, 65, 75, 85, 92, 97)
    },
}
"""All methods by name."""

FEW = ("bc6h", "bc7", "astc6", "astc8", "astc12", "pca-bc4-4", "av1-75", "av1-92")
"""Rivals of a quick run, which need no GPU."""

_FEW_FITTED = ("ntc-medium",)


def usual(device: str, quick: bool = False) -> tuple[str, ...]:
    """Returns the names of the methods to measure by default; without fitted methods on a CPU, where they take hours.

    Args:
        device: "cpu", "cuda" or "cuda:N".
        quick: Whether to return only a third of the methods.
    """
    names = FEW + _FEW_FITTED if quick else tuple(RIVALS)
    return tuple(name for name in names if device != "cpu" or not RIVALS[name].fitted)


def check_rival(name: str) -> None:
    """Raises a `WlmError` if `RIVALS` has no method of this name."""
    if name not in RIVALS:
        raise WlmError(f"rivals: unknown method {name!r}, expected one of {', '.join(RIVALS)}")


def encode_set(
    name: str,
    lightmaps: SheetFrames,
    visit: Callable[[int, np.ndarray], _Scored],
    chosen: Sequence[int] | np.ndarray | None = None,
    *,
    device: str = "cpu",
) -> tuple[Rival, list[_Scored]]:
    """Encodes and decodes a lightmap set with one method, and calls `visit` with each decoded lightmap.

    Args:
        name: A key of `RIVALS`.
        lightmaps: The lightmaps.
        visit: Called with the index of a time and its decoded lightmap, float32 [H, W, 3], in the order of `chosen`.
        chosen: Indices of the times to visit, at least one; None for all. A method that takes one lightmap at a time
            encodes these alone; the sizes and the seconds of all times are then estimated from them.
        device: "cpu", "cuda" or "cuda:N", for methods that are fitted.

    Returns:
        The rival, with size and seconds for all times but without decoded lightmaps, and the results of `visit`.

    Raises:
        WlmError: The name is unknown, a package is missing, or there is no such device.
    """
    check_rival(name)
    method, count = RIVALS[name], len(lightmaps.frames)
    chosen = range(count) if chosen is None else [int(i) for i in chosen]
    # The whole map's mask: an engine would encode all of it, whatever we score.
    if not method.alone:
        options = {"device": device} if method.fitted else {}
        rival = method.encode(lightmaps.frames, lightmaps.mask, **options)
        return replace(rival, decoded=None), [visit(i, rival.decoded[i]) for i in chosen]
    rivals, visits = [], []
    for i in chosen:
        rival = method.encode(lightmaps.frames[i], lightmaps.mask)
        visits.append(visit(i, rival.decoded))
        rivals.append(replace(rival, decoded=None))  # a set of them is too much memory

    def total(key: str) -> float:
        return sum(getattr(rival, key) for rival in rivals) * count / len(rivals)

    options = sorted({rival.option for rival in rivals})
    sizes = {key: round(total(key)) for key in ("bytes", "disk_bytes")}
    seconds = {key: total(key) for key in ("encode_seconds", "decode_seconds")}
    return replace(rivals[0], option=" and ".join(options), **sizes, **seconds), visits
