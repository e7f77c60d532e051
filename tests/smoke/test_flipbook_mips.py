"""Mip levels of flip books: the padding with which they do not mix neighbouring frames."""

import numpy as np
import pytest
import torch

from wlm.errors import WlmError
from wlm.smoke.flipbook.book import lay_out, mip_levels, mip_padding


@pytest.mark.parametrize(("height", "width", "levels"), [(24, 40, 3), (16, 16, 1), (50, 30, 2)])
def test_smaller_textures_show_no_neighbours(height: int, width: int, levels: int):
    """Mip levels within a frame do not depend on the neighbouring frames."""
    padding = mip_padding(height, width, levels)
    assert mip_levels(height, width, padding) >= levels
    random = np.random.default_rng(3)
    frame = random.random((height, width, 1), np.float32)

    def shown(neighbours: float, level: int) -> torch.Tensor:
        cells = np.full((9, height, width, 1), neighbours, np.float32)
        cells[4] = frame
        page = torch.from_numpy(lay_out(cells, 3, 3, padding))[None].permute(0, 3, 1, 2)
        # As engines make them, one from the other.
        for _ in range(level):
            page = torch.nn.functional.avg_pool2d(page, 2)
        edges = [(n + padding) / (n + 2 * padding) for n in (height, width)]
        axes = [torch.linspace(1 + 1 - edge, 1 + edge, 60) / 3 for edge in edges]
        grid = torch.stack(torch.meshgrid(*axes, indexing="ij")[::-1], -1)[None]
        return torch.nn.functional.grid_sample(page, 2 * grid - 1, align_corners=False, padding_mode="border")

    for level in range(levels + 1):
        assert torch.equal(shown(0.0, level), shown(1000.0, level))
    assert not torch.equal(shown(0.0, levels + 2), shown(1000.0, levels + 2))


def test_what_no_padding_helps():
    with pytest.raises(WlmError, match="mips: 3 levels need .* a multiple of 8 pixels, .* frames of 33 x 32 pixels"):
        mip_padding(32, 33, 3)
    assert mip_levels(33, 32, 16) == 0 and mip_levels(32, 32, 0) == 0
