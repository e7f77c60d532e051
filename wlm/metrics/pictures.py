"""Image error of rendered views: sRGB in [0, 1], accumulated over views, only over pixels that show the object."""

import math

import numpy as np

from wlm.metrics.error import psnr_from_mse
from wlm.metrics.flip import flip_display
from wlm.metrics.structural import ssim


def picture_error(reference: np.ndarray, test: np.ndarray, seen: np.ndarray, flip: bool = True) -> tuple[float, float]:
    """Computes the error of a test picture against a reference picture.

    Args:
        reference: [H, W, 3], sRGB in [0, 1]; uncovered pixels have the same value in both images.
        test: [H, W, 3], sRGB in [0, 1].
        seen: bool [H, W], true for covered pixels, at least one.
        flip: Whether FLIP is computed too.

    Returns:
        The mean squared error and the mean LDR-FLIP, or NaN, of the covered pixels.
    """
    error = float(np.square(reference - test, dtype=np.float64)[seen].mean())
    if not flip:
        return error, math.nan
    # FLIP also spends time on empty pixels, so they are cropped.
    window = tuple(slice(at.min(), at.max() + 1) for at in np.nonzero(seen))
    return error, float(flip_display(reference[window], test[window])[seen[window]].mean())


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
        return self._squared / self._pixels if self._pixels else math.nan

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
        error, flip = picture_error(reference, test, seen)
        if self._structural:
            similar = ssim(reference, test, seen, 1.0)
            if not math.isnan(similar):
                self._similar, self._windows = self._similar + similar * count, self._windows + count
        self.count += 1
        self._squared, self._flip = self._squared + error * count, self._flip + flip * count
        self._pixels += count
        return {"psnr": psnr_from_mse(error, 1.0), "flip": flip}
