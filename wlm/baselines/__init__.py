"""What the systems are compared with. Block codecs need the extra `baselines`."""

from wlm.baselines.blocks import (
    BASELINES,
    BlockResult,
    encode_8bit,
    encode_astc,
    encode_bc6h,
    encode_bc7,
    run_baselines,
)

__all__ = [
    "BASELINES",
    "BlockResult",
    "encode_8bit",
    "encode_astc",
    "encode_bc6h",
    "encode_bc7",
    "run_baselines",
]
