"""Reads the code of native functions: CUDA C++ files in the folder `native` beside the kernels that use them."""

from importlib import resources


def native_source(package: str, name: str, **constants: int) -> str:
    """Reads the body of a native function for `wp.func_native`, or a part of one, from `NAME.cuh` in the folder
    `native` of a package, which is `__package__` of the kernels; declarations of the integer constants come before it.
    """
    declarations = (f"constexpr int {key} = {value};\n" for key, value in constants.items())
    return "".join(declarations) + (resources.files(package) / "native" / f"{name}.cuh").read_text(encoding="utf-8")


def on_cuda(code: str, otherwise: str) -> str:
    """Returns the body of a native function: `code`, which `native_source` has returned, on CUDA, and the statement
    `otherwise` on the CPU."""
    return f"#if defined(__CUDA_ARCH__)\n{code}#else\n{otherwise}\n#endif\n"
