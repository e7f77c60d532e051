"""Every kernel compiles for a GPU (sm_90), checked on machines without one.

The quick run compiles one variant of the kernels whose CUDA form the CPU never runs, such as native CUDA code. The long
run compiles every kernel and variant.
"""

import importlib
from collections.abc import Iterable
from pathlib import Path

import pytest
import warp as wp

import wlm_kernels
from wlm_kernels import mlp
from wlm_kernels.fluid import advection, advection_sources, lattice, lattice_fields, lattice_links
from wlm_kernels.lightmap import decode as lightmap_decode
from wlm_kernels.lightmap import matrix_decode
from wlm_kernels.lightmap import step as lightmap_step
from wlm_kernels.lightmap.frames import KERNELS as FRAMES
from wlm_kernels.probe import decode as probe_decode
from wlm_kernels.probe import gaussian_sum
from wlm_kernels.probe import network as probe_network
from wlm_kernels.probe import step as probe_step
from wlm_kernels.smoke import (
    depth_lattice,
    diffusion,
    march_six,
    marches,
    path,
)
from wlm_kernels.smoke import march as smoke_march

ARCHITECTURE = 90
KERNELS = Path(wlm_kernels.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(KERNELS).with_suffix("").parts)
    for path in KERNELS.rglob("*.py")
    if "\n@wp.kernel" in path.read_text(encoding="utf-8")
)
"""The modules with kernels of one form; factories make the others."""
QUICK_MODULES = ("fluid.advection_places", "probe.cubes", "raster.rasterize")
WIDTHS = (8, 17, 32, 64)


def _compile(module: object, folder: Path) -> None:
    made = wp.compile_aot_module(module, arch=[ARCHITECTURE], module_dir=folder)
    binaries = [path for path in made if path.suffix in (".ptx", ".cubin")]
    assert binaries and all(path.stat().st_size > 0 for path in binaries)


def _kernels_of(built: Iterable[object]) -> list[wp.Kernel]:
    """Selects the kernels of a factory's result; each is a module of its own."""
    found = [value for value in built if isinstance(value, wp.Kernel)]
    assert found, "the factory builds kernels"
    return found


def _compile_all(built: Iterable[object], folder: Path) -> None:
    for i, kernel in enumerate(_kernels_of(built)):
        _compile(kernel.module, folder / str(i))


def _slow_but(first: object, others: Iterable[object]) -> list:
    """One value for every run, and others for the long run."""
    return [first, *(pytest.param(value, marks=pytest.mark.slow) for value in others)]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK_MODULES else pytest.mark.slow) for name in MODULES]
)
def test_modules(name: str, tmp_path: Path):
    """Modules whose kernels have one form."""
    _compile(importlib.import_module(f"wlm_kernels.{name}"), tmp_path)


@pytest.mark.parametrize("outputs", _slow_but(3, [5]))
@pytest.mark.parametrize("gelu", _slow_but("fast", ["exact", "tanh"]))
@pytest.mark.parametrize("hidden", _slow_but(8, (16, *WIDTHS[1:])))
def test_mlp(hidden: int, gelu: str, outputs: int, tmp_path: Path):
    """The "fast" GELU uses an instruction of the GPU; networks of three and of other numbers of outputs."""
    _compile_all(vars(mlp.kernels(16, hidden, gelu, outputs)).values(), tmp_path)


@pytest.mark.parametrize("gelu", _slow_but("tanh", ["exact"]))
@pytest.mark.parametrize("hidden", _slow_but(16, WIDTHS))
@pytest.mark.parametrize("dynamic", _slow_but(True, [False]))
def test_step(dynamic: bool, hidden: int, gelu: str, tmp_path: Path):
    """The fused training step, whose CUDA form the CPU never runs."""
    _compile_all(vars(lightmap_step.step_kernels(dynamic, hidden, gelu, "cuda")).values(), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", _slow_but(8, (16, *WIDTHS[1:])))
@pytest.mark.parametrize("dynamic", _slow_but(True, [False]))
def test_exact_decode(dynamic: bool, hidden: int, tmp_path: Path):
    """Decoding a texel a thread."""
    _compile_all(lightmap_decode.exact_kernels(dynamic, hidden, "tanh"), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("hidden", [16, *WIDTHS])
def test_strip_decode(hidden: int, shared: bool, tmp_path: Path):
    """Decoding four texels a thread."""
    _compile_all(vars(lightmap_decode.strip_kernels(hidden, "fast", shared)).values(), tmp_path)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("hidden", _slow_but(64, [16, 32, 48]))
def test_matrix_decode(hidden: int, shared: bool, tmp_path: Path):
    """Decoding on matrix units, which a GPU alone has."""
    _compile_all(vars(matrix_decode.matrix_kernels(hidden, shared)).values(), tmp_path)


def test_frames(tmp_path: Path):
    """Decoding tiles that are stored as an image for each time."""
    _compile_all(FRAMES, tmp_path)


@pytest.mark.parametrize("latent", _slow_but(9, [1, 12, 32]))
def test_gaussians(latent: int, tmp_path: Path):
    """A training step's sum of Gaussians, and the update."""
    _compile_all(vars(probe_step.step_kernels(latent, "cuda")).values(), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("latent", [1, 9, 12, 32])
def test_gaussian_sum(latent: int, tmp_path: Path):
    """The sum of Gaussians at any point."""
    _compile_all(vars(gaussian_sum.sum_kernels(latent)).values(), tmp_path)


@pytest.mark.parametrize(
    ("latent", "hidden", "outputs"),
    [
        (9, 64, 27),
        *(pytest.param(*shape, marks=pytest.mark.slow) for shape in [(1, 8, 3), (12, 48, 12), (12, 128, 75)]),
    ],
)
def test_probe_network(latent: int, hidden: int, outputs: int, tmp_path: Path):
    """The network in training and in decode, whose CUDA forms the CPU never runs."""
    _compile_all(vars(probe_network.network_kernels(latent, hidden, outputs, "cuda")).values(), tmp_path / "network")
    _compile_all(vars(probe_decode.decode_kernels(latent, hidden, outputs, "cuda")).values(), tmp_path / "decode")


@pytest.mark.slow
@pytest.mark.parametrize("dtype", _slow_but(wp.float16, [wp.float32]))
def test_smoke(dtype: type, tmp_path: Path):
    """All kernels that take smoke, for densities of either type."""
    _compile_all([smoke_march.occupied_kernel(dtype)], tmp_path / "occupied")
    smoke = smoke_march.smoke_struct(dtype, True)
    variants = {"_guide": (True,), "_coarse": (dtype is wp.float16,), "_measure": (2,)}
    for module in (marches, march_six, depth_lattice, diffusion, path):
        launchers = {name: value.build for name, value in vars(module).items() if hasattr(value, "build")}
        assert launchers
        for name, build in launchers.items():
            for extra in [(False,), (True,)] if name == "_trace" else [variants.get(name, ())]:
                _compile_all([build(smoke, *extra)], tmp_path / f"{module.__name__}{name}{extra}")


LATTICE_STEPS = (
    {"lattice": "D3Q19", "solids": True, "walls": (True, True, True)},
    {"lattice": "D3Q19", "solids": True, "storage": "float16"},
    {"lattice": "D3Q19", "operator": "bgk", "force": "field"},
    {"lattice": "D3Q27", "solids": True, "force": "uniform"},
    {"lattice": "D3Q27", "storage": "float16", "eddies": False},
    {"lattice": "D2Q9"},
)


@pytest.mark.slow
@pytest.mark.parametrize("settings", _slow_but(LATTICE_STEPS[1], [LATTICE_STEPS[0], *LATTICE_STEPS[2:]]))
def test_lattice_step(settings: dict, tmp_path: Path):
    """Streaming and collision, by everything that changes the code."""
    _compile_all([lattice.step_kernel(lattice.Spec(**settings))], tmp_path)


@pytest.mark.parametrize("balance", _slow_but(True, [False]))
@pytest.mark.parametrize(
    ("name", "storage"),
    [
        ("D3Q19", "float32"),
        *(pytest.param(*pair, marks=pytest.mark.slow) for pair in [("D2Q9", "float32"), ("D3Q27", "float16")]),
    ],
)
def test_lattice_boundaries(name: str, storage: str, balance: bool, tmp_path: Path):
    """Links, whose sums over a block only a GPU has, and what else is of one lattice and storage."""
    _compile_all(vars(lattice_links.link_kernels(name, storage, balance)).values(), tmp_path / "links")
    _compile_all(vars(lattice_fields.fluid_kernels(name, storage, (False, True, True))).values(), tmp_path / "fluid")


@pytest.mark.parametrize("stored", _slow_but(wp.float16, [wp.float32]))
@pytest.mark.parametrize("solids", _slow_but(True, [False]))
@pytest.mark.parametrize("bricks", _slow_but(True, [False]))
def test_advection(bricks: bool, solids: bool, stored: type, tmp_path: Path):
    """Both schemes; and sources, solids and buoyancy, which are the same with bricks and without."""
    carry = [advection.carry_kernel(correcting, stored, bricks, solids, not solids) for correcting in (False, True)]
    _compile_all(carry, tmp_path / "carry")
    _compile_all(vars(advection_sources.source_kernels(stored)).values(), tmp_path / "sources")
