"""What is known of a set's tiles before a fit: looked at once, for all fits of one set with maps of several sizes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wlm.lightmap.data import LightmapSet
from wlm.lightmap.model import Profile, decode_scale, encode_scale
from wlm.lightmap.tiles import TileGrid, TileKind, channel_means, check_index, classify, split
from wlm.lightmap.worker import Piece
from wlm.system import Meter, OnProgress
from wlm.workers import each

_LOOK = 32  # tiles that are looked at between two looks at the clock: some seconds
_SETTINGS = ("gamma", "static_budget_db", "peak", "metric_weight")  # that it depends on


@dataclass(frozen=True, eq=False)
class Facts:
    """What is stored of a tile beside its maps and network, rounded as in the file (section 4).

    Attributes:
        kind: Its kind.
        scale: [T, 3], of tiles that have maps: codes, of a static one half floats.
        peak: uint8 [T], of these, codes of the largest colour.
        affine: [2, 3], of these, shift and spread.
        constant: float64 [T, 3], radiance of a constant tile.
    """

    kind: TileKind
    scale: np.ndarray | None = None
    peak: np.ndarray | None = None
    affine: np.ndarray | None = None
    constant: np.ndarray | None = None


class Survey:
    """The tiles of a set, looked at.

    Attributes:
        index: int [N], numbers of the tiles in their grid, rising.
        facts: What is stored of each beside its maps.
        piece: All tiles that have maps, where they are one batch and several fits of them follow: it keeps what they
            are fitted to. None until a fit puts it here.
    """

    def __init__(
        self,
        lightmaps: LightmapSet,
        profile: Profile,
        tiles: Sequence[int] | None = None,
        progress: OnProgress | None = None,
    ) -> None:
        """Looks at the tiles, some at a time: all of a large set don't fit in memory.

        Args:
            lightmaps: The set.
            profile: The settings.
            tiles: Their numbers; None: all.
            progress: Called with the stage "tiles" where it takes long.

        Raises:
            WlmError: A number is outside the grid or given twice, or there is none.
        """
        grid = TileGrid.of(*lightmaps.mask.shape)
        self._lightmaps, self._profile = lightmaps, profile
        self.index = np.arange(grid.count) if tiles is None else np.array(sorted(tiles), np.int64)
        check_index(self.index, grid)
        self.piece: Piece | None = None
        self.facts: list[Facts] = []
        meter = Meter(progress, "tiles", len(self.index))
        for fact in each(self._look, self.index.tolist()):
            self.facts.append(fact)
            if len(self.facts) % _LOOK == 0 and meter.due(len(self.facts)):
                meter.report(len(self.facts))

    def check(self, lightmaps: LightmapSet, profile: Profile) -> None:
        """Holds that it is one of all tiles of a set, for these settings.

        Raises:
            ValueError: It isn't.
        """
        same = all(getattr(profile, name) == getattr(self._profile, name) for name in _SETTINGS)
        whole = len(self.index) == TileGrid.of(*lightmaps.mask.shape).count
        if lightmaps is not self._lightmaps or not same or not whole:
            raise ValueError(
                f"expected a survey of all tiles of {lightmaps.name} for {', '.join(_SETTINGS)} as they are"
            )

    def _look(self, number: int) -> Facts:
        gamma, peak = self._profile.gamma, self._profile.peak
        tile = split(self._lightmaps, gamma, [number])
        kind = TileKind(int(classify(tile, gamma, self._profile.static_budget_db, peak)[0]))
        if kind == TileKind.EMPTY:
            return Facts(kind)
        colour = tile.colour[0][:, tile.mask[0]]  # [T, K, 3], of the valid texels
        if kind == TileKind.CONSTANT:
            radiance = colour.astype(np.float64) ** gamma
            # The middle of the range: at most half a step of half float off.
            middle = 0.5 * (radiance.min(1) + radiance.max(1)) if peak is None else radiance.mean(1)
            return Facts(kind, constant=middle)
        means = channel_means(tile.colour, tile.mask)[0]
        if kind == TileKind.DYNAMIC:
            stored = encode_scale(means, gamma)
            scale = decode_scale(stored, gamma)
        else:
            stored = means.astype(np.float16)
            scale = stored.astype(np.float32)
        # Shift and spread, of values as the fit will see them (section 4).
        lit = scale > 0
        values = colour * np.divide(1.0, scale, out=np.zeros_like(scale), where=lit)[:, None]
        affine = np.empty((2, 3))
        for c in range(3):
            chosen = values[lit[:, c], :, c]
            shift, spread = (chosen.mean(), chosen.std()) if chosen.size else (0.0, 1.0)
            # Half floats end at 6e-8; a channel that is the same everywhere has nothing left to spread.
            affine[:, c] = shift, max(spread, 1e-4)
        largest = encode_scale(colour.max((1, 2)).astype(np.float64), gamma, up=True)
        return Facts(kind, scale=stored, peak=largest, affine=affine)
