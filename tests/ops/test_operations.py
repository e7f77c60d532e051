"""Operations against their float64 twins and closed forms, and what all of them refuse."""

import inspect
import math
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from builders.operation_cases import CASES, FIRST, Case, normal
from kernels.compare import close

from benchmarks import plain
from wlm import ops

# Values and gradients: of the largest number of a tensor.
EXACT = {"value": 1e-5, "gradient": 1e-4}


# The GPU's tanh instruction is within 2^-11 relative; x (1 - tanh) and x (1 - tanh^2) carry that to the gradients.
FAST = {"value": 2e-3, "gradient": 5e-3}


def _tolerances(name: str, device: str) -> dict[str, float]:
    return FAST if name == "mlp-fast" and device != "cpu" else EXACT


def _results(case: Case, module: Any, tensors: dict[str, torch.Tensor]) -> tuple[list, dict]:
    """The values and, for random adjoints of them, the gradients by leaf."""
    values = case.call(module, tensors)
    adjoints = [torch.from_numpy(normal(*value.shape, seed=20 + i)).to(value) for i, value in enumerate(values)]
    pairs = [pair for pair in zip(values, adjoints, strict=True) if pair[0].requires_grad]
    torch.autograd.backward(*zip(*pairs, strict=True))
    return [value.detach() for value in values], {name: tensors[name].grad for name in case.leaves}


@pytest.mark.parametrize("name", CASES)
def test_against_float64(device: str, name: str):
    """Values and every gradient, against autograd through the twin in float64."""
    case = CASES[name]
    values, grads = _results(case, ops, case.tensors(device))
    values64, grads64 = _results(case, plain, case.tensors("cpu", torch.float64))
    tolerances = _tolerances(name, device)
    for i, (value, value64) in enumerate(zip(values, values64, strict=True)):
        close(value, value64, tolerances["value"], f"result {i}")
    for leaf, grad64 in grads64.items():
        close(grads[leaf], grad64, tolerances["gradient"], f"gradient of {leaf}")
    # A gradient that is 0 everywhere would hold anything: it is only where one cell or no smoke leaves nothing to move.
    assert all(grad.any() for grad in grads64.values()) or name in ("plane-one-cell", "march-no-smoke")


@pytest.mark.parametrize("name", [*FIRST.values(), "plane-periodic-layers"])
def test_any_strides(name: str):
    """Tensors that aren't contiguous give the same bits, and gradients of any strides are taken."""
    case = CASES[name]
    values, grads = _results(case, ops, case.tensors("cpu"))
    tensors = case.tensors("cpu")
    spread = {leaf: torch.stack([t.detach(), t.detach()], -1)[..., 0] for leaf, t in tensors.items()}
    assert all(t.numel() == 1 or not t.is_contiguous() for t in spread.values())
    spread = {leaf: t.requires_grad_(leaf in case.leaves) for leaf, t in spread.items()}
    results = case.call(ops, spread)
    adjoints = [torch.from_numpy(normal(*value.shape, seed=20 + i)) for i, value in enumerate(results)]
    torch.autograd.backward(results, [torch.stack([a, a], -1)[..., 0] for a in adjoints])
    for value, other in zip(values, results, strict=True):
        assert torch.equal(value, other)
    for leaf, grad in grads.items():
        assert torch.equal(grad, spread[leaf].grad), leaf


# Which arguments are cut to nothing together.
EMPTY = {
    "bc7_map": (["uv"],),
    "plane": (["points"],),
    "volume-periodic-layers": (["points", "layer"],),
    "triplane": (["points"],),
    "mlp-fast": (["x"],),
    "mlp-8": (["x", "hidden", "output"],),
    "gaussian_sum": (["points"], ["rows"]),
    "march": (["origin", "direction"], ["toward", "colour"]),
}


@pytest.mark.parametrize("name", EMPTY)
def test_nothing_in(device: str, name: str):
    """No points, no networks, no Gaussians, no rays: results of the twin's shape, and gradients of 0."""
    case = CASES[name]
    for cut in EMPTY[name]:
        tensors, tensors64 = case.tensors(device), case.tensors("cpu", torch.float64)
        for set_ in (tensors, tensors64):
            for leaf in cut:
                set_[leaf] = set_[leaf].detach()[:0].requires_grad_(leaf in case.leaves)
        values, want = case.call(ops, tensors), case.call(plain, tensors64)
        assert [v.shape for v in values] == [v.shape for v in want]
        for value, value64 in zip(values, want, strict=True):
            close(value, value64, EXACT["value"])
        sum(v.sum() for v in values).backward()
        if cut not in (["rows"], ["toward", "colour"]):
            assert not any(tensors[leaf].grad.any() for leaf in case.leaves)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")], ids=str)
@pytest.mark.parametrize("name", FIRST.values())
def test_not_a_number(device: str, name: str, bad: float):
    """One such number in any tensor is an error of one line that names the tensor."""
    case = CASES[name]
    for leaf in (*case.leaves, *case.constants):
        tensors = {key: value.detach() for key, value in case.tensors(device).items()}
        if not tensors[leaf].is_floating_point():
            continue
        tensors[leaf].view(-1)[-1] = bad
        with pytest.raises(ValueError, match=rf"^(length of )?{leaf}: expected finite numbers, found ") as error:
            case.call(ops, tensors)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", FIRST.values())
def test_wrong_tensors(device: str, name: str):
    """A wrong type, number of axes or device of any tensor is an error that names it."""
    case = CASES[name]
    for leaf in (*case.leaves, *case.constants):
        if leaf == "layer":
            continue
        for change, message in (
            (lambda t: t.double(), f"{leaf}: expected float32 .*float64"),
            (lambda t: t.flatten()[:1], f"{leaf}: expected float32 "),
            (lambda t: t.to("meta"), "expected a tensor on .* meta"),
        ):
            tensors = {key: value.detach() for key, value in case.tensors(device).items()}
            tensors[leaf] = change(tensors[leaf])
            with pytest.raises(ValueError, match=message) as error:
                case.call(ops, tensors)
            assert "\n" not in str(error.value)


REFUSED = [
    ("bc7_map", {"weights": torch.zeros(8, 10)}, "weights: expected sizes in whole blocks of 4 x 4, got (8, 10)"),
    ("bc7_map", {"endpoints": torch.zeros(2, 2, 2, 4)}, "endpoints: expected float32 [2, 3, 2, 4], got"),
    ("bc7_map", {"weights": torch.zeros(1, 8, 12)}, "weights: expected float32 [any, any], got"),
    ("bc7_map", {"uv": torch.zeros(5, 3)}, "uv: expected"),
    ("bc7_map-layers", {"layer": torch.full((50,), 3)}, "layer: expected numbers from 0 to 2, found 3"),
    ("bc7_map-layers", {"layer": torch.zeros(50)}, "layer: expected int32 or int64 [50], got torch.float32"),
    ("plane", {"values": torch.zeros(0, 7, 3)}, "values: expected at least one cell and one channel, got (0, 7, 3)"),
    ("plane-periodic-layers", {"layer": torch.full((60,), -1)}, "layer: expected numbers from 0 to 2, found -1"),
    ("plane-periodic-layers", {"layer": torch.zeros(59).int()}, "layer: expected int32 or int64 [60], got"),
    ("volume", {"points": torch.zeros(5, 2)}, "points: expected float32 [..., 3], got torch.float32 (5, 2)"),
    ("triplane", {"yz": torch.zeros(6, 4, 2)}, "yz: expected float32 [any, any, 3], got"),
    ("triplane", {"reduce": "mean"}, "reduce: expected one of sum, product, concatenate, got 'mean'"),
    ("mlp-8", {"gelu": "relu"}, "gelu: expected one of exact, tanh, fast, got 'relu'"),
    ("mlp-8", {"hidden": torch.zeros(3, 27, 8)}, "hidden: expected float32 [3, 26, 8], got"),
    ("mlp-8", {"output": torch.zeros(2, 9, 3)}, "output: expected float32 [3, 9, 3], got"),
    ("mlp-8", {"hidden": torch.zeros(3, 83, 65), "output": torch.zeros(3, 66, 3)}, "hidden: expected 1 to 64 units"),
    ("gaussian_sum", {"rows": torch.zeros(3, 10)}, "rows: expected 10 columns and at least one of a latent, got 10"),
    ("gaussian_sum", {"cut": 0.0}, "cut: expected a number above 0, got 0.0"),
    ("gaussian_sum", {"support": "cube"}, "support: expected one of ellipsoid, sphere, got 'cube'"),
    ("march", {"density": -torch.ones(6, 7, 8)}, "density: expected numbers from 0 to inf, found -1"),
    ("march", {"density": torch.zeros(6, 0, 8)}, "density: expected at least one voxel, got (6, 0, 8)"),
    ("march", {"direction": torch.ones(40, 3)}, "length of direction: expected numbers from 0.999 to 1.001"),
    ("march", {"direction": torch.ones(39, 3)}, "direction: expected float32 [40, 3], got"),
    ("march", {"toward": torch.zeros(2, 3)}, "length of toward: expected numbers from 0.999 to 1.001, found 0"),
    ("march", {"toward": None}, "toward, colour: expected both arguments or neither"),
    ("march", {"toward": torch.zeros(2, 3).requires_grad_()}, "toward: expected an argument that requires no gradient"),
    ("march", {"emission": torch.zeros(6, 7, 8)}, "emission: expected float32 [6, 7, 8, 3], got"),
    ("march", {"step": 0.0}, "step: expected a number above 0, got 0.0"),
    ("march", {"density": torch.zeros(6, 7, 8).half()}, "density: expected float32 [any, any, any], got torch.float16"),
    ("plane", {"points": torch.zeros(5, 2).bfloat16()}, "points: expected float32 [..., 2], got torch.bfloat16 (5, 2)"),
    ("march", {"g": 1.0}, "g: expected a number between -1 and 1, got 1.0"),
    ("plane", {"points": np.zeros((5, 2))}, "points: expected a torch tensor, float32 [..., 2], got numpy.ndarray"),
    ("bc7_map-layers", {"layer": np.zeros(50, int)}, "layer: expected a torch tensor, int32 or int64 [50], got numpy."),
    ("mlp-8", {"hidden": [[1.0]]}, "hidden: expected a torch tensor, float32 [...], got list"),
    ("bc7_map", {"weights": [0.5]}, "weights: expected a torch tensor, float32 [any, any], got list"),
    ("march", {"origin": [0, 0, 0]}, "origin: expected a torch tensor, float32 [..., 3], got list"),
    ("gaussian_sum", {"rows": torch.rand(3, 12).to_sparse()}, "rows: expected a dense tensor, got torch.sparse_coo"),
]


@pytest.mark.parametrize(("name", "changes", "message"), REFUSED, ids=[f"{r[0]}-{next(iter(r[1]))}" for r in REFUSED])
def test_refused(name: str, changes: dict, message: str):
    case = CASES[name]
    with pytest.raises(ValueError) as error:
        getattr(ops, case.op)(**{**case.tensors("cpu"), **case.options, **changes})
    assert str(error.value).startswith(message)


@pytest.mark.parametrize("transform", ["grad", "batched"])
def test_function_transforms_are_refused(transform: str):
    """torch.func, vectorised Jacobians and batched gradients end in one line."""
    values, points = torch.rand(4, 4, 1), torch.rand(5, 2)

    def read(points: torch.Tensor) -> torch.Tensor:
        return ops.plane(values, points)

    def batched() -> tuple[torch.Tensor, ...]:
        points.requires_grad_()
        return torch.autograd.grad(read(points), points, torch.ones(3, 5, 1), is_grads_batched=True)

    calls = {"grad": lambda: torch.func.grad(lambda each: read(each).sum())(points), "batched": batched}
    with pytest.raises(
        ValueError, match=r"^torch\.func: wlm.ops supports no grad|vmap and batched gradients do not"
    ) as error:
        calls[transform]()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", FIRST.values())
def test_autocast_changes_nothing(device: str, name: str):
    """Under autocast an operation still computes in single floats, also backwards but for the colours of `march`."""
    case = CASES[name]
    values, grads = _results(case, ops, case.tensors(device))
    with torch.autocast(torch.device(device).type, torch.bfloat16):
        others, other_grads = _results(case, ops, case.tensors(device))
    assert all(map(torch.equal, values, others))
    # On a GPU the terms of a sum have no fixed order.
    assert device != "cpu" or name.startswith("march") or all(map(torch.equal, grads.values(), other_grads.values()))


def test_rays_of_a_camera(device: str):
    """Where a ray ends, and a slope along it, by differences: a smooth cloud, and steps that stay as many."""
    density = torch.tensor(_cloud(), device=device)
    turn = torch.tensor([0.31, -0.17, 1.0], device=device, dtype=torch.float64)
    place = torch.tensor([6.3, 5.2, -4.0], device=device, dtype=torch.float64)

    def light(place: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        direction = torch.nn.functional.normalize(turn, dim=0).float()
        lights = {"toward": AHEAD[None].to(device), "colour": torch.ones(1, 3, device=device)}
        radiance, through = ops.march(density, place.float()[None], direction[None], step=0.1, g=0.5, **lights)
        return radiance.sum() + through.sum()

    for at, step in enumerate((0.02, 0.004)):
        leaves = [place.clone().requires_grad_(), turn.clone().requires_grad_()]
        (grad,) = torch.autograd.grad(light(*leaves), leaves[at])
        for axis in range(3):
            found = []
            for sign in (1.0, -1.0):
                moved = [place.clone(), turn.clone()]
                moved[at][axis] += sign * step
                found.append(float(light(*moved)))
            assert abs((found[0] - found[1]) / (2.0 * step) - float(grad[axis])) <= 0.02 * float(grad.abs().max())


@pytest.mark.parametrize("name", [n for n in ops.__all__ if n not in ("plain", "funcs", "Raster", "bc7_blocks")])
def test_twins_take_the_same_arguments(name: str):
    """A reader can put one in the place of the other; culling and what else is drawn are the kernels' alone."""
    own = inspect.signature(getattr(ops, name)).parameters
    twin = inspect.signature(getattr(plain, name)).parameters
    extra = {"cull", "derivative", "coverage"} if name.startswith("rasterize") else set()
    assert [p for p in own if p not in extra] == [*twin]
    assert all(own[p].default == twin[p].default for p in twin)


def test_names_load_when_they_are_used():
    """The package itself imports neither torch nor Warp, lists its names, and says which it lacks."""
    code = "import sys; from wlm import ops; assert not {'torch', 'warp'} & {*sys.modules}; print(*dir(ops))"
    listed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {*ops.__all__} <= {*listed}
    for name in ops.__all__:
        assert getattr(ops, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'perlin'"):
        _ = ops.perlin


AHEAD = torch.tensor([0.0, 0.0, 1.0])


def _middle_rays(device: str, count: int = 3) -> dict[str, torch.Tensor]:
    """Along the third axis, through the middle of a grid of 8 x 8."""
    origin = torch.tensor([4.0, 4.0, -5.0], device=device).repeat(count, 1)
    return {"origin": origin, "direction": AHEAD.to(device).repeat(count, 1)}


@pytest.mark.parametrize("step", [1.0, 0.3, 4.0])
def test_uniform_smoke(device: str, step: float):
    """Beer and Lambert's law; and back-scattered light, of which (1 - exp(-2 tau)) / 2 comes back."""
    density = torch.full((8, 8, 16), 0.1, device=device)
    toward, colour = -AHEAD[None].to(device), torch.tensor([[1.0, 0.5, 0.0]], device=device)
    radiance, transmittance = ops.march(density, **_middle_rays(device), toward=toward, colour=colour, step=step)
    # Steps of a voxel's length meet its density's corners, others cut them.
    close(transmittance, torch.full((3,), math.exp(-1.6)), {0.3: 2e-3, 1.0: 1e-6, 4.0: 0.1}[step])
    reflected = 0.5 * (1.0 - math.exp(-3.2))
    close(radiance, torch.tensor([[reflected, 0.5 * reflected, 0.0]] * 3), {0.3: 2e-3, 1.0: 5e-3, 4.0: 0.06}[step])


@pytest.mark.parametrize("g", [0.0, 0.7, -0.4])
def test_phase_function(device: str, g: float):
    """Light from behind, from the side and from the front, in smoke so thin that all of it gets through."""
    density = torch.full((8, 8, 8), 1e-5, device=device)
    toward = torch.stack([AHEAD, AHEAD.roll(1), -AHEAD]).to(device)
    lit = ({"toward": t[None], "colour": torch.ones(1, 3, device=device)} for t in toward)
    light = torch.cat([ops.march(density, **_middle_rays(device, 1), **each, g=g)[0][:, 0] for each in lit])
    cosine = torch.tensor([1.0, 0.0, -1.0], dtype=torch.float64)
    want = 8e-5 * (1.0 - g * g) / (1.0 + g * g - 2.0 * g * cosine) ** 1.5
    close(light, want, 1e-3)


def _cloud(seed: int = 3) -> np.ndarray:
    """A smooth density."""
    random = np.random.default_rng(seed)
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, n) for n in (14, 12, 16)], indexing="ij"), -1)
    blobs = [np.exp(-6.0 * ((x - c) ** 2).sum(-1)) for c in random.uniform(-0.5, 0.5, (4, 3))]
    return (0.25 * sum(blobs)).astype(np.float32)


def test_rays_that_miss(device: str):
    """Past the grid, and away from it: nothing is seen, and nothing has a gradient."""
    density = torch.ones(8, 8, 8, device=device, requires_grad=True)
    origin = torch.tensor([[20.0, 4.0, -5.0], [4.0, 4.0, -5.0]], device=device)
    direction = torch.stack([AHEAD, -AHEAD]).to(device)
    light = {"toward": AHEAD[None].to(device), "colour": torch.ones(1, 3, device=device)}
    radiance, transmittance = ops.march(density, origin, direction, **light)
    (radiance.sum() + transmittance.sum()).backward()
    assert not radiance.any() and (transmittance == 1.0).all() and not density.grad.any()


def test_behind_a_wall(device: str):
    """Where nothing gets through the gradient is 0 and not NaN, however opaque, and in front of it right."""
    density = torch.full((8, 8, 16), 0.05, device=device)
    density[:, :, 8:] = 1e6
    density.requires_grad_()
    emission = torch.full((8, 8, 16, 3), 0.1, device=device, requires_grad=True)
    radiance, transmittance = ops.march(density, **_middle_rays(device, 1), emission=emission)
    assert transmittance == 0.0
    radiance.sum().backward()
    assert density.grad.isfinite().all() and emission.grad.isfinite().all()
    assert not density.grad[:, :, 9:].any() and not emission.grad[:, :, 9:].any()
    # The ray runs between four rows of voxels, and each has a quarter of what it passes.
    passed = torch.exp(torch.tensor([-0.025 - 0.05 * k for k in range(6)]))
    close(emission.grad[3, 3, :6, 0], 0.25 * passed, 0.01)


ROOT = Path(__file__).resolve().parents[2]
PAGE = "".join(page.read_text(encoding="utf-8") for page in sorted((ROOT / "docs").glob("ops*.md")))
BLOCKS = {
    f"{section}-{i}": block
    for section, text in re.findall(r"^## ([\w]+)[^\n]*\n((?:(?!^## ).)*)", PAGE, re.S | re.M)
    for i, block in enumerate(re.findall(r"```python\n(.*?)```", text, re.S))
}


@pytest.mark.parametrize("section", BLOCKS)
def test_block(section: str, tmp_path: Path):
    torch.manual_seed(0)
    # Warp reads a kernel's lines from its file.
    path = tmp_path / "block.py"
    path.write_text(BLOCKS[section], encoding="utf-8")
    runpy.run_path(str(path), run_name=f"block_{section.replace('-', '_')}")


def test_page():
    kernels = ["Tapes-0", *(f"funcs-{i}" for i in range(4))]
    torch_alone = [f"{name}-0" for name in "bc7_map plane mlp gaussian_sum rasterize antialias march Air".split()]
    assert {*BLOCKS} == {*kernels, *torch_alone}
    for target in re.findall(r"\]\(([^)#\s]+)\)", PAGE):
        assert (ROOT / "docs" / target).exists(), target
