"""Readers of artifacts: the models of the four systems, the checkpoints of their fits, and pools of samples."""

import functools
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from builders.kept_files import KEPT
from builders.probe_sets import synthetic
from builders.small_sets import moving_light, tiny_profile
from typer.testing import CliRunner

import wlm
from wlm.cli import app
from wlm.errors import WlmError
from wlm.formats.exr import read_every_channel
from wlm.lightmap import fit as lightmap_fit
from wlm.probe import fit as probe_fit
from wlm.smoke.transport.orders import load_orders
from wlm.system import Meter

from .containers import signed, vary_artifact, vary_compact, vary_npz
from .reader import Reader, check_digest, check_finite, corpus, stored


def _lightmap(path: Path) -> None:
    model = wlm.load(path, "lightmap")
    check_digest(path)
    for sheet, own in model.sheets.items():
        check_finite(**own.parts, times=own.times)
        values = model.decoder().frame(float(model.times.mean()), sheet.layer, sheet.atlas)
        check_finite(values=values)
        assert values.shape[:2] == (own.height, own.width), "decodes to another size"
        assert sheet.linear or (values >= 0).all(), "decodes to light below 0"


def _probe(path: Path) -> None:
    model = wlm.load(path, "probe")
    check_digest(path)
    check_finite(origin=model.origin, extent=model.extent, size=model.size)
    if model.method == "pca":
        check_finite(values=model.decoder().decode_probes())
        return
    check_finite(bounds=model.content.bounds, net=model.content.net, gain=model.content.gain)
    places = np.linspace(0.0, 1.0, 8)[:, None]
    with np.errstate(over="ignore"):
        position = model.origin + model.extent * model.size * places
    if np.isfinite(position).all():
        check_finite(values=model.decoder().decode(position))


def _atlas(path: Path) -> None:
    model = wlm.load(path, "atlas")
    check_digest(path)
    check_finite(texels=model.texels, uv=model.uv, factor=model.factor)
    generator = torch.Generator().manual_seed(0)
    sheet = torch.randint(0, len(model.sheets), (64,), generator=generator)
    light = model.decoder().read(torch.rand(64, 2, generator=generator), sheet)
    check_finite(light=light)
    assert (light >= 0).all(), "decodes to negative light"


def _network(path: Path) -> None:
    model = wlm.load(path, "smoke-network")
    check_digest(path)
    check_finite(**model.network.state_dict())
    guide = torch.linspace(0.0, 1.0, 3 * 16 * 16).reshape(3, 16, 16)
    if model.settings.guide == "paper":
        planes = model.decoder(height=16, width=16)(guide)
        assert planes.shape == (8, 16, 16), f"decodes to {tuple(planes.shape)}"
    words = [path.with_name("volume.npz"), "--network", path, "--resolution", "16", "-o", path.with_name("out.exr")]
    result = CliRunner().invoke(app, ["smoke", "predict", *map(str, words)])
    try:
        if result.exit_code != 2:
            assert result.exit_code == 0, repr(result.exception)
            check_finite(planes=read_every_channel(path.with_name("out.exr"))[0])
    finally:
        path.with_name("out.exr").unlink(missing_ok=True)


def _extreme(draw: Random, data: bytes) -> bytes:
    """Scales weights of a network to the ends of half floats, or changes an artifact in any other way."""
    if draw.random() < 0.6:
        return vary_artifact(draw, data)
    size = 8 + int.from_bytes(data[:8], "little")
    weights = np.frombuffer(data[size:], "<f2").astype(np.float64)
    first, last = sorted(draw.choices(range(len(weights)), k=2))
    with np.errstate(over="ignore"):
        weights[first:last] = (weights[first:last] * draw.choice((0.0, 1e-9, 30.0, 1e3, 1e5, -1e9))).clip(-65504, 65504)
    return signed(data[:size], weights.astype("<f2").tobytes())


@functools.cache
def _networks() -> Sequence[bytes]:
    """A network, and one with longer steps of its guiding map, for which another kernel is compiled."""
    (data,) = stored("smoke.wlm")()
    size = 8 + int.from_bytes(data[:8], "little")
    header = re.sub(rb"'guide_step':[^,]*", b"'guide_step':32", data[:size])
    return data, signed(header, data[size:])


def _plume() -> Mapping[str, bytes]:
    return {"volume.npz": corpus("volume.npz")()[0]}


@functools.cache
def _shipped_orders() -> Sequence[bytes]:
    return ((Path(wlm.__file__).parent / "data" / "smoke-orders.npz").read_bytes(),)


def _orders(path: Path) -> None:
    model = load_orders(path)
    check_finite(weights=model.weights, known=model.known)
    assert model.known[0] < model.known[1], "accepted an empty range"


def _bytes_of(make: Any) -> bytes:
    """The content of the file `x.partial` that `make` writes for the output `x` in an empty folder."""
    with tempfile.TemporaryDirectory() as folder:
        make(Path(folder) / "x")
        return (Path(folder) / "x.partial").read_bytes()


def _again(model: Any, path: Path) -> None:
    """Fails where the model that a fit makes of an accepted checkpoint cannot be saved and loaded."""
    again = path.with_name("again.wlm")
    try:
        model.save(again)
        try:
            wlm.load(again, model.SYSTEM)
        except WlmError as error:
            raise AssertionError(f"made a file that can't be read: {error}") from error
    finally:
        again.unlink(missing_ok=True)


@functools.cache
def _fits() -> dict[str, tuple[Any, Any]]:
    """The input and the profile of a short fit, by system."""
    probes = wlm.probe.Profile(name="tiny", method="gaussians", ratio=0.1, steps=10, hidden=16, latent=3)
    return {"lightmap": (moving_light(hours=(0.0, 11.0)), tiny_profile(steps=10)), "probe": (synthetic(60), probes)}


@functools.cache
def _states(module: Any, system: str) -> Sequence[bytes]:
    """The checkpoint of a running fit and, of lightmaps, that of a finished one."""
    data, profile = _fits()[system]

    def write(output: Path, **options: Any) -> None:
        checkpoint = module.open_checkpoint(output, data, profile)
        module.compress(data, profile, checkpoint=checkpoint, **options)

    def stop(progress: Any) -> None:
        raise KeyboardInterrupt

    def running(output: Path) -> None:
        with patch.object(Meter, "due", lambda self, done: True), suppress(KeyboardInterrupt):
            write(output, progress=stop)

    return tuple(_bytes_of(make) for make in (running, *[write] * (system == "lightmap")))


def _resume(module: Any, system: str, path: Path) -> None:
    """Continues a fit to its end."""
    data, profile = _fits()[system]
    checkpoint = module.open_checkpoint(path.with_suffix(""), data, profile, resume=True)
    check_digest(path)
    with _diverging():
        _again(module.compress(data, profile, checkpoint=checkpoint), path)


def _checkpoints(module: Any, system: str, cost: int) -> Reader:
    seeds, read = partial(_states, module, system), partial(_resume, module, system)
    return Reader(f"{system}-checkpoint", "a.partial", seeds, vary_artifact, read, cost=cost)


def _smoke_checkpoint(path: Path) -> None:
    solver = KEPT["simulation"]().read(path)
    check_digest(path)
    check_finite(density=solver.density.numpy())
    assert (solver.density.numpy() >= 0).all(), "accepted a negative density"
    # Any air may blow up, which is said.
    with suppress(WlmError):
        solver.step()
        solver.check()


def _kept(name: str) -> Callable[[], Sequence[bytes]]:
    return lambda: (KEPT[name]().content,)


def _network_checkpoint(path: Path) -> None:
    output = path.with_suffix("")
    try:
        with _diverging():
            training = KEPT["training"]().read(path)
            # A training whose time was up before its first validation has no network yet.
            if training.model is not None:
                _again(training.model, path)
    finally:
        for written in (output, Path(f"{output}.csv")):
            written.unlink(missing_ok=True)


class _diverging:
    """Passes over the error of a fit that diverged from a state of valid but absurd numbers: it names no file."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> bool:
        return isinstance(error, WlmError) and "diverged" in str(error)


_LIGHTMAPS = ("lightmap.wlm", "lightmap-frames.wlm", "lightmap-layers.wlm", "lightmap-groups.wlm")
_ATLASES = ("tiles", "mixed", "cascade", "bc6h", "plain", "shared", "separate")
READERS = (
    Reader("lightmap", "a.wlm", stored(*_LIGHTMAPS), vary_artifact, _lightmap),
    Reader("probe", "a.wlm", stored("probe.wlm", "probe-pca.wlm"), vary_compact, _probe),
    Reader("atlas", "a.wlm", stored(*(f"atlas-{kind}.wlm" for kind in _ATLASES)), vary_artifact, _atlas),
    Reader("smoke-network", "a.wlm", _networks, _extreme, _network, _plume, cost=2),
    Reader("smoke-orders", "a.npz", _shipped_orders, vary_npz, _orders),
    _checkpoints(lightmap_fit, "lightmap", cost=8),
    _checkpoints(probe_fit, "probe", cost=4),
    Reader("smoke-checkpoint", "a.partial", _kept("simulation"), vary_artifact, _smoke_checkpoint, cost=2),
    Reader("smoke-network-checkpoint", "a.partial", _kept("training"), vary_artifact, _network_checkpoint, cost=8),
)
