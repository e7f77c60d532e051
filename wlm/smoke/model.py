"""A trained network."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from wlm.config import check_settings
from wlm.errors import WlmError
from wlm.smoke.network.settings import DatasetSettings, NetworkSettings
from wlm.smoke.network.unet import SixWayNetwork
from wlm.system import Model


@dataclass(frozen=True, eq=False)
class SmokeModel(Model):
    """A trained network.

    Attributes:
        network: The network in float32.
        summary: Facts of its training, JSON values; "dataset" holds the settings of its samples.
    """

    SYSTEM: ClassVar[str] = "smoke-network"

    network: SixWayNetwork
    summary: Mapping[str, Any]

    @property
    def settings(self) -> NetworkSettings:
        """The network's shape."""
        return self.network.settings

    @property
    def dataset(self) -> DatasetSettings:
        """The settings of the samples that it was trained on, which say how to make its guiding maps.

        Raises:
            WlmError: The summary lacks them, or they don't fit.
        """
        if "dataset" not in self.summary:
            raise WlmError("summary.dataset: expected the settings of the network's samples, found none")
        return check_settings(DatasetSettings, self.summary["dataset"], "summary.dataset.")
