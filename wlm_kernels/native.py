"""Reads the code of native functions: CUDA C++ files in the folder `native` beside the kernels that use them."""

from importlib import resources


def native_source(package: str, name: str, **constants: int) -> str:
    """Reads the body of a native function for `wp.func_native`, or a part of one.

    Args:
        package: The package whose folder `native` contains the file `NAME.cuh`: `__package__` of the kernels.
        name: The file's NAME.
        constants: Integer constants of the code, by name.

    Returns:
        The declarations of the constants, followed by the file's text.
    """
    declarations = (f"constexpr int {key} = {value};\n" for key, value in constants.items())
    return "".join(declarations) + (resources.files(package) / "native" / f"{name}.cuh").read_text(encoding="utf-8")


def on_cuda(code: str, otherwise: str) -> str:
    """Returns the body of a native function: `code`, which `native_source` has returned, on CUDA, and the statement
    `otherwise` on the CPU."""
    return f"#if defined(__CUDA_ARCH__)\n{code}#else\n{otherwise}\n#endif\n"
