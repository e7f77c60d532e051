"""Lists the packages; everything else about the project is in pyproject.toml."""

from setuptools import find_packages, setup

setup(
    # The profiles are at the repository's root, where users look for them, and are installed inside the package.
    packages=[*find_packages(include=["wlm*"]), "wlm.configs"],
    package_dir={"wlm.configs": "configs"},
    package_data={
        "": ["native/*.cuh", "assets/*", "*.pyi"],
        "wlm": ["py.typed", "data/*.safetensors", "data/*.npz"],
        "wlm.configs": ["*.yaml", "meshes/*"],
    },
)
