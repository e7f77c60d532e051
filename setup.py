"""Lists the packages; everything else about the project is in pyproject.toml."""

from setuptools import find_packages, setup

setup(
    # The profiles stay at the repository's root, where people look for them, and travel inside the package.
    packages=[*find_packages(include=["wlm*"]), "wlm.configs"],
    package_dir={"wlm.configs": "configs"},
    package_data={
        "": ["native/*.cuh", "assets/*"],
        "wlm": ["data/*.safetensors", "data/*.npz"],
        "wlm.configs": ["*.yaml"],
    },
)
