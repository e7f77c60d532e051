"""Reading textures by torch's own ``grid_sample``."""

import torch
from torch.nn.functional import grid_sample


def sample(image: torch.Tensor, uv: torch.Tensor, filter: str, boundary: str) -> torch.Tensor:
    """Reads [H, W, C] at uv [N, 2]: [N, C]."""
    padding = "reflection" if boundary == "mirror" else "border"
    if boundary == "wrap":
        # A texel of the other side on each side, and the texture smaller by those.
        size = torch.tensor([image.shape[1], image.shape[0]], dtype=uv.dtype)
        image = torch.cat([image[-1:], image, image[:1]], 0)
        image = torch.cat([image[:, -1:], image, image[:, :1]], 1)
        uv = ((uv - uv.detach().floor()) * size + 1.0) / (size + 2.0)
    grid = (2.0 * uv - 1.0)[None, None]
    mode = "bilinear" if filter == "linear" else "nearest"
    return grid_sample(image.movedim(-1, 0)[None], grid, mode=mode, padding_mode=padding, align_corners=False)[
        0, :, 0
    ].T
