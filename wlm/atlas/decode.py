"""The runtime path: light from a compressed lightmap (lightmap-uv-clustering-cascade, eq. 7)."""

import numpy as np
import torch
import warp as wp

from wlm import interop
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.mips import Tail
from wlm.atlas.model import LUT_STEPS, TAIL_OCTAVES, AtlasModel, tail_codec
from wlm.atlas.views import corner_weights, texel_triangles
from wlm.errors import WlmError
from wlm.texels import fill_gaps
from wlm_kernels.atlas import cascade, decode

_TEXELS_AT_ONCE = 1 << 24


class Decoder:
    """A model on a device. It is a `wlm.atlas.evaluation.Sampler`.

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
        lut = model.lut
        if model.method == "tiles":
            # As stored: two bytes per number.
            self._texels = wp.array(np.ascontiguousarray(model.texels), dtype=wp.vec3h, device=self.device)
            self._lut = wp.array(np.ascontiguousarray(lut), dtype=wp.uint16, device=self.device)
            self._second = {"first_block_code": model.first_block_code}
            if model.colour == "mixed":
                blocks = wp.array(np.ascontiguousarray(model.block_texels), dtype=wp.vec3h, device=self.device)
                self._second["blocks"] = blocks
        else:
            self._texels = wp.array(model.texels.astype(np.float32), dtype=float, device=self.device)
            self._lut = wp.array((lut / np.float32(LUT_STEPS)).astype(np.float32), dtype=float, device=self.device)
        self._corner = torch.tensor(model.uv, device=self.device)
        size = model.height, model.width
        self._tail = Tail(model.tail, *size, tail_codec(model.colour), self.device) if len(model.tail) else None

    def read(self, uv: torch.Tensor, lod: torch.Tensor | None = None, own: torch.Tensor | None = None) -> torch.Tensor:
        """Reads light at coordinates, as a shader does.

        Args:
            uv: float32 [N, 2] on the decoder's device: the model's new UVs where it has any, else the lightmap's.
            lod: float32 [N], octaves of the lightmap's texels along a pixel, of a model with mips; None: up close.
            own: With `lod`, of a model with new UVs: the lightmap's, which the mips are under.

        Returns:
            float32 [N, 3].

        Raises:
            ValueError: The model has no mips, or the lightmap's UVs are missing.
        """
        if lod is not None:
            if self._tail is None:
                raise ValueError("lod: expected a model with mips")
            if own is None and len(self._corner):
                raise ValueError("own: expected the lightmap's UVs beside the new ones, found none")
            near, far = self.read(uv), self._tail.read(uv if own is None else own, lod)
            return near + (lod - TAIL_OCTAVES + 1).clamp(0.0, 1.0)[:, None] * (far - near)
        uv = uv.contiguous()
        out = torch.empty((len(uv), 3), dtype=torch.float32, device=uv.device)
        if len(uv):
            self.run(interop.to_warp(uv, wp.vec2), out)
        return out

    def run(self, uv: wp.array, out: torch.Tensor) -> None:
        """Reads light into an existing array; on CUDA the work is queued, not awaited.

        Args:
            uv: vec2 [N], N at least 1.
            out: float32 [N, 3], written.
        """
        model = self.model
        if model.method == "tiles":
            decode.decode(
                uv,
                model.height,
                model.width,
                model.profile.tile,
                self._lut,
                self._texels,
                interop.to_warp(out, wp.vec3),
                **self._second,
            )
        else:
            cascade.sample(self._texels, self._lut, uv, interop.to_warp(out))

    def __call__(self, uv: torch.Tensor, triangle: torch.Tensor, barycentric: torch.Tensor) -> torch.Tensor:
        """Reads light at points of the mesh.

        Args:
            uv: float32 [N, 2], the mesh's own UVs there.
            triangle: int [N], the triangle of each point.
            barycentric: float32 [N, 3], weights of its corners.

        Returns:
            float32 [N, 3].
        """
        if len(self._corner):
            uv = (self._corner[triangle.long()] * barycentric[:, :, None]).sum(1)
        return self.read(uv)

    def texels(self, mesh: LightmappedMesh) -> torch.Tensor:
        """Decodes the texels of the mask, as `lightmap`.

        Args:
            mesh: The mesh that was compressed.

        Returns:
            float32 [K, 3], row by row, on the decoder's device.

        Raises:
            WlmError: The model is of another mesh.
        """
        if len(self._corner):
            return torch.from_numpy(self.lightmap(mesh)[mesh.mask]).to(self.device)
        self._check(mesh)
        height, width = mesh.mask.shape
        step, parts = max(1, _TEXELS_AT_ONCE // width), []
        for first in range(0, height, step):
            inside = torch.from_numpy(mesh.mask[first : first + step]).to(self.device)
            row, column = torch.nonzero(inside, as_tuple=True)
            uv = torch.stack([(column.double() + 0.5) / width, (row.double() + first + 0.5) / height], 1)
            parts.append(self.read(uv.float()))
        return torch.cat(parts)

    def lightmap(self, mesh: LightmappedMesh) -> np.ndarray:
        """Decodes the lightmap in its original layout.

        Args:
            mesh: The mesh that was compressed.

        Returns:
            float32 [H, W, 3], zero outside of the mask. Where the mesh has new UVs, a texel of the mask whose centre is
            in no triangle has the value of the nearest texel whose centre is.

        Raises:
            WlmError: The model is of another mesh.
        """
        height, width = mesh.mask.shape
        result = np.zeros((height, width, 3), np.float32)
        if not len(self._corner):
            result[mesh.mask] = self.texels(mesh).cpu().numpy()
            return result
        self._check(mesh)
        triangle, barycentric = texel_triangles(mesh, height, width, self.device)
        hit = triangle >= 0
        covered = hit.cpu().numpy()
        # A model with new UVs ignores the first argument.
        result[covered] = self(barycentric[hit], triangle[hit], corner_weights(barycentric[hit])).cpu().numpy()
        return fill_gaps(result, covered) * mesh.mask[..., None] if covered.any() else result

    def _check(self, mesh: LightmappedMesh) -> None:
        if mesh.mask.shape != (self.model.height, self.model.width) or mesh.source != self.model.source:
            raise WlmError(f"{mesh.name}: expected the mesh and lightmap that the model was made of")
