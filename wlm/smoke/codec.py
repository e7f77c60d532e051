"""Trained networks in one file: settings, weights as half floats, a summary of the training; and as ONNX."""

from __future__ import annotations

import hashlib
import logging
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import ValidationError

from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.formats.atomic import atomic_path
from wlm.smoke.learn.dataset import DatasetSettings
from wlm.smoke.model import NetworkSettings, SixWayNetwork
from wlm.smoke.planes import GUIDES

__all__ = ["SYSTEM", "export_onnx", "load_network", "save_network", "settings_of", "shipped"]

SYSTEM = "smoke-network"

_SHIPPED = Path(__file__).resolve().parents[1] / "data" / "smoke-six-fast.safetensors"
_OPSET = 20
_HALF_MAX = 65504.0


def save_network(path: str | os.PathLike[str], network: SixWayNetwork, summary: Mapping[str, Any]) -> int:
    """Writes a network, whole or not at all.

    Args:
        path: The file.
        network: On any device.
        summary: Of its training, such as the dataset's settings, the seconds and the PSNR reached: JSON values.

    Returns:
        The size of the file, bytes.

    Raises:
        WlmError: A weight isn't a finite half float, or the file can't be written.
    """
    tensors = {}
    digest = hashlib.blake2b(digest_size=16)
    for name, value in network.state_dict().items():
        array = value.detach().float().cpu().numpy()
        # NaN compares as false too.
        if not (np.abs(array) <= _HALF_MAX).all():
            raise WlmError(f"{path}: cannot write: weight {name}: expected finite half floats")
        tensors[name] = array.astype(np.float16)
        digest.update(tensors[name].tobytes())
    settings = {"network": network.settings.model_dump(mode="json"), "summary": dict(summary)}
    return write_artifact(path, SYSTEM, settings, tensors, digest.hexdigest())


def load_network(
    path: str | os.PathLike[str], *, device: str = "cpu", width: int | None = None
) -> tuple[SixWayNetwork, dict[str, Any]]:
    """Reads what `save_network` wrote.

    Args:
        path: The file.
        device: Where the network goes.
        width: What its width must be; None: any.

    Returns:
        The network in float32, ready to be used, and the summary of its training.

    Raises:
        WlmError: One line: the file is missing or damaged, of another kind or width, or its weights aren't those of its
            settings.
    """
    artifact = read_artifact(path, SYSTEM)
    try:
        settings = NetworkSettings.model_validate(artifact.settings.get("network"))
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        field = ".".join(map(str, ("network", *problem["loc"])))
        raise WlmError(f"{path}: {field}: {problem['msg']}") from error
    summary = artifact.settings.get("summary")
    if not isinstance(summary, dict):
        raise WlmError(f"{path}: summary: expected a mapping, found {type(summary).__name__}")
    if width is not None and settings.width != width:
        raise WlmError(f"{path}: network.width: expected {width}, found {settings.width}")
    network = SixWayNetwork(settings)
    wanted = network.state_dict()
    for kind, names in (("lacks", wanted.keys() - artifact.tensors.keys()), ("has", artifact.tensors.keys() - wanted)):
        if names:
            raise WlmError(f"{path}: expected the weights of its settings: it {kind} {min(names)} ({len(names)} such)")
    for name, array in artifact.tensors.items():
        if tuple(wanted[name].shape) != array.shape or array.dtype != np.float16:
            expected = f"{list(wanted[name].shape)} of half floats"
            raise WlmError(f"{path}: weight {name}: expected {expected}, found {list(array.shape)} of {array.dtype}")
        if not np.isfinite(array).all():
            raise WlmError(f"{path}: weight {name}: expected finite numbers, found NaN or infinity")
        wanted[name].copy_(torch.from_numpy(array.astype(np.float32)))
    return network.to(device).eval(), summary


def shipped() -> Path:
    """The trained network that comes with wlm.

    Raises:
        WlmError: It isn't there.
    """
    if not _SHIPPED.is_file():
        raise WlmError(f"{_SHIPPED}: expected the network that comes with wlm, found none: install wlm anew")
    return _SHIPPED


def settings_of(path: str | os.PathLike[str], summary: Mapping[str, Any]) -> DatasetSettings:
    """The settings that a network was trained with, from the summary in its file: how it has to look at smoke.

    Raises:
        WlmError: The summary has none, or not these.
    """
    try:
        return DatasetSettings.model_validate(summary.get("dataset"))
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        field = ".".join(map(str, ("summary", "dataset", *problem["loc"])))
        raise WlmError(f"{path}: {field}: {problem['msg'].replace('Input should be', 'expected', 1)}") from error


def export_onnx(network: SixWayNetwork, path: str | os.PathLike[str], height: int, width: int) -> int:
    """Writes a network as ONNX, for one size of images: `guide` [1, C, H, W] to `lightmaps` [1, 8, H, W], float32.

    Lightmaps aren't clamped; `samples` says what the planes of both are.

    Returns:
        The size of the file, bytes.

    Raises:
        ValueError: A size below 1.
        WlmError: The extra `onnx` isn't installed, or the file can't be written.
    """
    if height < 1 or width < 1:
        raise ValueError(f"expected at least one pixel, got {height} x {width}")
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise WlmError(f"ONNX needs {error.name}: install wlm[onnx]") from error
    still = SixWayNetwork(network.settings)
    still.load_state_dict(network.state_dict())
    guide = torch.zeros(1, len(GUIDES[network.settings.guide]), height, width)
    with atomic_path(path) as temporary, warnings.catch_warnings(), _quiet(), torch.no_grad():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            still.eval(),
            (guide,),
            temporary,
            input_names=["guide"],
            output_names=["lightmaps"],
            opset_version=_OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
        return temporary.stat().st_size


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's lines on packages that these networks have no use for."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)
