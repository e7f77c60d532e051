"""The temporal lightmap fit in plain torch: the peer that the fused kernels are timed and checked against.

It has the model, samples per step, optimiser, schedule and stages of `wlm.lightmap`, but is written with batched matrix
products, `grid_sample` and autograd (neural-dynamic-gi, sections 3.3 to 4). It decodes from quantised values, as a file
would hold them, but writes no file. Its feature maps can differ from a profile's, for the paper's ablations (section
11).
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch.nn import functional

from benchmarks import plain
from benchmarks.rivals.rival import EXTRA
from wlm.formats.hdr_blocks import need
from wlm.lightmap.data import SheetFrames
from wlm.lightmap.fit import Batch, SheetFit
from wlm.lightmap.profile import Profile, TimeAxis, encode_time
from wlm.lightmap.tiles import TILE
from wlm.lightmap.trainer import Targets

_BLOCK = 4  # texels along a BC7 block's side
_ENCODED = 4  # numbers of gamma(t)
_CENTRE = math.sqrt(12.0)
_MOMENTUM = 0.9  # Adam's decay of gradients
_LEAST = 0.02  # smallest colour, over its scale, that weights an error: it keeps black texels in the fit


def dynamic_targets(lightmaps: SheetFrames, profile: Profile) -> Targets | None:
    """Returns the training data of the dynamic tiles of a sheet, for use by other trainers; None without such tiles."""
    fit = SheetFit(lightmaps, profile)
    rows = range(len(fit.model.uv))
    return fit.job(Batch(0, rows, fit)).targets() if rows else None


@dataclass(frozen=True)
class Features:
    """Sizes of a tile's feature maps, as `wlm.lightmap` has them.

    F_uv and F_uvt take 8 bits a texel, in blocks; F_ut and F_vt 8 bits a channel.

    Attributes:
        uv: Number of maps F_uv over texture coordinates u and v, each of 128 x 128 texels and 4 channels.
        uvt: Texels of the map F_uvt along u and along v, a multiple of 4; 0: there is no F_uvt.
        slices: Texels of F_uvt along time.
        columns, rows: Texels of the maps F_ut and F_vt along u or v, and along time.
        channels: Number of channels of F_ut and of F_vt; 0: there are no such maps.
        blocks: Whether F_uv and F_uvt are trained as endpoints and weights of BC7 blocks (eq. 7 and 8). Otherwise
            their texels are trained, and a BC7 encoder runs when they are frozen (extra `baselines`).
        encoded: Whether the fit ends as in the paper (section 3.4): noise stands for quantisation up to the last step,
            then an encoder of all modes of BC7 takes the texels of the blocks, and the network stays as it is.
    """

    uv: int = 1
    uvt: int = 32
    slices: int = 12
    columns: int = 64
    rows: int = 24
    channels: int = 2
    blocks: bool = True
    encoded: bool = False

    @classmethod
    def of(cls, profile: Profile) -> "Features":
        """Returns the sizes of a profile's feature maps: 2D and 3D maps together, as in eq. 5."""
        sizes = {"columns": profile.plane_columns, "rows": profile.plane_rows}
        return cls(uvt=profile.uvt_resolution, slices=profile.uvt_slices, **sizes)

    @property
    def inputs(self) -> int:
        """Returns the number of inputs of the network, including the encoded time."""
        return 4 * (self.uv + (self.uvt > 0)) + 2 * self.channels + _ENCODED

    @property
    def bytes(self) -> int:
        """Returns the size in bytes of a tile's maps."""
        planes = 2 * self.channels * self.columns * self.rows
        return self.uv * TILE * TILE + self.slices * self.uvt**2 + planes


class PlainFit:
    """The fit of N dynamic tiles, whose light changes over time.

    Attributes:
        parameters: The tensors that the optimiser moves, maps first.
        tile_bytes: Size in bytes of a tile: maps, network in half floats, and the parameters that scale its values.
    """

    def __init__(
        self,
        profile: Profile,
        axis: TimeAxis,
        targets: Targets,
        features: Features | None = None,
        *,
        seed: int = 0,
        device: str = "cpu",
    ):
        """Initialises the parameters at random.

        Args:
            profile: The settings; the sizes of maps are used only if `features` is None.
            axis: The times at which lightmaps are stored.
            targets: The colours of N tiles, which are fitted.
            features: Sizes of the feature maps; None: as in the profile.
            seed: Seed of all random numbers.
            device: "cpu" or "cuda:0".
        """
        self._random = torch.Generator(device).manual_seed(seed)
        self._device, self._profile, self._periodic = device, profile, axis.periodic
        self._features = f = Features.of(profile) if features is None else features
        self._targets, self._step = targets, 0

        def put(values, dtype=torch.float32):
            return torch.as_tensor(np.ascontiguousarray(values), device=device).to(dtype)

        self._tau, self._encoding = map(put, encode_time(axis))
        self._colour, self._weight = put(targets.colour), put(targets.weight)
        self._shift, self._spread, self._scale = put(targets.shift), put(targets.spread), put(targets.scale)
        self._texels, self._count = put(targets.texels, torch.long), put(targets.count)
        n, times = self._colour.shape[:2]
        self._row = torch.arange(n, device=device)[:, None]

        def map_(*shape):
            return (0.25 + 0.5 * self._rand(n, *shape)).requires_grad_()

        def blocks(slices, side):
            if not f.blocks:
                return (map_(slices, side, side, 4),)
            return map_(slices, side // _BLOCK, side // _BLOCK, 2, 4), map_(slices, side, side)

        def layer(inputs, outputs):
            weights = (2.0 * self._rand(n, outputs, inputs) - 1.0) / math.sqrt(inputs)
            return weights.requires_grad_(), torch.zeros(n, outputs, 1, device=device, requires_grad=True)

        self._uv = blocks(f.uv, TILE) if f.uv else ()
        self._uvt = blocks(f.slices, f.uvt) if f.uvt else ()
        self._planes = [map_(f.channels, f.rows, f.columns) for _ in range(2 * (f.channels > 0))]
        widths = (f.inputs, profile.hidden, profile.hidden, 3)
        self._layers = [layer(*pair) for pair in itertools.pairwise(widths)]
        self._fixed: list[torch.Tensor] | None = None
        maps = [*self._uv, *self._uvt, *self._planes]
        net = [value for pair in self._layers for value in pair]
        self.parameters = maps + net
        self.tile_bytes = f.bytes + 2 * sum(value[0].numel() for value in net) + 4 * times + 12
        groups = [{"params": maps, "lr": profile.map_rate}, {"params": net, "lr": profile.net_rate}]
        betas = (_MOMENTUM, profile.adam_decay)
        self._adam = torch.optim.Adam(groups, fused=True, betas=betas)
        final, last = profile.final_rate, max(profile.steps - 1, 1)
        self._schedule = torch.optim.lr_scheduler.LambdaLR(
            self._adam, lambda s: final + (1 - final) * 0.5 * (1 + math.cos(math.pi * min(s / last, 1)))
        )

    def _rand(self, *shape):
        return torch.rand(*shape, device=self._device, generator=self._random)

    def step(self) -> torch.Tensor:
        """Does one step of the fit. The profile states from which steps on maps are quantised and frozen.

        Returns:
            The loss of the step, the mean over tiles, samples and channels, a tensor on the device.
        """
        p, n, t = self._profile, *self._colour.shape[:2]
        until_end = self._features.encoded
        quantised = self._step >= round(p.quantise_from * p.steps) and not until_end
        if self._fixed is None and self._step >= round(p.freeze_from * p.steps) and not until_end:
            self._fixed = self._stored()
        place = (self._rand(n, p.samples) * self._count[:, None]).long()
        flat = self._texels.gather(1, place)
        k = (self._rand(n, p.samples) * t).long()
        maps = self._maps(quantised) if self._fixed is None else self._fixed
        target = self._colour[self._row, k, flat]
        error = self._answer(maps, self._layers, flat, k, noise=not quantised) - target
        weight = self._weight[self._row, k]
        if self._targets.emphasis:
            colour = self._shift[:, None] + self._spread[:, None] * target
            weight = weight * colour.clamp(min=_LEAST) ** self._targets.emphasis
        loss = (weight * error * error).mean()
        self._adam.zero_grad()
        loss.backward()
        self._adam.step()
        self._schedule.step()
        self._step += 1
        return loss.detach()

    @torch.no_grad()
    def decode(self) -> np.ndarray:
        """Decodes radiance at the T stored times from maps quantised as in a file, float32 [N, T, 128, 128, 3]."""
        maps = self._stored() if self._fixed is None else self._fixed
        layers = [(w.half().float(), b.half().float()) for w, b in self._layers]
        n, times = self._colour.shape[:2]
        flat = torch.arange(TILE * TILE, device=self._device).expand(n, -1)
        result = np.empty((n, times, TILE, TILE, 3), np.float32)
        for k in range(times):
            answer = self._answer(maps, layers, flat, torch.full_like(flat, k), noise=False)
            colour = (self._shift[:, None] + self._spread[:, None] * answer) * self._scale[:, k, None]
            radiance = colour.clamp(min=0.0) ** self._profile.gamma
            result[:, k] = radiance.reshape(n, TILE, TILE, 3).cpu().numpy()
        return result

    def _maps(self, quantised: bool) -> list[torch.Tensor]:
        """Returns the texels of N tiles' maps: F_uv [N, maps, 128, 128, 4], F_uvt [N, slices, side, side, 4], and F_ut
        and F_vt [N, channels, rows, columns]. Maps that a tile lacks are left out."""

        def levels(values):
            used = values.clamp(0.0, 1.0)
            return plain.straight_through(values, (used * 255.0 + 0.5).floor() / 255.0 if quantised else used)

        blocks = [parts for parts in (self._uv, self._uvt) if parts]
        texels = plain.bc7_texels if self._features.blocks else levels
        options = {"quantised": quantised and not self._features.encoded} if self._features.blocks else {}
        return [texels(*parts, **options) for parts in blocks] + [levels(values) for values in self._planes]

    @torch.no_grad()
    def _stored(self) -> list[torch.Tensor]:
        """Returns the texels of F_uv, F_uvt, F_ut and F_vt quantised as in a file; absent maps are left out."""
        maps = self._maps(quantised=True)
        count = len(maps) - len(self._planes)
        if self._features.blocks and not self._features.encoded:
            return maps
        return [through_bc7(values) for values in maps[:count]] + maps[count:]

    def _answer(self, maps, layers, flat, k, noise: bool):  # [N, B] each -> [N, B, 3]
        u, v, tau = (flat % TILE + 0.5) / TILE, (flat // TILE + 0.5) / TILE, self._tau[k]
        maps, parts = list(maps), []
        if self._uv:
            texels = maps.pop(0).flatten(2, 3)
            parts += [texels[self._row, i, flat].transpose(1, 2) for i in range(texels.shape[1])]
        if self._uvt:
            parts.append(self._sample(maps.pop(0).movedim(-1, 1), tau, v, u))
        parts += [self._sample(plane, tau, along) for plane, along in zip(maps, (u, v), strict=False)]
        features = torch.cat(parts, 1)
        if noise:
            features = features + (self._rand(*features.shape) - 0.5) / 256
        x = torch.cat([(features - 0.5) * _CENTRE, self._encoding[k].transpose(1, 2)], 1)
        form = "none" if self._profile.gelu == "exact" else "tanh"
        for i, (w, b) in enumerate(layers):
            x = w @ x + b
            x = functional.gelu(x, approximate=form) if i < 2 else x
        return x.transpose(1, 2)

    def _sample(self, values, tau, *place):
        """Interpolates maps [N, C, times, ...] at coordinates in [0, 1], [N, B] for each axis. Returns [N, C, B]."""
        if self._periodic:
            rows = values.shape[2]
            values = torch.cat([values[:, :, -1:], values, values[:, :, :1]], 2)
            tau = (tau * rows + 1.0) / (rows + 2.0)
        axes = [2 * x - 1 for x in (*reversed(place), tau)]
        grid = torch.stack(axes, -1).reshape(len(values), *[1] * (len(axes) - 1), -1, len(axes))
        return functional.grid_sample(values, grid, padding_mode="border", align_corners=False).flatten(2)


def through_bc7(texels: torch.Tensor) -> torch.Tensor:
    """Encodes and decodes maps in [0, 1], [..., H, W, 4], with a BC7 encoder of all modes; H and W are multiples of 4.

    Raises:
        WlmError: A package of the extra `baselines` is missing.
    """
    texcomp, codecs = need("ispc_texcomp", EXTRA), need("imagecodecs", EXTRA)
    image = (texels.cpu().numpy() * 255.0 + 0.5).astype(np.uint8).reshape(-1, texels.shape[-2], 4)
    surface = texcomp.RGBASurface(image.tobytes(), image.shape[1], image.shape[0])
    data = texcomp.compress_blocks_bc7(surface, texcomp.BC7EncSettings.from_profile("alpha_slow"))
    decoded = codecs.bcn_decode(data, 7, shape=image.shape) / np.float32(255.0)
    return torch.from_numpy(decoded.reshape(texels.shape)).to(texels)
