"""The error of pictures as they are shown, added up over views: sRGB in [0, 1], only where something is seen."""

import math

import numpy as np

from wlm.metrics.error import psnr_from_mse
from wlm.metrics.flip import flip_display
from wlm.metrics.structural import ssim


class Pictures:
    """Pairs of pictures of one thing; every figure is a mean over the seen pixels of all of them.

    Attributes:
        count: Pairs in which something is seen.
        mse: Mean squared error over pixels and channels; NaN without a pair, as are all below.
        flip: LDR-FLIP, in [0, 1].
        ssim: Mean over the pixels whose window lies in the picture; NaN where it wasn't asked for.
    """

    def __init__(self, structural: bool = False) -> None:
        """Begins with none.

        Args:
            structural: Whether SSIM is computed too.
        """
        self._structural = structural
        self.count = 0
        self._squared, self._flip, self._pixels, self._similar, self._windows = 0.0, 0.0, 0, 0.0, 0

    @property
    def mse(self) -> float:
        return self._squared / (3 * self._pixels) if self._pixels else math.nan

    @property
    def psnr(self) -> float:
        """dB, of colours in [0, 1]."""
        return psnr_from_mse(self.mse, 1.0)

    @property
    def flip(self) -> float:
        return self._flip / self._pixels if self._pixels else math.nan

    @property
    def ssim(self) -> float:
        return self._similar / self._windows if self._windows else math.nan

    def add(self, reference: np.ndarray, test: np.ndarray, seen: np.ndarray) -> dict[str, float] | None:
        """Adds a pair.

        Args:
            reference: [H, W, 3], sRGB in [0, 1], alike in both where nothing is seen.
            test: Likewise.
            seen: bool [H, W].

        Returns:
            Its own `psnr` and `flip`; None where nothing is seen.
        """
        count = int(np.count_nonzero(seen))
        if not count:
            return None
        # FLIP takes its time for empty pixels too.
        window = tuple(slice(at.min(), at.max() + 1) for at in np.nonzero(seen))
        first, second, shown = reference[window], test[window], seen[window]
        flip = float(flip_display(first, second)[shown].sum())
        squared = float(np.square(first - second, dtype=np.float64)[shown].sum())
        if self._structural:
            similar = ssim(first, second, shown, 1.0)
            if not math.isnan(similar):
                self._similar, self._windows = self._similar + similar * count, self._windows + count
        self.count += 1
        self._squared, self._flip, self._pixels = self._squared + squared, self._flip + flip, self._pixels + count
        return {"psnr": psnr_from_mse(squared / (3 * count), 1.0), "flip": flip / count}
