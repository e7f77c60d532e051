"""The runtime decoder of compressed lightmaps (lightmap-uv-clustering-cascade, eq. 7)."""

import numpy as np
import torch
import warp as wp

from wlm import interop
from wlm.atlas.data import Sheet
from wlm.atlas.model import LUT_STEPS, MIP_OCTAVES, AtlasModel
from wlm.atlas.views import Points, corner_weights, texel_triangles
from wlm.errors import WlmError
from wlm.texels import fill_gaps
from wlm_kernels.atlas import decode
from wlm_kernels.raster import mips

_TEXELS_AT_ONCE = 1 << 24


class Decoder:
    """A model on a device that returns light at points of the scene, for example for `wlm.atlas.evaluation.compare`.

    Attributes:
        model: The model.
        device: "cpu" or "cuda:N".
    """

    def __init__(self, model: AtlasModel, device: str = "cpu") -> None:
        """Loads a model.

        Args:
            model: The model.
            device: "cpu", "cuda" or "cuda:N".

        Raises:
            WlmError: No such device.
        """
        self.model, self.device = model, interop.check_device(device)
        if model.method in ("tiles", "shared"):
            # Numbers stay as stored, with two bytes each.
            self._texels = self._blocks = self._halves(model.texels)
            if model.colour == "mixed":
                self._blocks = self._halves(model.block_texels)
            self._lut = wp.array(np.ascontiguousarray(model.lut), dtype=wp.uint16, device=self.device)
            self._sheets = wp.array(model.table(), dtype=int, device=self.device)
        else:
            lut = (model.lut / np.float32(LUT_STEPS)).astype(np.float32)
            self._texels = interop.to_warp(torch.tensor(model.texels[0], device=self.device).float())
            self._lut = wp.array(lut, dtype=float, device=self.device)
        self._corner = torch.tensor(model.uv, device=self.device)

    def _halves(self, texels: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(texels), dtype=wp.vec3h, device=self.device)

    def factors(self, state: float) -> np.ndarray:
        """Returns the factors by which shared tiles sum their components in a state, float32 [C, 3]. They are
        interpolated for a state such as 0.5, between the first two.

        Raises:
            ValueError: The state is below 0 or above the number of the last one.
        """
        last = len(self.model.states) - 1
        if not 0 <= state <= last:
            raise ValueError(f"state: expected a number of 0 to {last}, got {state}")
        low = min(int(state), max(last - 1, 0))
        near, far = self.model.factor[low], self.model.factor[min(low + 1, last)]
        return (near + np.float32(state - low) * (far - near)).astype(np.float32)

    def read(
        self, uv: torch.Tensor, sheet: torch.Tensor | int = 0, state: float = 0.0, lod: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Returns light at UVs, the same that the model's shader returns.

        Args:
            uv: float32 [N, 2] on the decoder's device: the model's new UVs if it has any, else the lightmap UVs.
            sheet: Number of each point's sheet (UV layout), from 0: int [N], or one for all points.
            state: 0 to the number of states - 1; fractions lie between two states.
            lod: float32 [N], base-2 logarithm of texels per pixel, for a model with mips; None: full resolution.

        Returns:
            float32 [N, 3], light.

        Raises:
            ValueError: No such state, or the model has no mips.
        """
        if lod is not None and not self.model.levels:
            raise ValueError("lod: expected None for a model without mip levels, got numbers")
        if self.model.method == "shared":
            return self._read_shared(uv, sheet, state, lod)
        if state != 0:
            raise ValueError(f"state: expected 0 for a model of one state, got {state}")
        uv = uv.contiguous()
        out = torch.empty((len(uv), 3), dtype=torch.float32, device=uv.device)
        if len(uv):
            self.run(interop.to_warp(uv, wp.vec2), out)
        return out

    def run(self, uv: wp.array, out: torch.Tensor) -> None:
        """Writes light at N UVs, vec2 [N], to `out`, float32 [N, 3], for a model with one lightmap; N is at least 1. On
        CUDA the work is queued, not awaited."""
        model = self.model
        if model.method == "tiles":
            size, tile = model.sheets[0].size, model.profile.tile
            textures = self._lut, self._texels, interop.to_warp(out, wp.vec3), self._blocks
            decode.decode(uv, *size, tile, *textures, model.first_block_code)
        else:
            if model.lut.size:
                place = torch.empty((len(out), 2), device=out.device)
                mips.sample(self._lut, uv, interop.to_warp(place))
                # The triangle wave of eq. 8 is the identity on what 16 bits without a sign hold.
                uv = interop.to_warp(place, wp.vec2)
            mips.sample(self._texels, uv, interop.to_warp(out))

    def __call__(self, points: Points, state: float = 0.0) -> torch.Tensor:
        """Returns light at N surface points of the scene in a state (a fraction lies between two), float32 [N, 3]."""
        uv = points.uv
        if len(self._corner):
            uv = (self._corner[points.triangle] * points.weight[:, :, None]).sum(1)
        return self.read(uv, points.sheet, state)

    def _read_shared(
        self, uv: torch.Tensor, sheet: torch.Tensor | int, state: float, lod: torch.Tensor | None
    ) -> torch.Tensor:
        """Returns light at N UVs, float32 [N, 3], of tiles that all states share or interpolated between two states."""
        factors, stride = self.factors(state), self.model.stride
        if not isinstance(sheet, torch.Tensor):
            sheet = torch.full((len(uv),), sheet, dtype=torch.int32, device=uv.device)
        if not stride:
            return self._read_rows(uv, sheet, factors, lod)
        before = int(state)
        light = self._read_rows(uv, sheet + before * stride, self.factors(before), lod)
        if state == before:
            return light
        after = self._read_rows(uv, sheet + (before + 1) * stride, self.factors(before + 1), lod)
        return light + (state - before) * (after - light)

    def _read_rows(
        self, uv: torch.Tensor, row: torch.Tensor, factors: np.ndarray, lod: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Returns light, float32 [N, 3], at N UVs; `row`, int [N], has for each UV the row in `AtlasModel.table` of the
        sheet or mip level that it is in."""
        if lod is not None:
            return self._between(uv, row.long(), factors, (lod - MIP_OCTAVES + 1).clamp(0.0, 32.0))
        uv, row = uv.contiguous(), row.int().contiguous()
        out = torch.empty((len(uv), 3), dtype=torch.float32, device=uv.device)
        if len(uv):
            factor = wp.array(factors, dtype=wp.vec3, device=self.device)
            points = interop.to_warp(uv, wp.vec2), interop.to_warp(row)
            textures = self._lut, self._texels, self._blocks, self.model.first_block_code
            table = self._sheets, self.model.profile.tile, factor
            decode.decode_shared(*points, *table, *textures, interop.to_warp(out, wp.vec3))
        return out

    def _between(self, uv: torch.Tensor, row: torch.Tensor, factors: np.ndarray, level: torch.Tensor) -> torch.Tensor:
        """Returns light at N UVs, float32 [N, 3], interpolated between two mip levels of `row`; `level` 0 is `row`."""
        smaller = torch.from_numpy(self.model.table()[:, 6].astype(np.int64)).to(uv.device)
        near, far = row, torch.where(smaller[row] > 0, smaller[row], row)
        for number in range(1, 1 + len(self.model.levels)):
            on = (level >= number) & (near != far)
            if not bool(on.any()):
                break
            after = torch.where(smaller[far] > 0, smaller[far], far)
            near, far = torch.where(on, far, near), torch.where(on, after, far)
        share = (level - level.floor())[:, None]
        below = self._read_rows(uv, near, factors)
        return below + share * (self._read_rows(uv, far, factors) - below)

    def texels(self, sheet: Sheet, number: int = 0, state: float = 0.0) -> torch.Tensor:
        """Decodes only the K texels in a sheet's mask, row by row: float32 [K, 3] on the device.

        Raises:
            WlmError: The sheet's size differs from that in the model.
        """
        height, width = sheet.mask.shape
        if (height, width) != self.model.sheets[number].size:
            raise WlmError(f"{sheet.name}: expected a sheet of the size in the model, found {width}x{height} texels")
        if len(self._corner):
            return torch.from_numpy(self._under_new_uvs(sheet)[sheet.mask]).to(self.device)
        step, parts = max(1, _TEXELS_AT_ONCE // width), []
        for first in range(0, height, step):
            inside = torch.from_numpy(sheet.mask[first : first + step]).to(self.device)
            row, column = torch.nonzero(inside, as_tuple=True)
            uv = torch.stack([(column.double() + 0.5) / width, (row.double() + first + 0.5) / height], 1)
            parts.append(self.read(uv.float(), number, state))
        return torch.cat(parts)

    def lightmap(self, sheet: int = 0, state: float = 0.0) -> np.ndarray:
        """Decodes a lightmap in its original layout.

        Args:
            sheet: Number of the sheet (UV layout), from 0.
            state: As for `read`.

        Returns:
            float32 [H, W, 3], zero outside of the mask. If the mesh has new UVs, a texel of the mask whose centre is in
            no triangle has the value of the nearest texel whose centre is in one.
        """
        own = self.model.scene.sheets[sheet]
        result = np.zeros((*own.mask.shape, 3), np.float32)
        result[own.mask] = self.texels(own, sheet, state).cpu().numpy()
        return result

    def _under_new_uvs(self, sheet: Sheet) -> np.ndarray:
        """Decodes the lightmap of a model with new UVs, float32 [H, W, 3]; texels outside all triangles are filled."""
        height, width = sheet.mask.shape
        result = np.zeros((height, width, 3), np.float32)
        triangle, barycentric = texel_triangles(sheet, height, width, self.device)
        hit = triangle >= 0
        covered = hit.cpu().numpy()
        weight = corner_weights(barycentric[hit])
        uv = (self._corner[triangle[hit]] * weight[:, :, None]).sum(1)
        result[covered] = self.read(uv).cpu().numpy()
        return fill_gaps(result, covered) if covered.any() else result
