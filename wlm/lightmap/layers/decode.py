"""The runtime path of layered files: each sheet's own decoder, and layers put together from them."""

from __future__ import annotations

import numpy as np

from wlm.lightmap.decode import Decoder as SheetDecoder
from wlm.lightmap.layers.model import LayeredModel
from wlm.lightmap.layers.sheet import Sheet


class Decoder:
    """Decodes layers of atlases; see `wlm.lightmap.Decoder` for light between hours and beside charts.

    Attributes:
        model: The model.
        sheets: The decoder of each sheet, which gives levels of linear ones (`Sheet.values` makes values of them).
    """

    def __init__(self, model: LayeredModel, device: str = "cpu", gelu: str | None = None) -> None:
        """Uploads a model.

        Args:
            model: The model.
            device, gelu: As for `wlm.lightmap.Decoder`.

        Raises:
            WlmError: No such device or GELU.
        """
        self.model = model
        self.sheets = {sheet: SheetDecoder(own, device, gelu) for sheet, own in model.sheets.items()}

    @property
    def device(self) -> str:
        """Where the maps are."""
        return next(iter(self.sheets.values())).device

    @property
    def device_bytes(self) -> int:
        """Memory that maps, networks and frames take up on the device, bytes."""
        return sum(decoder.device_bytes for decoder in self.sheets.values())

    def layer(self, time: float, name: str | None = None, atlas: str | None = None) -> np.ndarray:
        """Decodes a layer of an atlas.

        Args:
            time: In the unit of the set's times.
            name, atlas: As for `LayeredModel.layer`.

        Returns:
            Its channels, float32 [H, W, C]; texels of tiles without a valid one have the level 0.

        Raises:
            WlmError: There is no such layer, or the time isn't finite.
        """
        return self._values(self.model.layer(name, atlas), time)

    def frame(self, time: float) -> dict[str, dict[str, np.ndarray]]:
        """Decodes everything.

        Returns:
            By atlas and layer the channels, float32 [H, W, C].

        Raises:
            WlmError: The time isn't finite.
        """
        frame: dict[str, dict[str, np.ndarray]] = {}
        for atlas, name in dict.fromkeys((sheet.atlas, sheet.layer) for sheet in self.sheets):
            frame.setdefault(atlas, {})[name] = self.layer(time, name, atlas)
        return frame

    def _values(self, sheets: list[Sheet], time: float) -> np.ndarray:
        return np.concatenate([sheet.values(self.sheets[sheet].frame(time)) for sheet in sheets], axis=2)
