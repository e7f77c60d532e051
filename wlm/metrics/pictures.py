"""Image error of rendered views: sRGB in [0, 1], accumulated over views, only over pixels that show the object."""

import math

import numpy as np

from wlm.metrics.error import psnr_from_mse
from wlm.metrics.flip import flip_display
from wlm.metrics.structural import ssim


class Pictures:
    """Image pairs of one object; every score is a mean over the covered pixels of all pairs.

    Attributes:
        count: Number of pairs with at least one covered pixel.
        mse: Mean squared error over pixels and channels; like all scores below, NaN without a pair.
        flip: Mean LDR-FLIP, in [0, 1].
        ssim: Mean SSIM over the pixels whose window lies inside the image; NaN if it was not requested.
    """

    def __init__(self, structural: bool = False) -> None:
        """Creates an empty collection; `structural` tells whether SSIM is also computed."""
        self._structural = structural
        self.count = 0
        self._squared, self._flip, self._pixels, self._similar, self._windows = 0.0, 0.0, 0, 0.0, 0

    @property
    def mse(self) -> float:
        return self._squared / (3 * self._pixels) if self._pixels else math.nan

    @property
    def psnr(self) -> float:
        """PSNR in dB for a peak of 1."""
        return psnr_from_mse(self.mse, 1.0)

    @property
    def flip(self) -> float:
        return self._flip / self._pixels if self._pixels else math.nan

    @property
    def ssim(self) -> float:
        return self._similar / self._windows if self._windows else math.nan

    def add(self, reference: np.ndarray, test: np.ndarray, seen: np.ndarray) -> dict[str, float] | None:
        """Adds a pair of pictures [H, W, 3], sRGB in [0, 1], and returns its `psnr` and `flip`; None if no pixel is
        covered.

        `seen`, bool [H, W], is true for covered pixels; all others have the same value in both pictures.
        """
        count = int(np.count_nonzero(seen))
        if not count:
            return None
        # FLIP also spends time on empty pixels, so they are cropped.
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
