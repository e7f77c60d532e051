"""Marks the tests that measure a whole system as slow."""

from pathlib import Path

import pytest

from benchmarks import Row

HERE = Path(__file__).parent
MEASURED = {"rows", "made"}
"""Fixtures that run a whole benchmark, which takes up to a minute."""


@pytest.hookimpl(tryfirst=True)  # before tests are selected by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks tests of measured rows as slow."""
    for item in items:
        if item.path.parent == HERE and MEASURED & set(item.fixturenames):
            item.add_marker(pytest.mark.slow)


@pytest.fixture
def given_rows() -> list[Row]:
    """Rows for tests of the command line, which need no measurement."""
    return [Row("lightmap", "three", "ours", "M", {"psnr": 40.0})]
