"""Every kernel compiles for a GPU (sm_90), checked on machines without one.

The quick run compiles one case of each package whose kernels have native CUDA code, which the CPU never runs, as far
as PTX. The long run compiles every kernel and variant, to machine code too.
"""

import importlib
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import warp as wp

import wlm_kernels
from benchmarks import matrix_tiles, smoke_path
from wlm_kernels import mlp
from wlm_kernels.fluid import advection, advection_sources, fire, lattice, lattice_bodies, lattice_fields, lattice_links
from wlm_kernels.lightmap import decode as lightmap_decode
from wlm_kernels.lightmap import gather, matrix_pages, pages
from wlm_kernels.lightmap import step as lightmap_step
from wlm_kernels.probe import decode as probe_decode
from wlm_kernels.probe import gaussian_sum
from wlm_kernels.probe import network as probe_network
from wlm_kernels.probe import step as probe_step
from wlm_kernels.smoke import depth_lattice, diffusion, march_six, marches, naf_block, planes, single_scatter
from wlm_kernels.smoke import march as smoke_march

KERNELS = Path(wlm_kernels.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(KERNELS).with_suffix("").parts)
    for path in KERNELS.rglob("*.py")
    if "\n@wp.kernel" in path.read_text(encoding="utf-8")
)
"""The modules with kernels of one form; factories make the others."""
FORMS = {
    "probe.components": ("_decode_components", "basis", [wp.array2d[wp.int8], wp.array2d[wp.float16]]),
    "probe.hours": ("_mix_hours", "mixed", [wp.array1d[wp.float16], wp.array1d[wp.float32]]),
}
"""The types of an argument of kernels that are only compiled for the types of a launch, by module."""
QUICK_MODULES = ("fluid.advection_places",)
WIDTHS = (8, 16, 17, 32, 64)
BOTH = (True, False)
FLOATS = (wp.float16, wp.float32)
LATENTS = (1, 9, 12, 32)
LATTICE_STEPS = (
    {"lattice": "D3Q19", "solids": True, "walls": (True, True, True)},
    {"lattice": "D3Q19", "solids": True, "storage": "float16", "group": 2},
    {"lattice": "D3Q19", "forced": True},
    {"lattice": "D3Q27", "solids": True, "forced": True},
    {"lattice": "D3Q27", "storage": "float16", "eddies": False},
    {"lattice": "D3Q19", "solids": True, "storage": "float16", "in_place": True, "group": 2},
    {"lattice": "D2Q9"},
)


@pytest.fixture
def ptx(pytestconfig) -> bool:
    """Whether to stop at PTX, as the quick run does; only the long run leaves no test out."""
    return pytestconfig.getoption("markexpr") != ""


def _compile(module: object, folder: Path, ptx: bool) -> None:
    made = wp.compile_aot_module(module, arch=[90], module_dir=folder, use_ptx=ptx)
    binaries = [path for path in made if path.suffix in (".ptx", ".cubin")]
    assert binaries and all(path.stat().st_size > 0 for path in binaries)


def _members(*built: object) -> list:
    """Joins the members of several factories' results."""
    return [member for each in built for member in (each if isinstance(each, list | tuple) else vars(each).values())]


def _probe_network(shape: tuple[int, int, int]) -> list:
    latent, hidden, outputs = shape
    decoder = probe_decode.decode_kernels(latent, hidden, outputs, True, 3, "cuda")
    network = probe_network.network_kernels(latent, hidden, outputs + 1, "cuda")
    return _members(network, decoder, *decoder._kernels.values())


def _smoke(dtype: type) -> list:
    """Builds all kernels that take smoke, for densities of one type."""
    smoke = smoke_march.smoke_struct(dtype, True)
    variants = {"_guide": (True,), "_coarse": (dtype is wp.float16,), "_measure": (2,), "_mark": (32,), "_mean": (4, 8)}
    built = [smoke_path._coarser, *(depth_lattice._add_up(solid, 4) for solid in BOTH)]
    for module in (smoke_march, marches, march_six, depth_lattice, diffusion, smoke_path):
        # Functions of Warp have a `build`, too.
        built_by = {name: value for name, value in vars(module).items() if not isinstance(value, wp.Function)}
        launchers = {name: value.build for name, value in built_by.items() if hasattr(value, "build")}
        assert launchers
        for name, build in launchers.items():
            for extra in [(False,), (True,)] if name == "_trace" else [variants.get(name, ())]:
                built.append(build(smoke, *extra))
    return built


def _boundaries(kind: tuple[str, str], balance: bool) -> list:
    """Builds the links, whose sums over a block only a GPU has, and what else is of one lattice and storage."""
    fluid = lattice_fields.fluid_kernels(*kind, (False, True, True), balance)
    return _members(lattice_links.link_kernels(*kind, balance, False, balance), fluid)


def _advection(bricks: bool, solids: bool, stored: type) -> list:
    carry = [advection.carry_kernel(correcting, stored, bricks, solids, not solids) for correcting in BOTH]
    return _members(carry, [advection.mark_kernel(stored)], list(advection_sources.source_kernels(stored).values()))


def _planes(half: bool) -> list:
    return _members(planes.kernels(5, 8, half, True), [planes._encode_six, planes._decode])


def _cases(name: str, build: Callable, quick: list[tuple], *axes: tuple) -> Iterator:
    """Gives one case for each combination of arguments; the combinations in `quick` are in every run."""
    for i, values in enumerate(itertools.product(*axes)):
        yield pytest.param(build, values, id=f"{name}-{i}", marks=() if values in quick else pytest.mark.slow)


FACTORIES = [
    *_cases("mlp", lambda *of: mlp.kernels(16, *of), [], WIDTHS, ("fast", "exact", "tanh"), (3, 5)),
    *_cases("step", lambda *of: lightmap_step.step_kernels(*of, "cuda"), [], (16, 64), ("tanh", "exact")),
    *_cases("muon", lambda width: [gather._turn_kernel(width, width * width // 8)], [(64,)], (16, 32, 48, 64)),
    *_cases("exact_decode", lambda width: [lightmap_decode.exact_kernel(width, "tanh")], [], WIDTHS),
    *_cases("matrix_tiles", matrix_tiles.matrix_kernels, [], (16, 48, 64), (4, 32, 128)),
    *_cases("pages", lambda *of: [pages.page_kernel(*of)], [], (8, 16, 64), ("fast", "exact")),
    *_cases("matrix_pages", lambda width: [matrix_pages.page_kernel(width)], [(16,)], (16, 48, 64)),
    *_cases("gaussian_step", lambda latent: probe_step.step_kernels(latent, "cuda"), [], LATENTS),
    *_cases("gaussian_sum", gaussian_sum.sum_kernels, [], LATENTS),
    *_cases("probe_network", _probe_network, [((9, 64, 27),)], ((9, 64, 27), (1, 8, 3), (12, 48, 12), (12, 128, 75))),
    *_cases("smoke", _smoke, [], FLOATS),
    *_cases("lattice_step", lambda settings: [lattice.step_kernel(lattice.Spec(**settings))], [], LATTICE_STEPS),
    *_cases(
        "lattice_boundaries", _boundaries, [], (("D3Q19", "float32"), ("D2Q9", "float32"), ("D3Q27", "float16")), BOTH
    ),
    *_cases("fire", lambda stored: [fire.burn_kernel(stored)], [], FLOATS),
    *_cases("expansion", lambda of: [fire.expand_kernel("D3Q19", of, of == "float16")], [], ("float32", "float16")),
    *_cases("marks", lambda is_mesh: [lattice_bodies._mark_kernel(is_mesh)], [], BOTH),
    *_cases("advection", _advection, [], BOTH, BOTH, FLOATS),
    *_cases("planes", _planes, [], BOTH),
    *_cases("march_backward", lambda rays: [single_scatter._backward(rays)], [], BOTH),
    *_cases(
        "naf_block", lambda of: naf_block.kernels(*of, True), [((128, True),)], ((24, False), (24, True), (128, True))
    ),
]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK_MODULES else pytest.mark.slow) for name in MODULES]
)
def test_modules(name: str, tmp_path: Path, ptx: bool):
    """Modules whose kernels have one form; some kernels are in a module of Warp's of their own."""
    found = vars(importlib.import_module(f"wlm_kernels.{name}"))
    kernel, argument, types = FORMS.get(name, ("", "", ()))
    for each in types:
        wp.overload(found[kernel], {argument: each})
    made = {value.module for value in found.values() if isinstance(value, wp.Kernel)}
    assert made
    for i, module in enumerate(made):
        _compile(module, tmp_path / str(i), ptx)


@pytest.mark.parametrize(("build", "values"), FACTORIES)
def test_factories(build: Callable, values: tuple, tmp_path: Path, ptx: bool):
    """The kernels that a factory builds; each is a module of its own."""
    built = [kernel for kernel in _members(build(*values)) if isinstance(kernel, wp.Kernel)]
    assert built
    for i, kernel in enumerate(built):
        _compile(kernel.module, tmp_path / str(i), ptx)
