"""The export for an engine: its numbers decode to the same light with NumPy alone."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from builders.exported import read_export
from builders.probe_models import EXTENT, ORIGIN, SIZE, random_model, with_content
from probe.test_shaders import SHAPES

from wlm.errors import WlmError
from wlm.export import export


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


class Files:
    """A raw folder, read as "about" and the head of probe.glsl say, in float64."""

    def __init__(self, folder):
        self.info, arrays = read_export(folder)
        info, words = self.info, arrays["gaussians"]
        halves = arrays["network"].view("<f2").astype(np.float64)
        self.words = words
        latent, hidden, count = info["latent"], info["hidden"], info["gaussians"]
        per, first = info["words_per_gaussian"], info["first_gaussian_word"]
        assert words[9] == count and len(words) == first + count * per
        codes = words[first:].view("<u2").reshape(count, 2 * per)[:, : 10 + latent]
        numbers = np.array(info["low"]) + codes * np.array(info["step"])
        self.centre, self.scale = numbers[:, :3], np.exp(numbers[:, 3:6])
        q = numbers[:, 6:10]
        norm = np.linalg.norm(q, axis=1, keepdims=True)
        w, x, y, z = np.where(norm < 1e-12, [1.0, 0.0, 0.0, 0.0], q / np.where(norm < 1e-12, 1.0, norm)).T
        self.rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        ).transpose(2, 0, 1)
        self.latent = numbers[:, 10:]
        self.layers, at = [], 0
        sizes = [latent + 3, hidden, hidden, info["outputs"]]
        for inputs, outputs in itertools.pairwise(sizes):
            rows, fours = 1 + -(-inputs // 4) * 4, -(-outputs // 4)
            layer = halves[at : at + 4 * rows * fours].reshape(fours, rows, 4).transpose(1, 0, 2).reshape(rows, -1)
            at += layer.size
            assert not layer[1 + inputs :].any() and not layer[:, outputs:].any()
            self.layers.append((layer[1 : 1 + inputs, :outputs], layer[0, :outputs]))
        assert at == len(halves)

    def place(self, position):
        x = (np.asarray(position) - self.info["origin"]) / self.info["extent"]
        return np.clip(x, 0.0, self.info["size"])

    def weights(self, x):
        """[M, K], 0 where a Gaussian doesn't reach."""
        d = x[:, None] - self.centre
        u = np.einsum("kij,mki->mkj", self.rotation, d) / self.scale
        square, cut = (u**2).sum(2), self.info["cut"]
        if self.info["support"] == "sphere":
            reached = (d**2).sum(2) < (cut * self.scale.max(1)) ** 2
        else:
            reached = square < cut**2
        return np.where(reached, np.exp(-0.5 * square), 0.0)

    def values(self, position):
        x = self.place(position)
        h = np.concatenate([self.weights(x) @ self.latent, x], 1)
        (w1, b1), (w2, b2), (w3, b3) = self.layers
        return self.info["gain"] * (sigmoid(sigmoid(h @ w1 + b1) @ w2 + b2) @ w3 + b3)

    def reach(self):
        """[K, 3], half the box round what a Gaussian reaches."""
        if self.info["support"] == "sphere":
            return np.repeat(self.info["cut"] * self.scale.max(1, keepdims=True), 3, 1)
        return self.info["cut"] * np.sqrt(((self.rotation * self.scale[:, None]) ** 2).sum(2))


def places(count=200, seed=1):
    """Positions in the box and a little beyond."""
    return ORIGIN + EXTENT * SIZE * np.random.default_rng(seed).uniform(-0.1, 1.1, (count, 3))


@pytest.mark.parametrize("settings", SHAPES, ids=str)
def test_the_files_alone_give_the_decoders_light(settings, tmp_path):
    model = random_model(**settings)
    export(model, tmp_path)
    files = Files(tmp_path)
    expected = model.decoder().decode(places())
    assert np.ptp(expected, axis=0).min() > 0, "the light varies"
    # float32 in the decoder.
    np.testing.assert_allclose(files.values(places()), expected, rtol=0, atol=2e-5 * np.abs(expected).max())
    # The reference, whose last point is outside the box.
    _, arrays = read_export(tmp_path)
    position, values = arrays["position"], arrays["values"]
    assert values.shape == (min(model.content.count, 64) + 1, model.outputs)
    assert (position[-1] > ORIGIN + EXTENT * SIZE).all()
    np.testing.assert_allclose(files.values(position), values, rtol=0, atol=2e-5 * np.abs(values).max())


def test_the_lists_leave_nothing_out(tmp_path):
    for settings in ({}, {"support": "sphere"}):
        export(random_model(count=60, **settings), tmp_path)
        files = Files(tmp_path)
        x = files.place(places(400))
        side = max(files.info["size"]) / 8
        reach, listed = files.reach(), np.zeros((len(x), 60), bool)
        for i, cell in enumerate(np.floor(x / side)):
            low, high = cell * side - 1e-6, (cell + 1) * side + 1e-6
            listed[i] = ((files.centre + reach >= low) & (files.centre - reach <= high)).all(1)
        assert not files.weights(x)[~listed].any()
        assert listed.mean() < 0.9


def test_what_is_written(tmp_path):
    model = random_model(positions=True, dead=4)
    paths = export(model, tmp_path)
    assert [path.name for path in paths] == [
        "gaussians.bin",
        "network.bin",
        "position.bin",
        "positions.bin",
        "probe.glsl",
        "values.bin",
        "bundle.json",
    ]
    assert sorted(paths) == sorted(tmp_path.iterdir())
    info, arrays = read_export(tmp_path)
    assert (info["source"], info["probes"], info["gaussians"]) == (model.source, 200, 40)
    assert info["dead"] == np.flatnonzero(model.dead).tolist() and len(info["dead"]) == 4
    assert set(info["about"]) >= {"position", "gaussian", "network", "lists", "dead", "positions", "reference"}
    codes = arrays["positions"].reshape(-1, 3)
    position = np.array(info["origin"]) + info["extent"] * np.array(info["size"]) * codes / 65535
    np.testing.assert_allclose(position, model.stored_positions(), rtol=1e-12)
    # As many bytes as half floats would take, but for the head (section 5.3.2).
    assert arrays["gaussians"].nbytes == 40 * 40 + 4 * (10 + 2 * 19)


def test_what_cannot_be_exported(tmp_path):
    model = random_model()
    net = model.content.net.copy()
    net[-5:] = np.inf
    with pytest.raises(WlmError, match="random: cannot export: the model decodes to NaN or infinity"):
        export(with_content(model, net=net), tmp_path / "new")
    for extent in (1e39, 1e-60):
        with pytest.raises(WlmError, match="random: cannot export: the probes' box is too"):
            export(replace(model, extent=extent), tmp_path / "new")
    with pytest.raises(WlmError, match="device 'tpu'"):
        export(model, tmp_path / "new", device="tpu")
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("x")
    with pytest.raises(WlmError, match="cannot write there"):
        export(model, tmp_path / "file")
