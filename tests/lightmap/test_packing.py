"""Tiles as deflated streams: nothing is lost, what isn't used costs nothing, and damage is one line."""

import dataclasses

import numpy as np
import pytest
import torch
from builders import small_sets
from builders.checks import assert_same, error_of
from builders.synthetic import random_model
from reference.levels import put_on_levels

import wlm
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.bc7 import decode_image
from wlm.lightmap.decode import Decoder
from wlm.lightmap.evaluation import part_bytes
from wlm.lightmap.packing import STREAMS, clear_unused


def _mask(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((236, 247)) < 0.4


@pytest.mark.parametrize("mask", [None, _mask(), np.zeros((236, 247), bool)], ids=["whole", "gaps", "nothing"])
@pytest.mark.parametrize("kinds", [(3, 2, 1, 0), (3, 3, 2, 2), (0, 0, 0, 2), (1, 0, 1, 0)], ids=str)
def test_nothing_is_lost(tmp_path, mask, kinds):
    model = random_model(kinds, mask=mask)
    size = model.save(tmp_path / "a.wlm")
    assert_same(wlm.load(tmp_path / "a.wlm"), model)
    assert sum(part_bytes(model, size).values()) == size
    assert ("tiles" in read_artifact(tmp_path / "a.wlm").parts) == (max(kinds) >= 2)


@pytest.mark.parametrize("part", ["uv", "uvt"])
def test_any_block_of_mode_6_comes_back(tmp_path, part):
    model = random_model((3, 0))
    words = np.random.default_rng(1).integers(0, 2**64, (*getattr(model, part).shape[:-1], 2), np.uint64)
    words[..., 0] = words[..., 0] & ~np.uint64(127) | np.uint64(64)
    model = dataclasses.replace(model, **{part: words.view(np.uint8)})
    model.save(tmp_path / "a.wlm")
    assert_same(wlm.load(tmp_path / "a.wlm"), model)
    words[..., 0] |= np.uint64(1)
    other = dataclasses.replace(model, **{part: words.view(np.uint8)})
    assert "BC7 mode 6" in error_of(other.save, tmp_path / "b")
    assert not (tmp_path / "b").exists()


def test_what_is_unused_costs_nothing(tmp_path):
    used = np.zeros((128, 128), bool)
    used[:, :50] = True
    model = random_model((3, 0), mask=np.pad(used, ((0, 0), (0, 119)))[:108])
    blocks = clear_unused(model.uv[0], used)
    texels, expected = decode_image(blocks), decode_image(model.uv[0])
    assert np.array_equal(texels[used], expected[used])
    # Columns 50 and 51 share blocks with valid texels, later ones have none of their own.
    assert not blocks.reshape(32, 32, 16)[:, 13:, 1:].any()
    cleared = dataclasses.replace(model, uv=blocks[None])
    assert np.array_equal(clear_unused(blocks, used), blocks)
    sizes = part_bytes(cleared, cleared.file_bytes()), part_bytes(model, model.file_bytes())
    assert sizes[0]["uv indices"] < 0.45 * sizes[1]["uv indices"] and sizes[0]["uv ends"] < 0.45 * sizes[1]["uv ends"]
    light, same = Decoder(cleared).frame(7.5), Decoder(model).frame(7.5)
    assert np.array_equal(light[model.mask], same[model.mask])


def _changed(tmp_path, **tensors) -> str:
    """What reading a file says whose parts were replaced."""
    model = random_model((3, 2, 1, 0))
    model.save(tmp_path / "a.wlm")
    artifact = read_artifact(tmp_path / "a.wlm")
    parts = artifact.tensors | {name: value(artifact.tensors[name].copy()) for name, value in tensors.items()}
    write_artifact(tmp_path / "b.wlm", "lightmap", artifact.settings, parts, artifact.source)
    return error_of(wlm.load, tmp_path / "b.wlm")


def test_damage_is_one_line(tmp_path):
    def more(sizes):
        sizes[0, 0] += 1
        return sizes

    def moved(sizes):
        sizes[0, 0] -= 1
        sizes[0, 1] += 1
        return sizes

    def static(sizes):
        sizes[1] = np.roll(sizes[1], 1)
        return sizes

    assert "part sizes: expected those of 2 tiles" in _changed(tmp_path, sizes=more)
    assert "part sizes: expected those of 2 tiles" in _changed(tmp_path, sizes=lambda sizes: sizes[:1])
    assert f"part sizes is uint32 (2, 3), expected uint32 (any, {len(STREAMS)})" in _changed(
        tmp_path, sizes=lambda sizes: sizes[:, :3]
    )
    assert "part tiles: tile 0: uv ends: expected 8448 bytes" in _changed(tmp_path, sizes=moved)
    assert "part tiles: tile 1" in _changed(tmp_path, sizes=static)
    assert "part tiles: tile 0: uv ends: " in _changed(tmp_path, tiles=lambda tiles: tiles ^ 255)


def test_a_stream_of_another_length_is_one_line(tmp_path):
    import zlib

    def replaced(content):
        def tiles(values):
            return np.frombuffer(zlib.compress(content), np.uint8)

        def sizes(values):
            return np.array([[len(tiles(None)), *[0] * 6], [0] * 7], np.uint32)

        return _changed(tmp_path, tiles=tiles, sizes=sizes)

    assert "expected 8448 bytes, deflated" in replaced(bytes(10))
    assert "expected 8448 bytes, deflated" in replaced(bytes(1 << 24))
    assert "uv indices: expected 8192 bytes, deflated" in replaced(bytes(8448))


def _on_levels(model):
    """The model with networks on 8-bit levels."""
    profile, nets = model.profile, {}
    for name, temporal in (("net", True), ("net_static", False)):
        inputs, width = profile.inputs(temporal), profile.hidden
        values = torch.from_numpy(getattr(model, name).astype(np.float32))
        split = (inputs + width + 2) * width
        parts = values[:, :split].reshape(-1, inputs + width + 2, width), values[:, split:].reshape(-1, width + 1, 3)
        nets[name] = (
            torch.cat([part.flatten(1) for part in put_on_levels(*parts, inputs)], 1).numpy().astype(np.float16)
        )
    return dataclasses.replace(model, profile=profile.override({"net_bits": 8}), **nets)


@pytest.mark.parametrize("factor", [1.0, 1e-6, 1e4, 0.0])
def test_networks_of_bytes_come_back(tmp_path, factor):
    model = random_model((3, 2, 3, 2), hidden=17)
    nets = {name: (getattr(model, name) * np.float16(factor)).astype(np.float16) for name in ("net", "net_static")}
    other = _on_levels(dataclasses.replace(model, **nets))
    size = other.save(tmp_path / "a.wlm")
    assert_same(wlm.load(tmp_path / "a.wlm"), other)
    if factor == 1.0:
        assert part_bytes(other, size)["net"] < 0.65 * part_bytes(model, model.file_bytes())["net"]
        apart = np.abs(other.net.astype(float) - model.net).max() / np.abs(model.net).max()
        assert 0 < apart < 0.5 / 127 + 1e-3


def test_networks_off_their_levels_are_one_line(tmp_path):
    model = random_model((3, 0))
    wrong = dataclasses.replace(model, profile=model.profile.override({"net_bits": 8}))
    assert "net: expected weights on 8-bit levels" in error_of(wrong.save, tmp_path / "a.wlm")


def test_a_fit_on_levels_is_what_its_file_decodes_to(tmp_path):
    profile = small_sets.tiny_profile(net_bits=8, steps=60)
    lightmaps = small_sets.moving_light()
    model = wlm.lightmap.compress(lightmaps, profile)
    model.save(tmp_path / "a.wlm")
    assert_same(wlm.load(tmp_path / "a.wlm"), model)
    plain = wlm.lightmap.compress(lightmaps, small_sets.tiny_profile(steps=60))
    scores = [wlm.lightmap.evaluate(each, lightmaps, metrics=["psnr"]).psnr for each in (model, plain)]
    assert abs(scores[0] - scores[1]) < 2.0
    assert not np.array_equal(model.net, plain.net)
