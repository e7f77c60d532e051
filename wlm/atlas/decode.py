"""The runtime path: light from a compressed lightmap (lightmap-uv-clustering-cascade, eq. 7)."""

import numpy as np
import torch
import warp as wp

from wlm import interop
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.model import AtlasModel
from wlm.atlas.views import texel_triangles
from wlm.errors import WlmError
from wlm.texels import fill_gaps
from wlm_kernels.atlas import cascade, decode

__all__ = ["Decoder"]


class Decoder:
    """A model on a device.

    It is a ``wlm.atlas.evaluation.Sampler``.

    Attributes:
        model, device: As given.
    """

    def __init__(self, model: AtlasModel, device: str = "cpu"):
        """Loads a model.

        Args:
            model: The model.
            device: "cpu" or "cuda:0".

        Raises:
            WlmError: No such device.
        """
        self.model, self.device = model, interop.check_device(device)
        lut = model.lut
        if model.method == "tiles":
            # As stored: two bytes a number.
            self._texels = wp.array(np.ascontiguousarray(model.texels), dtype=wp.vec3h, device=self.device)
            self._lut = wp.array(np.ascontiguousarray(lut), dtype=wp.uint16, device=self.device)
        else:
            self._texels = wp.array(model.texels.astype(np.float32), dtype=float, device=self.device)
            self._lut = wp.array((lut / np.float32(65535)).astype(np.float32), dtype=float, device=self.device)
        self._corner = torch.tensor(model.uv, device=self.device)

    def read(self, uv: torch.Tensor) -> torch.Tensor:
        """Light at coordinates, as a shader reads it.

        Args:
            uv: float32 [N, 2] on the decoder's device: the model's own UVs where it has any, else the lightmap's.

        Returns:
            float32 [N, 3].
        """
        uv = uv.contiguous()
        out = torch.empty((len(uv), 3), dtype=torch.float32, device=uv.device)
        if len(uv):
            self.run(interop.to_warp(uv, wp.vec2), out)
        return out

    def run(self, uv: wp.array, out: torch.Tensor) -> None:
        """Reads light into an array that is there; on CUDA it is queued, not awaited.

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
            )
        else:
            cascade.sample(self._texels, self._lut, uv, interop.to_warp(out))

    def __call__(self, uv: torch.Tensor, triangle: torch.Tensor, barycentric: torch.Tensor) -> torch.Tensor:
        """Light at points of the mesh.

        Args:
            uv: float32 [N, 2], the mesh's own UVs there.
            triangle: int [N], which triangle each is in.
            barycentric: float32 [N, 3].

        Returns:
            float32 [N, 3].
        """
        if len(self._corner):
            uv = (self._corner[triangle.long()] * barycentric[:, :, None]).sum(1)
        return self.read(uv)

    def lightmap(self, mesh: LightmappedMesh) -> np.ndarray:
        """The lightmap in its original layout.

        Args:
            mesh: The mesh that was compressed.

        Returns:
            float32 [H, W, 3], zero outside of the mask. A texel of the mask whose centre is in no triangle has the
            value of the nearest that is, where the mesh has new UVs.

        Raises:
            WlmError: The model is of another mesh.
        """
        height, width = mesh.mask.shape
        if (height, width) != (self.model.height, self.model.width) or mesh.source != self.model.source:
            raise WlmError(f"{mesh.name}: expected the mesh and lightmap that the model was made of")
        result = np.zeros((height, width, 3), np.float32)
        if not len(self._corner):
            row, column = np.nonzero(mesh.mask)
            uv = np.stack([(column + 0.5) / width, (row + 0.5) / height], 1).astype(np.float32)
            result[mesh.mask] = self.read(torch.from_numpy(uv).to(self.device)).cpu().numpy()
            return result
        triangle, barycentric = texel_triangles(mesh, height, width, self.device)
        hit = triangle >= 0
        weight = barycentric[hit]
        weight = torch.cat([weight, 1.0 - weight.sum(1, keepdim=True)], 1)
        found = hit.cpu().numpy()
        result[found] = self(weight[:, :2], triangle[hit], weight).cpu().numpy()
        return fill_gaps(result, found) * mesh.mask[..., None] if found.any() else result
