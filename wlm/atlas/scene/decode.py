"""The runtime path: light from a scene's compressed lightmaps."""

import numpy as np
import torch
import warp as wp

from wlm import interop
from wlm.atlas.model import FIRST_BLOCK_CODE, NO_BLOCKS, TAIL_OCTAVES
from wlm.atlas.scene.model import SceneModel
from wlm_kernels.atlas import scene as kernels


class Decoder:
    """A model on a device.

    Attributes:
        model: The model.
        device: "cpu" or "cuda:N".
    """

    def __init__(self, model: SceneModel, device: str = "cpu") -> None:
        """Loads a model.

        Args:
            model: The model.
            device: "cpu", "cuda" or "cuda:N".

        Raises:
            WlmError: No such device.
        """
        self.model, self.device = model, interop.check_device(device)
        self._texels = wp.array(np.ascontiguousarray(model.texels), dtype=wp.uint32, device=self.device)
        self._lut = wp.array(np.ascontiguousarray(model.lut), dtype=wp.uint16, device=self.device)
        mixed = model.colour == "mixed"
        blocks = model.block_texels if mixed else np.zeros((1, 1, 1, 3), np.float16)
        self._blocks = wp.array(np.ascontiguousarray(blocks), dtype=wp.vec3h, device=self.device)
        self._code = FIRST_BLOCK_CODE if mixed else NO_BLOCKS
        self._sheets = wp.array(model.table(), dtype=int, device=self.device)

    def factors(self, state: float) -> np.ndarray:
        """The factors of a state, float32 [C, 3]; between two states, 0.5 for example, they are mixed.

        Raises:
            ValueError: It is below 0 or above the last.
        """
        last = len(self.model.states) - 1
        if not 0 <= state <= last:
            raise ValueError(f"state: expected 0 to {last}, got {state}")
        low = min(int(state), max(last - 1, 0))
        near, far = self.model.factor[low], self.model.factor[min(low + 1, last)]
        return (near + np.float32(state - low) * (far - near)).astype(np.float32)

    def read(
        self, uv: torch.Tensor, sheet: torch.Tensor, state: float, lod: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Reads light at points, as a shader does.

        Args:
            uv: float32 [N, 2] on the decoder's device, in the sheets.
            sheet: int [N], 0 to S - 1.
            state: As for `factors`.
            lod: float32 [N], octaves of the sheet's texels along a pixel, of a model with mips; None: up close.

        Returns:
            float32 [N, 3].

        Raises:
            ValueError: The model has no mips.
        """
        if lod is not None and not self.model.levels:
            raise ValueError("lod: expected a model with mips")
        factors = self.factors(state)
        if not self.model.stride:
            return self._read(uv, sheet, factors, lod)
        before = int(state)
        light = self._read(uv, sheet + before * self.model.stride, self.factors(before), lod)
        if state == before:
            return light
        after = self._read(uv, sheet + (before + 1) * self.model.stride, self.factors(before + 1), lod)
        return light + (state - before) * (after - light)

    def _read(
        self, uv: torch.Tensor, row: torch.Tensor, factors: np.ndarray, lod: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Light of rows of the table, with a state's factors."""
        if lod is not None:
            return self._between(uv, row.long(), factors, (lod - TAIL_OCTAVES + 1).clamp(0.0, 32.0))
        uv, row = uv.contiguous(), row.int().contiguous()
        out = torch.empty((len(uv), 3), dtype=torch.float32, device=uv.device)
        if len(uv):
            factor = wp.array(factors, dtype=wp.vec3, device=self.device)
            points = interop.to_warp(uv, wp.vec2), interop.to_warp(row)
            tile, result = self.model.profile.tile, interop.to_warp(out, wp.vec3)
            textures = self._texels, self._blocks, self._code
            kernels.read(*points, self._sheets, tile, factor, self._lut, *textures, result)
        return out

    def _between(self, uv: torch.Tensor, row: torch.Tensor, factors: np.ndarray, level: torch.Tensor) -> torch.Tensor:
        """Light between two levels, 0 the row's own."""
        smaller = torch.from_numpy(self.model.table()[:, 6].astype(np.int64)).to(uv.device)
        near, far = row, torch.where(smaller[row] > 0, smaller[row], row)
        for number in range(1, 1 + len(self.model.levels)):
            on = (level >= number) & (near != far)
            if not bool(on.any()):
                break
            after = torch.where(smaller[far] > 0, smaller[far], far)
            near, far = torch.where(on, far, near), torch.where(on, after, far)
        share = (level - level.floor())[:, None]
        below = self._read(uv, near, factors)
        return below + share * (self._read(uv, far, factors) - below)

    def lightmap(self, sheet: int, state: float) -> np.ndarray:
        """Decodes a lightmap in its own layout, float32 [H, W, 3]; in the gaps between charts it is anything."""
        place = self.model.sheets[sheet]
        row, column = torch.meshgrid(torch.arange(place.height), torch.arange(place.width), indexing="ij")
        uv = torch.stack([(column + 0.5) / place.width, (row + 0.5) / place.height], 2).reshape(-1, 2)
        number = torch.full((len(uv),), sheet, dtype=torch.int32, device=self.device)
        light = self.read(uv.float().to(self.device), number, state)
        return light.reshape(place.height, place.width, 3).cpu().numpy()
