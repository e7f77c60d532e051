"""Encoded guides and lightmaps: ranges and inverses."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from builders.smoke_axes import from_srgb
from builders.smoke_plumes import plume
from builders.smoke_samples import view_of

from wlm.smoke.camera import Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import bake, bake_coarse
from wlm.smoke.network.planes import (
    GUIDES,
    OPACITY_PLANE,
    PLANES,
    decode_lightmaps,
    encode_guide,
    encode_lightmaps,
    render_guide,
    span,
    to_srgb,
)
from wlm_kernels.smoke.settings import March


def test_curve_is_srgb_and_goes_on_above_one():
    linear = torch.tensor([0.0, 0.002, 0.0031308, 0.18, 0.5, 1.0, 3.0], dtype=torch.float64)
    # IEC 61966-2-1; the last one is the same formula.
    known = torch.tensor([0.0, 0.02584, 0.04045, 0.461356, 0.735357, 1.0, 1.6124], dtype=torch.float64)
    assert torch.allclose(to_srgb(linear), known, atol=1e-4)
    assert torch.allclose(from_srgb(to_srgb(linear)), linear, atol=1e-12)
    assert (to_srgb(torch.tensor([-1.0])) == 0).all() and (from_srgb(torch.tensor([-1.0])) == 0).all()


def test_curve_has_a_finite_slope_at_zero():
    linear = torch.zeros(1, requires_grad=True)
    to_srgb(linear).sum().backward()
    assert linear.grad.item() == pytest.approx(12.92)


def test_span_is_of_the_ball_around_the_box_for_all_turns():
    volume = plume()
    radius = 0.5 * np.hypot(1.0, np.hypot(1.2, 1.0))
    for perspective in (False, True):
        for way in ((0, 0, 1), (1, 0.3, -0.4)):
            position = volume.centre + 5 * np.array(way) / np.linalg.norm(way)
            camera = Camera.look_at(position, volume.centre, extent=1.0, height=4, width=4, perspective=perspective)
            assert np.allclose(span(volume, camera), (5 - radius, 5 + radius))


MARCH = March(2.5, threshold=0.05, seed=7)
STILL = replace(MARCH, jitter=0.0)  # the paper's march and ours shift their samples in different patterns


@pytest.mark.parametrize("kind", list(GUIDES))
def test_a_guide_of_each_kind(device, kind):
    """A guide has the named planes, is 0 where there is no smoke, and shares opacity and depth with the other kind."""
    volume = plume(hot=True, device=device)
    camera = view_of(volume)
    planes = render_guide(volume, camera, kind, STILL)
    assert planes.shape == (len(GUIDES[kind]), 32, 32) and torch.isfinite(planes).all()
    opacity, depth = planes[-2:]
    empty = opacity == 0
    assert 0.2 < empty.float().mean() < 0.95 and (planes[:, empty] == 0).all()
    assert planes.min() >= 0 and opacity.max() <= 1 and 0.5 < depth.max() <= 1
    shared = render_guide(volume, camera, "paper", STILL)[1:]
    assert torch.allclose(planes[-2:], shared, atol=1e-5)
    assert all((planes[i] > 0).any() for i in range(len(planes)))


def test_six_are_the_coarse_march_as_lightmaps_are_encoded(device):
    volume = replace(plume(hot=True, device=device), emission=30.0)
    camera = view_of(volume)
    planes = render_guide(volume, camera, "six", MARCH)
    expected = encode_lightmaps(bake_coarse(volume, camera, MARCH))
    for name, plane in zip(PLANES, expected, strict=True):
        torch.testing.assert_close(planes[GUIDES["six"].index(name)], plane, rtol=1e-6, atol=1e-6, msg=name)
    assert planes[GUIDES["six"].index("emission")].max() > 0.5
    # As the other kinds' is, by torch.
    maps = torch.stack([expected[0], expected[OPACITY_PLANE], bake_coarse(volume, camera, MARCH).depth])
    depth = encode_guide(maps, *span(volume, camera))[2]
    torch.testing.assert_close(planes[GUIDES["six"].index("depth")], depth, rtol=1e-6, atol=1e-6)
    cold = render_guide(replace(volume, temperature=None), camera, "six", MARCH)
    assert not cold[GUIDES["six"].index("emission")].any()


@pytest.mark.parametrize("hot", [False, True])
def test_lightmaps_come_back(device, hot):
    volume = replace(plume(hot=hot, device=device), emission=30.0)
    six = bake(volume, view_of(volume), step=1.0, estimate=False)
    six = SixWay(3.0 * six.lightmaps, six.transparency, six.emission)  # above 1 too
    assert six.lightmaps.max() > 1
    planes = encode_lightmaps(six)
    assert planes.shape == (len(PLANES), 32, 32) and torch.isfinite(planes).all() and planes[6:].max() < 1
    result = decode_lightmaps(planes, hot=hot)
    assert torch.allclose(result.lightmaps, six.lightmaps, atol=1e-5)
    assert torch.allclose(result.transparency, six.transparency, atol=1e-6)
    if hot:
        assert six.emission.max() > 1
        assert torch.allclose(result.emission, six.emission, rtol=1e-4, atol=1e-5)
    else:
        assert (planes[7] == 0).all() and result.emission is None


def test_decoding_clamps_what_no_plane_can_be():
    planes = torch.stack([torch.full((2, 2), value) for value in (-1, -0.1, 0, 0.5, 1, 2, 1.5, 1.2)])
    result = decode_lightmaps(planes)
    assert result.lightmaps.min() == 0 and result.transparency.max() == 0
    assert torch.isfinite(result.emission).all() and result.emission.half().isfinite().all()
