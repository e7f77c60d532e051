import hashlib
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import safetensors
import safetensors.numpy
from builders.checks import error_of

from wlm.errors import WlmError
from wlm.formats.artifact import FORMAT_VERSION, read_artifact, write_artifact

SOURCE = "0123456789abcdef" * 2
SETTINGS = {
    "profile": "M",
    "tile": 128,
    "channels": [16, 12],
    "rate": 0.01,
    "emissive": False,
    "note": 'it\'s "quoted" \\ and ü, \u2028 too',
    "nested": {"none": None, "text": "'"},
}


def _tensors() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    return {
        "codes": rng.integers(0, 256, (3, 5, 16), np.uint8),
        "weights": rng.standard_normal((7, 3)).astype(np.float16),
        "times": rng.random(5, np.float32),
        "offsets": rng.integers(0, 2**40, 3, np.int64),
        "on": np.array([True, False, True]),
        "scalar": np.float32(2.5).reshape(()),
        "empty": np.empty((0, 4), np.uint16),
    }


@pytest.fixture
def artifact(tmp_path: Path) -> Path:
    path = tmp_path / "a.wlm"
    write_artifact(path, "lightmap", SETTINGS, _tensors(), SOURCE)
    return path


def _refusal(path: Path, content: bytes | bytearray | None = None, system: str | None = None) -> str:
    """Reads what must be refused and gives the line, without the path at its start."""
    if content is not None:
        path.write_bytes(content)
    line = error_of(read_artifact, path, system)
    assert line.startswith(f"{path}: ")
    return line.removeprefix(f"{path}: ")


def _split(whole: bytes) -> tuple[dict, bytes]:
    (length,) = struct.unpack_from("<Q", whole)
    return json.loads(whole[8 : 8 + length]), whole[8 + length :]


def _join(header: dict, payload: bytes) -> bytes:
    encoded = json.dumps(header, separators=(",", ":")).encode()
    return struct.pack("<Q", len(encoded)) + encoded + payload


def _signed(header: dict, payload: bytes) -> bytes:
    """A file with a right digest, made by the documented rule and not by the writer's code."""
    zeros = "0" * 32
    words = header["__metadata__"]["wlm"].split(" ")
    header["__metadata__"]["wlm"] = " ".join([*words[:3], zeros])
    digest = hashlib.blake2b(_join(header, payload), digest_size=16).hexdigest()
    header["__metadata__"]["wlm"] = " ".join([*words[:3], digest])
    return _join(header, payload)


def test_what_was_written_is_read(artifact):
    found = read_artifact(artifact, "lightmap")
    assert (found.system, found.version, found.source) == ("lightmap", FORMAT_VERSION, SOURCE)
    assert found.settings == SETTINGS
    assert found.tensors.keys() == _tensors().keys()
    for name, tensor in _tensors().items():
        assert found.tensors[name].dtype == tensor.dtype
        assert found.tensors[name].shape == tensor.shape
        assert np.array_equal(found.tensors[name], tensor)
        assert found.parts[name] == tensor.nbytes
        assert found.tensors[name].flags.aligned
        with pytest.raises(ValueError, match="read-only"):
            found.tensors[name][...] = 0
    assert found.file_bytes == artifact.stat().st_size == found.header_bytes + sum(found.parts.values())


def test_the_safetensors_library_reads_it(artifact):
    loaded = safetensors.numpy.load_file(artifact)
    assert loaded.keys() == _tensors().keys()
    assert all(np.array_equal(loaded[name], tensor) for name, tensor in _tensors().items())
    with safetensors.safe_open(artifact, "numpy") as file:
        settings = file.metadata()["settings"]
    swap = str.maketrans("'\"", "\"'")
    assert json.loads(settings.translate(swap)) == SETTINGS


def test_a_source_of_zeros_is_not_taken_for_the_digest(tmp_path):
    path = tmp_path / "z.wlm"
    write_artifact(path, "probe", {"text": "0" * 32}, {}, "0" * 32)
    found = read_artifact(path)
    assert found.source == "0" * 32 and found.tensors == {} and found.settings == {"text": "0" * 32}


def test_strided_and_big_endian_arrays_are_stored_as_their_values(tmp_path):
    path = tmp_path / "s.wlm"
    base = np.arange(24, dtype=np.float32).reshape(4, 6)
    write_artifact(path, "probe", {}, {"t": base.T, "step": base[:, ::2], "big": base.astype(">f4")}, "x")
    found = read_artifact(path).tensors
    assert np.array_equal(found["t"], base.T) and np.array_equal(found["step"], base[:, ::2])
    assert np.array_equal(found["big"], base)


def test_no_later_change_of_the_file_reaches_an_artifact(artifact):
    before, content = read_artifact(artifact), artifact.read_bytes()
    artifact.write_bytes(content[: len(content) // 2].swapcase())
    for name, value in _tensors().items():
        np.testing.assert_array_equal(before.tensors[name], value)


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "a.wlm"
    assert "No such file" in _refusal(path)
    assert "found a folder" in _refusal(tmp_path)
    assert "found a file of 0 bytes" in _refusal(path, b"")
    assert "found other content" in _refusal(path, struct.pack("<Q", 2**63) + b"{}")
    assert "cut short" in _refusal(path, struct.pack("<Q", 10) + b"{}")
    assert "header is damaged" in _refusal(path, struct.pack("<Q", 9000) + b'{"":' * 2250)
    safetensors.numpy.save_file({"a": np.zeros(3)}, path)
    assert "without its metadata" in _refusal(path)
    safetensors.numpy.save_file({"a": np.zeros(3)}, path, {"wlm": "one"})
    assert "expected an integer" in _refusal(path)
    safetensors.numpy.save_file({"a": np.zeros(3)}, path, {"wlm": "1 x"})
    assert "expected a text of four words and settings" in _refusal(path)


def test_a_changed_payload_or_name_is_told_by_the_digest(artifact):
    whole = artifact.read_bytes()
    message = "the artifact is damaged: its content does not match its digest"
    assert _refusal(artifact, whole[:-1] + bytes([whole[-1] ^ 1])) == message
    assert "expected the end of the file, found 1 more" in _refusal(artifact, whole + b"\0")
    assert _refusal(artifact, whole.replace(b'"codes"', b'"coder"')) == message
    assert _refusal(artifact, whole.replace(b"'tile':128", b"'tile':129")) == message
    assert _refusal(artifact, whole.replace(SOURCE.encode(), SOURCE[::-1].encode())) == message
    stated = _split(whole)[0]["__metadata__"]["wlm"].split(" ")[3].encode()
    assert stated.upper() != stated
    assert _refusal(artifact, whole.replace(stated, stated.upper())) == message


def test_a_newer_version_and_another_system_are_named(artifact):
    whole = artifact.read_bytes()
    newer = whole.replace(b'"3 lightmap', b'"4 lightmap')
    assert _refusal(artifact, newer) == "artifact version 4: expected at most 3; update wlm"
    # A newer version may well say other things after its number.
    header, payload = _split(whole)
    header["__metadata__"] = {"wlm": "12"}
    assert "artifact version 12: expected at most 3" in _refusal(artifact, _join(header, payload))
    older = whole.replace(b'"3 lightmap', b'"2 lightmap')
    assert _refusal(artifact, older) == "artifact version 2: expected 3; compress the input again"
    line = _refusal(artifact, whole, system="probe")
    assert line == "expected an artifact of probe, found one of lightmap"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"shape": [3, 5, 15]}, "expected 225 bytes, found 240"),
        ({"dtype": "F16"}, "expected 480 bytes, found 240"),
        ({"shape": [-3, -5, 16]}, "expected a type, a shape and two offsets"),
        ({"data_offsets": [0, 240]}, "expected its data at byte"),
    ],
)
def test_wrong_part_sizes_are_named_even_under_a_right_digest(artifact, change, words):
    header, payload = _split(artifact.read_bytes())
    header["codes"].update(change)
    line = _refusal(artifact, _signed(header, payload))
    assert words in line and line.startswith("part ")


def test_wrong_settings_under_a_right_digest_are_refused(artifact):
    header, payload = _split(artifact.read_bytes())
    assert read_artifact(artifact) and _signed(header, payload)
    for text in ("{", "[1]", ""):
        header["__metadata__"]["settings"] = text
        assert "settings is damaged" in _refusal(artifact, _signed(header, payload))
    header["__metadata__"]["settings"] = "{}"
    artifact.write_bytes(_signed(header, payload))
    assert read_artifact(artifact).settings == {}


@pytest.mark.parametrize("shape", [[0, 1 << 62], [0] + [1 << 20] * 4, [1] * 9, [0] * 100])
def test_sizes_of_an_empty_part_are_bounded(tmp_path, shape):
    write_artifact(tmp_path / "a.wlm", "lightmap", {}, {"part": np.zeros(0, np.uint8)}, "0")
    content = (tmp_path / "a.wlm").read_bytes()
    header = json.loads(content[8:])
    header["part"] = {"dtype": "U8", "shape": shape, "data_offsets": [0, int(0 not in shape)]}
    text = json.dumps(header).encode()
    (tmp_path / "a.wlm").write_bytes(len(text).to_bytes(8, "little") + text + b"\0" * (0 not in shape))
    with pytest.raises(WlmError, match="part: the shape .* exceeds 8 axes"):
        read_artifact(tmp_path / "a.wlm")
