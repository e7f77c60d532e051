"""Decodes lightmaps to arrays in host memory: a tile or a whole map at any time, from the stored bytes alone."""

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from wlm.errors import WlmError
from wlm.lightmap.encodings import ENCODINGS
from wlm.lightmap.encodings.base import DeviceTiles
from wlm.lightmap.groups import Weight, changed_weights
from wlm.lightmap.model import LightmapModel, SheetModel
from wlm.lightmap.sheet import Sheet, first_light
from wlm.lightmap.tiles import TILE, place
from wlm.texels import near_gaps
from wlm_kernels.mlp import GELUS

_PIECE = 1024  # tiles that are decoded at once: 192 MiB


def device_of(device: str) -> str:
    """Checks a device as `wlm.interop.check_device` does, but without torch for the CPU, which is always there. A
    program that only decodes on the CPU then takes some 200 MB less memory."""
    if device == "cpu":
        return device
    from wlm.interop import check_device

    return check_device(device)


def gelu_of(model: SheetModel, gelu: str | None) -> str:
    """Returns the GELU variant to decode with: `gelu` after a check, or the model's own if `gelu` is None."""
    gelu = gelu or model.profile.gelu
    if gelu not in GELUS:
        raise WlmError(f"gelu: expected one of {', '.join(GELUS)}, got {gelu!r}")
    return gelu


class SheetDecoder:
    """Decodes tiles and maps of a sheet (up to three channels of a layer) on a device, from the stored bytes.

    Between two stored times, either the radiance of the two is interpolated (neural-dynamic-gi, eq. 2) or the network
    evaluates interpolated features, see `Profile.interpolation`; for tiles stored as frames it is always the radiance.
    Times outside the period wrap; in a set without a period they are clamped to the first and last stored time. Texels
    outside charts, within two texels of one, get the light of the nearest valid texel, so that a map can be filtered.

    Attributes:
        model: The sheet, or the part of it that was uploaded, whose other tiles are empty.
        device: The device, as `wlm.interop.check_device` returns it.
    """

    def __init__(self, model: SheetModel, device: str = "cpu", tiles: Sequence[int] | np.ndarray | None = None) -> None:
        """Uploads a sheet, or only the tiles of some numbers, which alone are read of a sheet of a file."""
        self.device, gelu = device_of(device), model.profile.gelu
        self.model = model if tiles is None else model.only(tiles)
        self._grid, self._left_out = model.grid, np.flatnonzero(model.kind != self.model.kind)
        self._tiles: list[DeviceTiles] = [
            uploaded for encoding in ENCODINGS for uploaded in encoding.upload(self.model, self.device, gelu)
        ]

    @cached_property
    def _gaps(self) -> list[tuple[np.ndarray, ...]]:
        return [tuple(at.T) for at in near_gaps(self.model.mask)]

    @property
    def device_bytes(self) -> int:
        """Memory that the maps, networks and frames take on the device, in bytes."""
        return sum(tiles.device_bytes for tiles in self._tiles)

    def tiles(self, numbers: Sequence[int], time: float) -> np.ndarray:
        """Decodes tiles to linear radiance, float32 [n, 128, 128, 3]; gaps are not filled, empty tiles are 0."""
        self.model.axis.wrap(time)
        if len(wrong := np.intersect1d(numbers, self._left_out)):
            raise WlmError(f"{self.model.name}: tile {wrong[0]}: expected one of the decoder's tiles, got another")
        out = np.zeros((len(numbers), TILE, TILE, 3), np.float32)
        for tiles in self._tiles:
            places, rows = tiles.among(numbers)
            if len(rows) == len(numbers) > 0:
                return tiles.radiance(rows, time)  # without a copy
            if len(rows):
                out[places] = tiles.radiance(rows, time)
        return out

    def frame(self, time: float) -> np.ndarray:
        """Decodes the map, float32 [H, W, 3]: radiance, or values in [0, 1] if it isn't light; 0 in empty tiles and in
        tiles that were not uploaded."""
        image = np.zeros((self._grid.height, self._grid.width, 3), np.float32)
        for numbers in self._stored():
            place(image, self.tiles(numbers.tolist(), time), numbers, self._grid)
        # As a baker dilates charts: a bilinear read at the edge of a chart includes texels outside it.
        target, source = self._gaps
        image[target] = image[source]
        return image

    def _stored(self) -> list[np.ndarray]:
        """Returns the numbers of the non-empty tiles in groups: decoding by groups limits the memory that it takes."""
        stored = np.flatnonzero(self.model.kind)
        return np.split(stored, range(_PIECE, len(stored), _PIECE))


class Decoder:
    """Decodes all layers and atlases of a model, and adds its light groups by their weights.

    Attributes:
        model: The model.
        sheets: The decoder of each sheet, or of those that were chosen.
        weights: float32 [3] by group, the factors of red, green and blue; initially 1. Changed by `set_weights`.
    """

    def __init__(
        self,
        model: LightmapModel,
        device: str = "cpu",
        tiles: Mapping[Sheet, Sequence[int]] | Sequence[int] | None = None,
    ) -> None:
        """Uploads a model.

        Args:
            model: The model.
            device: As for `SheetDecoder`.
            tiles: Numbers of the tiles to upload, by sheet, or of a model with one sheet the numbers alone. Of a file
                only these are read, and sheets that are not named have no decoder. None: all.

        Raises:
            WlmError: As for `SheetDecoder`, or there is no such sheet.
        """
        self.model, self.weights = model, {group: np.ones(3, np.float32) for group in model.groups}
        chosen: Mapping[Sheet, Sequence[int] | None] = dict.fromkeys(model.sheets)
        if tiles is not None:
            if not isinstance(tiles, Mapping) and len(model.sheets) > 1:
                raise WlmError(f"{model.name}: tiles: expected the tiles by sheet for {len(model.sheets)} sheets")
            named = tiles if isinstance(tiles, Mapping) else dict.fromkeys(model.sheets, tiles)
            for sheet in named.keys() - model.sheets.keys():
                raise WlmError(f"{model.name}: tiles: expected a sheet of the model, got {sheet}")
            chosen = {sheet: named[sheet] for sheet in model.sheets if sheet in named}
        self.sheets: dict[Sheet, SheetDecoder] = {
            sheet: SheetDecoder(model.sheets[sheet], device, own) for sheet, own in chosen.items()
        }

    @property
    def light(self) -> SheetDecoder:
        """The decoder of the first sheet of radiance, or of the first sheet if no sheet is radiance."""
        return self.sheets[first_light(self.sheets)]

    @property
    def device(self) -> str:
        """The device that decodes."""
        return self.light.device

    @property
    def device_bytes(self) -> int:
        """Memory that maps, networks and frames take on the device, in bytes."""
        return sum(decoder.device_bytes for decoder in self.sheets.values())

    def set_weights(self, weights: Mapping[str, Weight]) -> None:
        """Sets the weights of some groups for the following frames; the others keep theirs.

        Args:
            weights: By group a factor of its light, or one each of red, green and blue, from 0 to 65,504.

        Raises:
            WlmError: The model has no such group, or a weight is wrong; no weight is changed.
        """
        self.weights = changed_weights(self.model.name, self.weights, weights)

    def frame(self, time: float, layer: str | None = None, atlas: str | None = None) -> np.ndarray:
        """Decodes one layer of one atlas at one time; of light the weighted sum of the groups.

        Args:
            time: In the unit of the set's times, stored or between.
            layer: Name of the layer. None: the first layer of radiance, or the first layer if no layer is radiance.
            atlas: Name of the atlas. None: the first atlas that has the layer.

        Returns:
            The channels, float32 [H, W, C]: linear radiance, or the layer's values; empty tiles have its lowest value.
        """
        sheets = self.model.layer(layer, atlas)
        if left_out := [sheet for sheet in sheets if sheet not in self.sheets]:
            raise WlmError(f"{self.model.name}: expected one of the decoder's sheets, got {left_out[0].label}")
        sums: dict[tuple[str, ...], np.ndarray] = {}
        for sheet in sheets:
            weight = np.float32(1.0) if sheet.linear else self.weights[sheet.group]
            # A group that is switched off is not decoded.
            light = self.sheets[sheet].frame(time) * weight if weight.any() or sheet.channels not in sums else 0.0
            sums[sheet.channels] = sums[sheet.channels] + light if sheet.channels in sums else light
        frames = [sheet.to_values(sums[sheet.channels]) for sheet in sheets if sheet.group == sheets[0].group]
        return frames[0] if len(frames) == 1 else np.concatenate(frames, axis=2)

    def frames(self, time: float) -> dict[str, dict[str, np.ndarray]]:
        """Decodes all layers at one time. Returns the channels, float32 [H, W, C], by atlas, then by layer."""
        result: dict[str, dict[str, np.ndarray]] = {}
        for atlas, layer in dict.fromkeys((sheet.atlas, sheet.layer) for sheet in self.sheets):
            result.setdefault(atlas, {})[layer] = self.frame(time, layer, atlas)
        return result
