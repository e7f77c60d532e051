"""A trained network that predicts six-way lightmaps, with facts about its training."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from torch import nn

from wlm.bundle import Bundle
from wlm.config import check_settings
from wlm.errors import WlmError
from wlm.smoke.network.settings import DatasetSettings, NetworkSettings
from wlm.smoke.network.unet import SixWayNetwork
from wlm.system import Model


@dataclass(frozen=True, eq=False)
class SmokeModel(Model):
    """A trained network that predicts six-way lightmaps.

    Attributes:
        network: The network in float32.
        summary: Facts about the training as JSON values; "dataset" has the settings of the training samples.
    """

    SYSTEM: ClassVar[str] = "smoke-network"

    network: SixWayNetwork
    summary: Mapping[str, Any]

    @property
    def settings(self) -> NetworkSettings:
        """Settings that the network was built with: its size and its kind of guiding map."""
        return self.network.settings

    @property
    def dataset(self) -> DatasetSettings:
        """Settings of the samples that the network was trained on, by which its guiding maps must be made.

        Raises:
            WlmError: The summary lacks these settings, or a setting is wrong.
        """
        if "dataset" not in self.summary:
            raise WlmError("summary.dataset: expected the settings of the network's training samples, found none")
        return check_settings(DatasetSettings, self.summary["dataset"], "summary.dataset.")

    def bundle(self, device: str = "cpu", **_: object) -> Bundle:
        """Returns the weights as half floats, one after the other, and in the document their shapes, the settings, the
        names of the planes, and those settings of the training samples by which guiding maps are marched."""
        settings, weights, _source = self._encoded()
        shapes = {name: weight.shape for name, weight in weights.items()}
        look = self.dataset.model_dump(include={"guide_step", "guide_spacing", "surface", "jitter"})
        document = {"settings": settings["network"], "names": self.network.names, "shapes": shapes, "look": look}
        buffers = {"weights": np.concatenate([weight.ravel() for weight in weights.values()])}
        return Bundle(self.SYSTEM, "network", "", document, buffers=buffers)


def parameter_count(network: nn.Module) -> int:
    """Returns the number of trained parameters."""
    return sum(parameter.numel() for parameter in network.parameters())
