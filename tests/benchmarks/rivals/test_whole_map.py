"""The texture of a whole map, against the decoder on the host."""

import numpy as np
import pytest
from builders.synthetic import random_sheet

from benchmarks.rivals.whole_map import WholeMap
from wlm.lightmap.decode import SheetDecoder
from wlm.texels import near_gaps


@pytest.mark.parametrize("time", [7.5, 9.0])
def test_the_map_is_that_of_the_host(time, device):
    mask = np.zeros((236, 375), bool)
    mask[20:60, 30:128] = mask[100:180, 60:90] = mask[40:200, 126:150] = mask[130:200, 200:340] = True
    model = random_sheet((3, 4, 3, 1, 4, 3), mask=mask, columns=3)
    decoder = WholeMap(model, device)
    decoder.set_time(time)
    decoder.decode()
    expected = SheetDecoder(model, device).frame(time)
    step = expected.max(2, keepdims=True) / 256
    # Half a step of each of both times and of their mixture.
    assert (np.abs(decoder.numpy() - expected) <= (1.5 if time == 9.0 else 0.5) * step + 1e-6).all()


def test_mips_hold_charts_alone(device):
    mask = np.zeros((236, 247), bool)
    mask[:64, 5:70] = mask[117:, 90:] = mask[235, 0] = True
    model = random_sheet((3, 3, 1, 3), mask=mask)
    decoder = WholeMap(model, device)
    decoder.decode()
    assert [level.shape for level in decoder.levels] == [(236 >> i, 247 >> i) for i in range(8)]
    light, weight = decoder.numpy().astype(np.float64), mask.astype(float)
    for level in range(1, 8):
        rows, columns = (np.minimum(np.arange(size) // 2, max(size // 2, 1) - 1) for size in weight.shape)
        shape = decoder.levels[level].shape
        total, summed = np.zeros(shape), np.zeros((*shape, 3))
        np.add.at(total, (rows[:, None], columns[None]), weight)
        np.add.at(summed, (rows[:, None], columns[None]), weight[..., None] * light)
        mean = summed / np.maximum(total, 1)[..., None]
        light, weight = decoder.numpy(level).astype(np.float64), total
        inside = total > 0
        assert (np.abs(light - mean)[inside] <= mean[inside].max(1, keepdims=True) / 500 + 1e-7).all()
        target, source = near_gaps(inside)
        np.testing.assert_array_equal(light[tuple(target.T)], light[tuple(source.T)])
        inside[tuple(target.T)] = True
        assert (light[~inside] == 0).all()
