"""A digest says that a file is whole, not that it is sane: each part and setting is checked before it is used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from builders.checks import put
from builders.kept_files import KEPT, Kept
from builders.resigned import GONE, WEIRD, rewrite, rewrite_number

import wlm
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.zstd import compress

MODELS = ("lightmap", "lightmap-frames", "lightmap-layers", "atlas-tiles", "atlas-cascade", "atlas-bc6h", "smoke")
MOST = 6  # parts of a file that are tried: a network's weights are all alike

# What is a good value after all.
ACCEPTED = {
    ("name", "text"),
    ("uv_set", "zero"),
    ("metres", "true"),
    ("hides", "true"),
    ("period", "none"),
    ("dropped", "zero"),
    ("report", "mapping"),
    ("summary", "mapping"),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "kept.wlm.partial"


def written(path: Path, name: str) -> Kept:
    kept = KEPT[name]()
    path.write_bytes(kept.content)
    return kept


def refused(kept: Kept, path: Path, *words: str) -> str:
    with pytest.raises(WlmError) as caught:
        kept.read(path)
    line = str(caught.value)
    assert "\n" not in line and "kept.wlm.partial" in line and all(word in line for word in words), line
    return line


def last(name: str) -> str:
    """A part's name as its reader has it: without its batch, its lattice or its sheet."""
    if name.startswith(("running.", "finished.")):
        return name.split(".", 2)[2]
    return name.removeprefix("lattice.").lstrip("0123456789.")


def longer(value: np.ndarray, axis: int) -> np.ndarray:
    return np.concatenate([value, value.take([0], axis)], axis)


@pytest.mark.parametrize("name", KEPT)
def test_a_good_file_is_read(name, path):
    written(path, name).read(path)


@pytest.mark.parametrize("name", KEPT)
def test_wrong_parts_are_one_line(name, path):
    kept = written(path, name)
    tensors = read_artifact(path).tensors
    for part in list(tensors)[:: -(-len(tensors) // MOST)]:
        value, free = tensors[part], kept.free.get(part, "")
        changes = [(value.astype(np.float32 if value.dtype == np.int64 else np.int64), True), (value[None], True)]
        if "missing" not in free:
            changes.append((GONE, True))
        # Another length may as well be the fault of the parts that don't fit it.
        sizes = free.count("size") + free.count("sizes")
        changes += [(longer(value, axis), False) for axis in range(sizes, value.ndim)]
        if value.dtype.kind == "f" and "nan" not in free:
            changes += [(put((0,) * value.ndim, number)(value), True) for number in (np.nan, np.inf)]
        for change, named in changes:
            written(path, name)
            rewrite(path, tensors={part: change})
            refused(kept, path, *[last(part)] * named)


@pytest.mark.parametrize("name", KEPT)
def test_numbers_out_of_range_are_one_line(name, path):
    kept = KEPT[name]()
    for part, (place, value) in kept.ranges.items():
        written(path, name)
        rewrite(path, tensors={part: put(place, value)})
        refused(kept, path, last(part))


@pytest.mark.parametrize("name", KEPT)
def test_a_part_that_is_none_of_the_files_is_one_line(name, path):
    kept = written(path, name)
    prefix = next(iter(read_artifact(path).tensors)).rpartition(".")[0] if "-" in name or name == "training" else ""
    prefix = ".".join(prefix.split(".")[:2])
    rewrite(path, tensors={f"{prefix}.more".lstrip("."): np.zeros(3, np.float16)})
    refused(kept, path, "more")


@pytest.mark.parametrize("name", MODELS)
def test_weird_settings_are_one_line(name, path):
    kept = written(path, name)
    for key in read_artifact(path).settings:
        for kind, value in [*WEIRD.items(), ("gone", GONE)]:
            written(path, name)
            rewrite(path, {key: value})
            if (key, kind) in ACCEPTED:
                kept.read(path)
            elif (key, kind) == ("period", "fraction"):
                refused(kept, path, "times: expected 0 to the period 1.5")
            else:
                refused(kept, path, "setting ", key)
        for text in ("NaN", "Infinity", "-Infinity", "1e999"):
            written(path, name)
            rewrite_number(path, key, text)
            refused(kept, path, f"expected finite numbers, found {text}")


def _sized(*size) -> dict:
    """The settings of a lightmap's file with one sheet of this size."""
    sheet = {"name": "random", "atlas": "0", "layer": "light", "channels": ["R", "G", "B"], "encoding": "radiance"}
    return {"sheets": [sheet | {"size": list(size)}]}


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("lightmap", _sized(1e300, 1), "setting sheets.0.size.0: expected a valid integer"),
        ("lightmap", _sized(128, -128), "setting size: expected a width and a height"),
        ("lightmap", _sized(10**12, 10**12), "in all sheets together"),
        ("lightmap", {"period": 1e-320}, "part times: expected 0 to the period 9.99989e-321, found 0 to 19"),
        ("atlas-bc6h", {"sizes": [[16384, 16384]]}, "part mask is uint8 (240,), expected uint8 (33554432)"),
        ("atlas-cascade", {"sizes": [[65536, 65536]]}, "at most 268435456 texels and 65536 along a side, found 65536"),
        ("smoke", {"network": {"width": 2**70}}, "setting network.width"),
    ],
)
def test_settings_out_of_range_are_one_line(name, settings, words, path):
    kept = written(path, name)
    rewrite(path, settings)
    refused(kept, path, words)


def test_a_few_bytes_that_claim_a_large_lightmap(path):
    """The file has only empty tiles, and the largest accepted one takes no memory for them."""
    kept = written(path, "lightmap")
    artifact = read_artifact(path)
    parts = {name: GONE for name in (*artifact.tensors, *artifact.pieces) if name not in ("0.kind", "times")}
    rewrite(path, _sized(32768, 32768), parts | {"0.kind": np.zeros(65536, np.uint8)})
    refused(kept, path, "at most 268435456 texels in all sheets together, found 1073741824")
    rewrite(path, _sized(16384, 16384), {"0.kind": np.zeros(16384, np.uint8)})
    light = wlm.load(path).light
    assert (light.height, light.width) == (16384, 16384)


def test_a_few_bytes_that_claim_many_frames(path):
    kept = written(path, "lightmap-frames")
    kind, times = np.full(16384, 4, np.uint8), np.arange(8, dtype=np.float64)
    ranges, tiles = np.zeros((16384, 8, 2, 3), np.float16), [b""] * 16384
    parts = {"0.kind": kind, "times": times, "0.mask": GONE, "0.ranges": ranges, "0.tiles": tiles}
    rewrite(path, _sized(16384, 16384), parts)
    refused(kept, path, "the file: expected at most 256 times its")


def test_a_few_bytes_that_claim_a_large_atlas(path):
    kept = written(path, "atlas-bc6h")
    settings = {"sizes": [[65536, 65536]], "texels": [1, 1], "colour": "half"}
    rewrite(path, settings, {"colour": np.zeros((1, 1, 1, 3), np.float16)})
    refused(kept, path, "found 65536 x 65536")
    mask = np.full(1 << 23, 255, np.uint8)
    frame = np.frombuffer(compress(mask.tobytes()), np.uint8)
    rewrite(path, {"sizes": [[8192, 8192]], "parts": {"mask": [1 << 23]}}, {"mask": frame})
    refused(kept, path, "at most 65536 texels of a lightmap for each texel of its textures, which have 1, found")


def test_a_few_bytes_that_claim_a_large_network(path):
    kept = written(path, "smoke")
    weights = dict.fromkeys(read_artifact(path).tensors, GONE)
    rewrite(path, {"network": {"width": 64, "levels": 6}}, weights)
    refused(kept, path, "part encoder.5.2.weight is missing")


@pytest.mark.parametrize("name", [name for name in MODELS if name not in ("smoke",)])
def test_a_name_does_not_reach_the_terminal_as_orders(name, path):
    written(path, name)
    profile = read_artifact(path).settings["profile"] | {"name": "p\x9b2J"}
    rewrite(path, {"name": "a\x1b]0;title\x07\x1b[2J\u202eb\ud7ff é", "profile": profile})
    model = wlm.load(path)
    assert model.name == "a ]0;title  [2J b  é" and model.profile.name == "p 2J"


def test_a_source_that_is_no_word(path):
    kept = written(path, "lightmap")
    content, source = path.read_bytes(), read_artifact(path).source.encode()
    assert len(source) == 16 and source in content
    path.write_bytes(content.replace(source, source[:9] + b"\\u001bf", 1))
    refused(kept, path, "expected words in printable ASCII")


def test_writing_holds_what_reading_asks(tmp_path):
    """A fit that diverged leaves no file."""
    written(tmp_path / "good.wlm", "lightmap")
    model = wlm.load(tmp_path / "good.wlm")
    (sheet,) = model.sheets.values()
    sheet.constant = sheet.constant.copy()
    sheet.constant[0, 0] = np.nan
    with pytest.raises(WlmError, match=r"new.wlm: not written: .*part constant: expected finite numbers"):
        model.save(tmp_path / "new.wlm")
    assert not (tmp_path / "new.wlm").exists()


def test_a_batch_with_a_number_that_is_none(path):
    written(path, "lightmap-running")
    artifact = read_artifact(path)
    for number in ("9" * 5000, "٣", "-1", ""):
        tensors = {f"running.{number}.loss": np.zeros(1, np.float32)}
        write_artifact(path, artifact.system, artifact.settings, tensors, artifact.source)
        refused(KEPT["lightmap-running"](), path, "is of neither a finished nor a running batch")
