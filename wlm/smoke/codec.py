"""A trained network's file: its settings, its weights as half floats, and a summary of the training."""

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
    """The settings of a file."""

    network: NetworkSettings
    summary: dict[str, JsonValue]


def encode(model: SmokeModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Rounds the weights to half floats.

    Returns:
        The file's settings, its parts, and a hash of these as its source.

    Raises:
        WlmError: A weight isn't a finite half float.
    """
    parts = {}
    digest = hashlib.blake2b(digest_size=16)
    for name, weight in model.network.state_dict().items():
        with np.errstate(over="ignore"):
            parts[name] = weight.detach().float().cpu().numpy().astype(np.float16)
        if not np.isfinite(parts[name]).all():
            raise WlmError(f"cannot write: weight {name}: expected finite half floats")
        digest.update(parts[name].tobytes())
    settings = {"network": model.settings.model_dump(mode="json"), "summary": dict(model.summary)}
    return settings, parts, digest.hexdigest()


def decode(artifact: Artifact) -> SmokeModel:
    """Makes a network of a file's parts, in float32 on the CPU.

    Raises:
        WlmError: A setting is wrong.
        ValueError: The weights aren't those of the settings.
    """
    header = check_settings(_Header, artifact.settings, "setting ")
    # The largest part first: without it no memory is taken for the network.
    lowest, channels = header.network.levels - 1, header.network.width * 2 ** (header.network.levels - 1)
    check_part(artifact.tensors, f"encoder.{lowest}.2.weight", Part(np.float16, (channels, channels, 3, 3)))
    network = SixWayNetwork(header.network)
    weights = network.state_dict()
    parts = check_parts(artifact.tensors, {name: Part(np.float16, tuple(w.shape)) for name, w in weights.items()})
    for name, weight in weights.items():
        weight.copy_(torch.from_numpy(parts[name].astype(np.float32)))
    return SmokeModel(network.eval(), header.summary)


def shipped() -> Path:
    """The file of the trained network that comes with wlm.

    Raises:
        WlmError: It is missing.
    """
    if not _SHIPPED.is_file():
        raise WlmError(f"{_SHIPPED}: expected the network that comes with wlm, found none: install wlm anew")
    return _SHIPPED


def open_network(path: str | os.PathLike[str] | None = None) -> SmokeModel:
    """Loads a network for use on smoke, which takes the settings of its guiding maps.

    Args:
        path: The file; None: the network that comes with wlm.

    Raises:
        WlmError: As `wlm.load`; or the file lacks the settings of the network's samples.
    """
    path = shipped() if path is None else path
    model = load(path, SmokeModel.SYSTEM)
    try:
        _ = model.dataset
    except WlmError as error:
        raise WlmError(f"{path}: {error}") from error
    return model
