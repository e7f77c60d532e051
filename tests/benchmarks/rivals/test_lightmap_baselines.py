"""Rivals of whole sets: their names, sizes and scores."""

import numpy as np
import pytest
from builders.small_sets import moving_light, tiny_profile

from benchmarks.rivals.lightmap import FEW, RIVALS, encode_set, evaluate_rivals
from wlm.errors import WlmError
from wlm.lightmap.data import from_arrays
from wlm.lightmap.fit import compress
from wlm.metrics import psnr


def test_names_and_labels():
    assert set(FEW) < RIVALS.keys()
    labels = [method.label for method in RIVALS.values()]
    assert len(set(labels)) == len(labels)
    assert RIVALS["astc6"].label == "ASTC 6x6" and RIVALS["bc7"].label == "BC7"
    assert [name for name, method in RIVALS.items() if not method.random_access] == [
        name for name in RIVALS if name.startswith("av1")
    ]


def test_a_set_goes_through_a_method_time_by_time():
    moving = moving_light(40, 60)
    visited = []

    def visit(i, decoded):
        assert decoded.shape == (40, 60, 3) and decoded.dtype == np.float32
        visited.append(i)
        return psnr(moving.frames[i], decoded)

    for name in ("bc7", "pca-bc4-4", "av1-85"):
        visited.clear()
        rival, scores = encode_set(name, moving, visit)
        assert visited == list(range(5)) and min(scores) > 22.0
        assert rival.name == name and rival.decoded is None
        # Of some of the times: sizes and seconds are of all, estimated or measured.
        visited.clear()
        part, some = encode_set(name, moving, visit, [1, 3])
        assert visited == [1, 3] and some == [scores[1], scores[3]]
        assert part.bytes == rival.bytes and part.disk_bytes == pytest.approx(rival.disk_bytes, rel=0.05)
        assert part.encode_seconds > 0.0
    with pytest.raises(WlmError, match="unknown method 'jpeg'"):
        encode_set("jpeg", moving, visit)


def test_the_profiles_that_astc_chose_are_told():
    """One hour that LDR holds better, one that HDR does."""
    plain = moving_light(48, 48, hours=(1.0, 2.0))
    frames = plain.frames.copy()
    frames[1] = (10.0 ** (np.arange(48) / 12.0))[None, :, None] * [1.0, 0.8, 0.5]
    mixed = from_arrays(frames, plain.times, period=24.0)
    assert encode_set("astc12", plain, lambda i, decoded: None)[0].option == "LDR"
    assert encode_set("astc12", mixed, lambda i, decoded: None)[0].option == "HDR and LDR"


def test_sets_are_scored_over_the_texels_of_the_model():
    moving = moving_light(128, 228)
    mask = moving.mask.copy()
    mask[:, 200:] = False
    lightmaps = from_arrays(moving.frames, moving.times, mask, 24.0)
    model = compress(lightmaps, tiny_profile(steps=10), tiles=[1])
    names = ("8bit", "bc6h", "pca-bc4-4", "av1-50")
    seen = []
    results = evaluate_rivals(model, lightmaps, names, metrics=("psnr",), progress=seen.append)
    (plain, score), (_, bc6h), (_, pca), (_, video) = results
    assert seen and [rival.name for rival, _ in results] == list(names)
    times = len(moving.times)
    assert (plain.name, plain.decoded) == ("8bit", None) and plain.encode_seconds > 0.0 < plain.decode_seconds
    assert score.bytes == plain.bytes == times * (128 * 228 * 3 + 2 * 12)
    assert score.bpp == pytest.approx(24.0, abs=0.01) and score.disk_bpp < 24.0
    assert bc6h.bpp == pytest.approx(8.0, abs=0.2) and score.to_json()["ssim"] is None
    assert pca.bpp == pytest.approx(16.0 / times, abs=0.2)  # 4 maps of 4 bits, once for all times
    assert video.disk_bpp == pytest.approx(video.bpp, abs=0.02) and video.disk_bpp < bc6h.disk_bpp
    # Not scored where the model holds nothing: noise there changes nothing.
    frames = lightmaps.frames.copy()
    frames[:, :, :128] *= 1.0 / np.random.default_rng(0).uniform(1.0, 9.0, frames[:, :, :128].shape)
    noisy = from_arrays(frames, lightmaps.times, mask, 24.0)
    ((_, again),) = evaluate_rivals(model, noisy, ("bc6h",), metrics=("psnr",))
    assert again.psnr == bc6h.psnr
    with pytest.raises(WlmError, match="unknown method"):
        evaluate_rivals(model, lightmaps, ("jpeg",))
