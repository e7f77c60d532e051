"""astcenc in threads."""

import numpy as np
import pytest

pytest.importorskip("astc_encoder")

from benchmarks.rivals import astcenc


@pytest.mark.parametrize("size", [(128, 96), (61, 150), (3, 5)])
def test_astc_in_threads_gives_the_bytes_of_its_rows_of_blocks(size, monkeypatch):
    monkeypatch.setattr(astcenc, "cores", lambda: 5)
    texels = np.random.default_rng(0).gamma(1.0, size=(*size, 3)).astype(np.float16)
    coder = astcenc.astc((6, 5), 10.0, "atlas")
    rows = b"".join(coder.encode(texels[first : first + 5]) for first in range(0, size[0], 5))
    assert coder.encode(texels) == rows
    assert coder.decode(rows, *size).shape == (*size, 3)
