"""Bodies of native functions: CUDA C++ in files of its own, in the folder ``native`` beside the kernels that use it."""

from importlib import resources
from string import Template

__all__ = ["native_source"]


def native_source(package: str, name: str, **numbers: int) -> str:
    """Reads the body of a native function for ``wp.func_native``.

    Args:
        package: The package whose folder ``native`` has the file: ``__package__`` of the kernels.
        name: The file is ``NAME.cuh``: comments, an empty line, then code, indented as a function's body is.
        numbers: By name, what the ``$name``s in the code stand for.

    Returns:
        The code. What stands above the file's first empty line explains it and is left out.

    Raises:
        KeyError: The code has a name that ``numbers`` lacks.
    """
    text = (resources.files(package) / "native" / f"{name}.cuh").read_text(encoding="utf-8")
    _, code = text.split("\n\n", 1)
    return f"\n{Template(code).substitute(numbers)}    "
