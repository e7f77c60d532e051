"""Tiles as coded streams: nothing is lost, what isn't read costs nothing, and damage is one line."""

import dataclasses
import zlib

import numpy as np
import pytest
import torch
from builders import small_sets
from builders.checks import assert_same, error_of
from builders.contract import FILES
from builders.synthetic import random_model
from reference.levels import put_on_levels

import wlm
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.bc7 import decode_image, unpack_mode6
from wlm.lightmap.decode import Decoder
from wlm.lightmap.evaluation import part_bytes
from wlm.lightmap.packing import STREAMS, clear_unread
from wlm.lightmap.reads import Reads


def _mask(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((236, 247)) < 0.4


@pytest.mark.parametrize("mask", [None, _mask(), np.zeros((236, 247), bool)], ids=["whole", "gaps", "nothing"])
@pytest.mark.parametrize("kinds", [(3, 2, 1, 0), (3, 3, 2, 2), (0, 0, 0, 2), (1, 0, 1, 0)], ids=str)
def test_nothing_is_lost(tmp_path, mask, kinds):
    model = random_model(kinds, mask=mask)
    size = model.save(tmp_path / "a.wlm")
    assert_same(wlm.load(tmp_path / "a.wlm"), model)
    assert sum(part_bytes(model, size).values()) == size
    assert ("streams" in read_artifact(tmp_path / "a.wlm").parts) == (max(kinds) >= 2)


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


def test_what_is_not_read_costs_nothing(tmp_path):
    used = np.zeros((128, 128), bool)
    used[:108, :50] = True
    # Two times read two slices of four and three rows of six each, and so of the planes.
    model = random_model((3, 0), times=(6.0, 18.0), mask=used[:108].copy(), columns=1, uvt_resolution=32, uvt_slices=4)
    model = dataclasses.replace(model, mask=np.pad(used, ((0, 128), (0, 0)))[:236, :119])
    reads = Reads.of(used, model.profile, model.axis)
    parts = {name: getattr(model, name)[0] for name in ("uv", "uvt", "ut", "vt")}
    cleared = clear_unread(parts, used, reads)
    texels, expected = decode_image(cleared["uv"]), decode_image(model.uv[0])
    assert np.array_equal(texels[used], expected[used])
    # Columns 50 and 51 share blocks with valid texels, later ones have none of their own.
    assert not cleared["uv"][:, 13:, 1:].any() and not cleared["uvt"][:, :, 4:, 1:].any()
    again = clear_unread(cleared, used, reads)
    assert all(np.array_equal(again[name], values) for name, values in cleared.items())
    less = dataclasses.replace(model, **{name: values[None] for name, values in cleared.items()})
    less.save(tmp_path / "a.wlm")
    assert_same(wlm.load(tmp_path / "a.wlm"), less)
    sizes = part_bytes(less, less.file_bytes()), part_bytes(model, model.file_bytes())
    assert all(sizes[0][name] < share * sizes[1][name] for name, share in {"uv": 0.45, "uvt": 0.5, "ut": 0.5}.items())
    for time in (6.0, 7.5, 18.0):
        light, same = Decoder(less).frame(time), Decoder(model).frame(time)
        assert np.array_equal(light[model.mask], same[model.mask]) and light[model.mask].any()


@pytest.mark.parametrize(("count", "period", "rows"), [(6, 24.0, 12), (7, 24.0, 14), (7, None, 14), (13, 24.0, 14)])
def test_what_is_not_read_changes_no_light(count, period, rows):
    used = np.zeros((128, 128), bool)
    used[20:31, 70:75] = True
    mask = np.pad(used, ((0, 128), (0, 0)))[:236, :119]
    times = tuple(np.linspace(0.0, 23.0, 7))
    model = random_model((3, 0), columns=1, times=times, period=period, uvt_slices=count, plane_rows=2 * count)
    model = dataclasses.replace(model, mask=mask)
    reads = Reads.of(used, model.profile, model.axis)
    assert reads.rows.sum() == rows and reads.columns.sum() < 16 and reads.texels.sum() < 10
    other = {name: getattr(model, name) ^ np.uint8(255) for name in ("ut", "vt")}
    for name, columns in zip(("ut", "vt"), reads.columns, strict=True):
        read = reads.rows[:, None] & columns
        other[name][0][read] = getattr(model, name)[0][read]
    other["uvt"] = np.roll(model.uvt, 1, 1)
    other["uvt"][0, reads.slices] = model.uvt[0, reads.slices]
    one, two = (Decoder(each) for each in (model, dataclasses.replace(model, **other)))
    assert all(np.array_equal(one.frame(time)[mask], two.frame(time)[mask]) for time in (*times, 11.0))


def test_a_file_of_deflated_streams_is_the_same_model(tmp_path):
    model = wlm.load(FILES / "lightmap-packed.wlm")
    assert "sizes" in read_artifact(FILES / "lightmap-packed.wlm").parts
    assert_same(wlm.load(FILES / "lightmap-coded.wlm"), model)
    # The coder's arithmetic is exact: the same bytes everywhere.
    model.save(tmp_path / "a.wlm")
    assert (tmp_path / "a.wlm").read_bytes() == (FILES / "lightmap-coded.wlm").read_bytes()


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
        sizes[0, 0] -= 9
        sizes[0, 1] += 9
        return sizes

    def static(sizes):
        sizes[1] = np.roll(sizes[1], 1)
        return sizes

    assert "part stream_sizes: expected those of 2 tiles" in _changed(tmp_path, stream_sizes=more)
    assert "part stream_sizes: expected those of 2 tiles" in _changed(tmp_path, stream_sizes=lambda sizes: sizes[:1])
    assert f"part stream_sizes is uint32 (2, 3), expected uint32 (any, {len(STREAMS)})" in _changed(
        tmp_path, stream_sizes=lambda sizes: sizes[:, :3]
    )
    assert "part streams: tile 0: uv: expected another length" in _changed(tmp_path, stream_sizes=moved)
    assert "part streams: tile 1: uvt: is static, and has one" in _changed(tmp_path, stream_sizes=static)
    assert "part streams: tile 0: uv: expected a first byte below 16" in _changed(
        tmp_path, streams=lambda streams: streams ^ 255
    )


def test_a_stream_that_is_cut_short_ends_the_reading(tmp_path):
    sizes = np.array([[2] * 5, [2, 0, 0, 0, 2]], np.uint32)
    line = _changed(tmp_path, streams=lambda _: np.zeros(14, np.uint8), stream_sizes=lambda _: sizes)
    assert "part streams: tile 0: uv: expected another length than 2 bytes" in line


def test_the_deflated_streams_of_earlier_files_are_checked(tmp_path):
    artifact = read_artifact(FILES / "lightmap-packed.wlm")

    def refused(**tensors):
        parts = artifact.tensors | {name: value(artifact.tensors[name].copy()) for name, value in tensors.items()}
        write_artifact(tmp_path / "b.wlm", "lightmap", artifact.settings, parts, artifact.source)
        return error_of(wlm.load, tmp_path / "b.wlm")

    def first(content):
        def changed(tiles):
            stream = np.frombuffer(zlib.compress(content), np.uint8)
            return np.concatenate([stream, tiles[artifact.tensors["sizes"][0, 0] :]])

        def sizes(values):
            values[0, 0] = len(zlib.compress(content))
            return values

        return refused(tiles=changed, sizes=sizes)

    assert "part sizes: expected those of" in refused(sizes=lambda sizes: sizes + 1)
    assert "uv ends: expected 8448 bytes, deflated" in first(bytes(10))
    assert "uv ends: expected 8448 bytes, deflated" in first(bytes(1 << 24))
    assert "expected endpoints of 7 bits" in first(bytes([255]) * 8448)


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
        assert part_bytes(other, size)["net"] < 0.7 * part_bytes(model, model.file_bytes())["net"]
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


def test_a_fit_on_fewer_levels_is_what_its_file_decodes_to(tmp_path):
    lightmaps = small_sets.moving_light()
    models = [wlm.lightmap.compress(lightmaps, small_sets.tiny_profile(steps=60, map_bits=bits)) for bits in (6, 8)]
    for model, step in zip(models, (4, 1), strict=True):
        ends = np.concatenate([unpack_mode6(blocks.reshape(-1, 16))[0] for blocks in (model.uv, model.uvt)])
        assert np.gcd.reduce(ends, axis=None) == np.gcd.reduce(model.ut, axis=None) == step
        assert_same(wlm.load(model.save(tmp_path / "a.wlm") and tmp_path / "a.wlm"), model)
    assert models[0].file_bytes() < 0.95 * models[1].file_bytes()
    scores = [wlm.lightmap.evaluate(each, lightmaps, metrics=["psnr"]).psnr for each in models]
    assert abs(scores[0] - scores[1]) < 1.0
