"""The file of a trained network: settings, weights as half floats, and a summary of the training."""

import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import JsonValue

from wlm.config import check_settings
from wlm.errors import WlmError
from wlm.formats.artifact import Artifact
from wlm.formats.parts import Part, check_part, check_parts
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.settings import NetworkSettings
from wlm.smoke.network.unet import SixWayNetwork
from wlm.system import Header, load

_SHIPPED = Path(__file__).resolve().parents[1] / "data" / "smoke-six-fast.safetensors"


class _Header(Header):
    """Settings in the header of a network's file."""

    network: NetworkSettings
    summary: dict[str, JsonValue]


def encode(model: SmokeModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Converts a network to the contents of a file, with weights rounded to half floats. Returns the settings, the
    weights by name, and a hash of the weights, which the file stores as its source."""
    parts = {}
    digest = hashlib.blake2b(digest_size=16)
    for name, weight in model.network.state_dict().items():
        with np.errstate(over="ignore"):
            parts[name] = weight.detach().float().cpu().numpy().astype(np.float16)
        if not np.isfinite(parts[name]).all():
            raise WlmError(
                f"weight {name}: cannot write: expected finite weights of at most 65504, the largest half float"
            )
        digest.update(parts[name].tobytes())
    settings = {"network": model.settings.model_dump(mode="json"), "summary": dict(model.summary)}
    return settings, parts, digest.hexdigest()


def decode(artifact: Artifact) -> SmokeModel:
    """Makes a network, in float32 on the CPU, from the settings and weights of its file. Raises a WlmError if a setting
    is wrong. Raises a ValueError if the weights do not match the settings."""
    header = check_settings(_Header, artifact.settings, "setting ")
    # The largest part is checked first, before memory for the network is allocated.
    lowest, channels = header.network.levels - 1, header.network.width * 2 ** (header.network.levels - 1)
    check_part(artifact.tensors, f"encoder.{lowest}.2.weight", Part(np.float16, (channels, channels, 3, 3)))
    network = SixWayNetwork(header.network)
    weights = network.state_dict()
    parts = check_parts(artifact.tensors, {name: Part(np.float16, tuple(w.shape)) for name, w in weights.items()})
    for name, weight in weights.items():
        weight.copy_(torch.from_numpy(parts[name].astype(np.float32)))
    return SmokeModel(network.eval(), header.summary)


def shipped() -> Path:
    """Returns the file of the trained network that ships with wlm."""
    if not _SHIPPED.is_file():
        raise WlmError(f"{_SHIPPED}: the network that comes with wlm is missing: install wlm again")
    return _SHIPPED


def open_network(path: str | os.PathLike[str] | None = None) -> SmokeModel:
    """Loads a trained network, and checks that its file has the settings that its guiding maps must be rendered with.
    `path` is the file; None or "fast": the network of the profile `fast`, which ships with wlm."""
    path = shipped() if path is None or os.fspath(path) == "fast" else path
    model = load(path, SmokeModel.SYSTEM)
    try:
        _ = model.dataset
    except WlmError as error:
        raise WlmError(f"{path}: {error}") from error
    return model
