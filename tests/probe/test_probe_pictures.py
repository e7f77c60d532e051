"""Fits that minimise the error of pictures: the pixels, the gradient, and what the fit gains."""

import numpy as np
import pytest
import torch
import warp as wp
from builders.checks import error_of
from builders.probe_sets import ROOM, synthetic
from kernels.compare import close
from reference import probe_network

from wlm.errors import WlmError
from wlm.formats.geometry import Geometry
from wlm.probe.data import from_arrays
from wlm.probe.fit import compress, open_checkpoint
from wlm.probe.gaussian.pictures import Pixels, seen_pixels
from wlm.probe.gaussian.trainer import Trainer
from wlm.probe.model import Profile, box_of
from wlm.probe.places import ball_exposure
from wlm.probe.sphere import irradiance_weights
from wlm.texels import filmic, to_srgb

SMALL = Profile(name="small", method="gaussians", ratio=0.1, latent=3, hidden=16, steps=60)


def _room() -> Geometry:
    """The floor and a wall of the builders' room."""
    x, y, z = ROOM
    corners = [[0, 0, 0], [x, 0, 0], [x, 0, z], [0, 0, z], [0, y, 0], [x, y, 0]]
    return Geometry(np.array(corners, np.float32), np.array([[0, 1, 2], [0, 2, 3], [0, 4, 1], [1, 4, 5]], np.uint32))


def _day(count: int, hours: int):
    probes = synthetic(count)
    light = [probes.values.reshape(count, 9, 3) * np.float32(0.2 + hour) for hour in range(hours)]
    return from_arrays(probes.position, np.stack(light), times=np.arange(hours) + 6.0) if hours > 1 else probes


def _reflected(pixels: Pixels, light: np.ndarray) -> np.ndarray:
    return np.einsum("pc,pcd->pd", pixels.factors, (pixels.weights @ light.astype(np.float64)).reshape(-1, 9, 3))


def test_the_slopes_are_those_of_the_displayed_picture():
    probes = synthetic(150, dead=10)
    pixels = seen_pixels(probes, _room())
    values = probes.values[probes.live].astype(np.float64)
    exposure = ball_exposure(values.reshape(-1, 9, 3))

    def displayed(light: np.ndarray) -> np.ndarray:
        return to_srgb(filmic(np.maximum(_reflected(pixels, light) * exposure, 0.0)))

    off = values * 1e-3 * np.random.default_rng(0).normal(size=values.shape)
    change = displayed(values + off) - displayed(values)
    assert np.abs(_reflected(pixels, off) * pixels.slopes - change).mean() < 0.02 * np.abs(change).mean()
    # Balls are seen from all sides, the mesh from where viewers are: the floor and the wall face the room.
    many = 8 * len(values)
    assert many < len(pixels.factors) <= 2 * many + 64
    up = irradiance_weights(np.array([[0.0, 1.0, 0.0]]), 9)[0] / np.pi
    assert (np.abs(pixels.factors[many:] - up).max(1) < 1e-9).mean() > 0.3
    assert np.abs(pixels.factors[:many].mean(0)[1:]).max() < 0.1
    np.testing.assert_allclose(pixels.weights.sum(1), 1.0)
    # A part of the probes keeps the pixels that it lights alone.
    chosen = np.argsort(-probes.position[probes.live, 0])[:90]
    part = pixels.of(chosen)
    assert 8 * 90 < len(part.factors) < len(pixels.factors)
    np.testing.assert_allclose(part.weights.sum(1), 1.0)
    first = (pixels.weights[:, chosen].sum(1) == 1.0).argmax()
    np.testing.assert_array_equal(_reflected(part, values[chosen])[0], _reflected(pixels, values)[first])


@pytest.mark.parametrize("hours", [1, 2])
@pytest.mark.parametrize("error", ["relative", "absolute"])
def test_the_gradient_is_that_of_both_errors(error: str, hours: int, device: str):
    """Against float64, with automatic differentiation through the network, the exponential and the pictures."""
    probes, profile = _day(70, hours), SMALL.override({"error": error})
    box = box_of(probes.position)
    x = ((probes.position - box["origin"]) / box["extent"]).astype(np.float32)
    pixels = seen_pixels(probes, _room())
    trainer = Trainer(x, probes.values, profile, 0, device, hours, pixels)
    try:
        trainer.run(40)
        trainer._make_shapes(quantised=False)
        trainer._features()
        trainer._network_and_pictures()
        t = {name: tensor.double().cpu() for name, tensor in trainer._tensors.items()}
        order = [int(np.abs(x - at).sum(1).argmin()) for at in wp.to_torch(trainer._groups.x).cpu().numpy()[:70]]
        target, weight = (torch.from_numpy(a.numpy()).double() for a in (trainer._target, trainer._weight))
    finally:
        trainer.close()
    net, f = t["net"].requires_grad_(), t["f"].sum(0)[:, :70].requires_grad_()
    own = probe_network.loss(net, f, torch.from_numpy(x[order]).double(), target[:, :70], weight, 16)
    first, second, third = probe_network.layers(net, 6, 16, len(target))
    h = torch.cat([f.T, torch.from_numpy(x[order]).double()], 1)
    for layer in (first, second):
        h = torch.sigmoid(h @ layer[:-1] + layer[-1])
    outputs = (h @ third[:-1] + third[-1])[:, : len(target)]
    numbers = torch.from_numpy(trainer.mean) + torch.from_numpy(trainer.spread) * outputs
    values = torch.from_numpy(probes.values[order]).double()
    scale = torch.ones(70, hours, dtype=torch.float64)
    if error == "relative":
        split = numbers.view(70, hours, -1)
        numbers = (trainer._gain * split[..., :-1] * split[..., -1:].exp()).reshape(70, -1)
        norms = values.view(70, hours, -1).norm(dim=2)
        scale = (norms.square() + (1e-4 * norms.log().mean(0).exp()).square()).sqrt()
    arrays = (pixels.weights.toarray()[:, order], pixels.factors, pixels.slopes**2)
    dense, factors, value = map(torch.from_numpy, arrays)
    # Both errors weigh the same: the trace of the pictures' form in the network's numbers is that of the probes'.
    trace = torch.einsum("ptj,pv,vt,pc->", value.view(len(value), hours, 3), dense**2, scale**2, factors**2)
    seen = torch.einsum("pv,pc,vtcj->ptj", dense, factors, (numbers - values).view(70, hours, 9, 3))
    pictures = (value * seen.reshape(value.shape).square()).sum() / (trace * trainer._unit)
    grad_f, grad_net = torch.autograd.grad(0.5 * (own + pictures), (f, net))
    close(trainer._tensors["grad_f"][:, :70], grad_f, 2e-5)
    close(trainer._tensors["partial"].sum(0), grad_net, 2e-5)
    assert 0.01 < float((pictures / own).detach()) < 100.0


@pytest.mark.parametrize("error", ["relative", "absolute"])
def test_pictures_are_better_for_it(error: str):
    """In pixels that the fit has not seen, and with the packed file's numbers."""
    probes = synthetic(300)
    others, errors = seen_pixels(probes, _room(), seed=1), []
    for geometry in (None, _room()):
        model = compress(probes, SMALL, steps=300, error=error, geometry=geometry)
        off = model.decoder(position=probes.position).decode_probes().astype(np.float64) - probes.values
        errors.append(np.square(_reflected(others, off) * others.slopes).mean())
    assert errors[1] < 0.8 * errors[0]


def test_a_fit_to_pictures_is_resumed_exactly(tmp_path):
    """In two regions, of which the first is finished."""
    probes, out, profile = synthetic(160), tmp_path / "a.wlm", SMALL.override({"region": 80})
    given = {"geometry": _room()}
    whole = compress(probes, profile, **given)
    assert whole.content.facts()["regions"] == 2

    def stop(progress):
        if progress.done >= 105:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        checkpoint = open_checkpoint(out, probes, profile, every=0, **given)
        compress(probes, profile, progress=stop, checkpoint=checkpoint, **given)
    assert "mesh" in error_of(open_checkpoint, out, probes, profile, resume=True)
    resumed = open_checkpoint(out, probes, profile, resume=True, **given)
    assert resumed.resumed
    compress(probes, profile, checkpoint=resumed, **given).save(tmp_path / "b.wlm")
    whole.save(out)
    assert out.read_bytes() == (tmp_path / "b.wlm").read_bytes()


def test_what_has_no_pictures_is_refused():
    probes, far = synthetic(30), _room()
    assert "mesh: expected the method gaussians" in error_of(compress, probes, SMALL, method="auto", geometry=_room())
    odd = from_arrays(probes.position, probes.values[:, :7])
    assert "mesh: expected spherical harmonics, found 7 numbers" in error_of(compress, odd, SMALL, geometry=_room())
    for position in (np.full_like(far.position, np.nan), far.position[:0], far.position * 1e-6 + 900.0):
        triangle = far.triangle if len(position) else far.triangle[:0]
        with pytest.raises(WlmError, match="mesh: expected a mesh around the probes, but none of 64 views shows it"):
            compress(probes, SMALL, geometry=Geometry(position, triangle))


@pytest.mark.parametrize("kind", ["one probe", "coincident", "huge"])
def test_hard_sets(kind: str):
    probes = synthetic(40)
    position, values = probes.position, probes.values
    if kind == "one probe":
        position, values = position[:1], values[:1]
    elif kind == "coincident":
        position = np.repeat(position[:1], 40, 0)
    else:
        values = values * np.float32(1e16)
    probes = from_arrays(position, values)
    model = compress(probes, SMALL, ratio=0.5, geometry=_room())
    decoded = model.decoder(position=probes.position).decode_probes()
    assert np.isfinite(decoded).all()
    spread = np.sqrt(np.mean((values - values.mean(0)) ** 2)) + 1e-2 * np.abs(values).max()
    assert np.sqrt(np.mean((decoded - values) ** 2)) < 1.5 * spread
