"""Bodies of native functions: CUDA C++ in files of its own, in the folder `native` beside the kernels that use it."""

from importlib import resources


def native_source(package: str, name: str, **constants: int) -> str:
    """Reads the body of a native function for `wp.func_native`, or a part of one.

    Args:
        package: The package whose folder `native` has the file `NAME.cuh`: `__package__` of the kernels.
        name: See `package`.
        constants: Integers that the code uses, by name.

    Returns:
        The constants' declarations and the file.
    """
    declarations = (f"constexpr int {key} = {value};\n" for key, value in constants.items())
    return "".join(declarations) + (resources.files(package) / "native" / f"{name}.cuh").read_text(encoding="utf-8")


def on_cuda(code: str, otherwise: str) -> str:
    """A body whose code only a GPU's compiler takes, and another one for the CPU's.

    Args:
        code: From `native_source`.
        otherwise: A statement.
    """
    return f"#if defined(__CUDA_ARCH__)\n{code}#else\n{otherwise}\n#endif\n"
