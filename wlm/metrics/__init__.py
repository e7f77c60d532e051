"""Error of HDR lightmaps: PSNR, SSIM and HDR-FLIP, over masks, and per tile as in neural-dynamic-gi, section 10.2."""

from wlm.metrics.error import PSNR_CAP_DB, dynamic_range, half_ulp, mse, psnr, psnr_from_mse
from wlm.metrics.flip import flip_display, flip_exposures
from wlm.metrics.lost import LostLight
from wlm.metrics.pictures import Pictures, picture_error
from wlm.metrics.structural import SSIM_WINDOW, ssim, ssim_map
from wlm.metrics.tiled import (
    FORMAT_LIMITED_ULPS,
    METRICS,
    MIN_VALID_TEXELS,
    FrameMetrics,
    Summary,
    evaluate_frame,
    summarise,
)

__all__ = [
    "FORMAT_LIMITED_ULPS",
    "METRICS",
    "MIN_VALID_TEXELS",
    "PSNR_CAP_DB",
    "SSIM_WINDOW",
    "FrameMetrics",
    "LostLight",
    "Pictures",
    "Summary",
    "dynamic_range",
    "evaluate_frame",
    "flip_display",
    "flip_exposures",
    "half_ulp",
    "mse",
    "picture_error",
    "psnr",
    "psnr_from_mse",
    "ssim",
    "ssim_map",
    "summarise",
]
