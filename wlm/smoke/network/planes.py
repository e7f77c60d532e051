"""Encoding of guiding maps and lightmaps for the network, with values of about 0 to 1, and the container of samples."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream, to_warp
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import guide, march_planes
from wlm_kernels.smoke import planes as smoke_planes
from wlm_kernels.smoke.planes import FOOT
from wlm_kernels.smoke.settings import March

PLANES = (*DIRECTIONS, "opacity", "emission")
"""Planes that the network predicts, in order."""

GUIDES = {"paper": ("light", "opacity", "depth"), "six": (*DIRECTIONS, "emission", "opacity", "depth")}
"""Planes of each kind of guiding map; opacity and depth are last. The paper's has the light from the front, the top and
the bottom in one plane; "six" is ours: the coarse march, with a plane for each light."""

OPACITY_PLANE, EMISSION_PLANE = PLANES.index("opacity"), PLANES.index("emission")

VISIBLE = 0.05
"""Least opacity of a pixel that counts as smoke."""


def to_srgb(linear: torch.Tensor) -> torch.Tensor:
    """Encodes linear light by the sRGB curve, which is continued above 1; values below 0 count as 0."""
    # Clamped away from 0, where the power's slope is infinite and would turn a gradient into NaN.
    curve = 1.055 * linear.clamp(min=FOOT) ** (1 / 2.4) - 0.055
    return torch.where(linear <= FOOT, 12.92 * linear.clamp(min=0.0), curve)


def span(volume: DensityVolume, camera: Camera) -> tuple[float, float]:
    """Returns the distances from the camera, in world units, at which the bounding sphere of the volume's box begins
    and ends; the near one is negative if the camera is inside the sphere.

    A camera that turns about the box's centre has the same distances in all positions, so that depths are comparable.
    Distances are measured along the axis of an orthographic camera, or from the eye of a perspective camera.
    """
    away = torch.as_tensor(camera.position, dtype=torch.float64) - torch.as_tensor(volume.centre)
    if camera.perspective:
        distance = float(away.norm())
    else:
        distance = float(away @ torch.as_tensor(camera.toward, dtype=torch.float64))
    radius = 0.5 * volume.voxel * float(torch.tensor(volume.shape, dtype=torch.float64).norm())
    return distance - radius, distance + radius


def encode_guide(maps: torch.Tensor, near: float, far: float) -> torch.Tensor:
    """Encodes a guiding map of the paper's kind, [..., 3, H, W] of light, transparency and depth, for the network; all
    planes are 0 where there is no smoke.

    Returns [..., 3, H, W]: light in sRGB; opacity; depth, from 1 at `near` to 0 at `far`, the distances of `span`, and
    0 without a surface.
    """
    if maps.ndim < 3 or maps.shape[-3] != 3:
        raise ValueError(f"maps: expected shape [..., 3, H, W], got {tuple(maps.shape)}")
    light, transparency, depth = maps.unbind(-3)
    share = ((far - depth) / (far - near)).clamp(0.0, 1.0)
    return torch.stack([to_srgb(light), 1.0 - transparency, share * (depth > 0)], -3)


def render_guide(volume: DensityVolume, camera: Camera, kind: str, march: March) -> torch.Tensor:
    """Renders a guiding map of smoke, of a kind of `GUIDES`, from an orthographic camera, and encodes it for the
    network.

    `march` are settings as for `guide` if the kind is "paper", else as for `bake_coarse`. Returns float32 [C, H, W],
    the planes that `GUIDES` lists; 0 where there is no smoke, except emission of fire without smoke.
    """
    near, far = span(volume, camera)
    if not near < far:
        raise ValueError(f"camera: expected a near distance below the far one, got {near} and {far}")
    if kind == "paper":
        return encode_guide(guide(volume, camera, march).maps, near, far)
    if kind not in GUIDES:
        raise ValueError(f"kind: expected one of {', '.join(GUIDES)}, got {kind!r}")
    planes = march_planes(volume, camera, march)
    with stream(device_name(volume.device)):
        encoded = torch.empty_like(planes)
        smoke_planes.encode_six(to_warp(planes), near, far, volume.temperature is not None, to_warp(encoded))
    return encoded


def encode_lightmaps(six: SixWay) -> torch.Tensor:
    """Encodes six-way lightmaps, which have transparency, as planes [8, H, W] for the network, in the order of
    `PLANES`: six lightmaps in sRGB, opacity, and emission e as e / (1 + e) in sRGB, 0 where the smoke is cold."""
    if six.transparency is None:
        raise ValueError("six: expected lightmaps with transparency, got lightmaps without it")
    transparency = six.transparency
    glow = torch.zeros_like(transparency) if six.emission is None else six.emission.clamp(min=0.0)
    return torch.cat([to_srgb(six.lightmaps), torch.stack([1.0 - transparency, to_srgb(glow / (1.0 + glow))])])


def decode_lightmaps(planes: torch.Tensor, *, hot: bool = True, camera: Camera | None = None) -> SixWay:
    """Converts planes [8, H, W] of `encode_lightmaps` back to lightmaps, in float32 without a gradient, clamped to
    their ranges; without `hot` the result has no emission."""
    if planes.ndim != 3 or planes.shape[0] != len(PLANES):
        raise ValueError(f"planes: expected shape [{len(PLANES)}, H, W], got {tuple(planes.shape)}")
    with stream(device_name(planes.device)):
        planes = planes.detach().float().contiguous()
        light = torch.empty_like(planes)
        smoke_planes.decode(to_warp(planes), to_warp(light))
    glow = light[EMISSION_PLANE] if hot else None
    return SixWay(light[: len(DIRECTIONS)], light[OPACITY_PLANE], glow, camera)


@dataclass(frozen=True, eq=False)
class Pool:
    """N samples on one device, each with two successive frames, the earlier first; all floats are half floats.

    `guides`, [N, 2, C, H, W], are encoded guiding maps with the C planes of their kind in `GUIDES`; `targets`, [N, 2,
    8, H, W], encoded reference lightmaps, in the order of `PLANES`. `motion`, [N, 2, H, W], is by how many pixels to
    the right and down the smoke in the later frame has moved. `sequence`, int [N], is the simulated sequence of each
    sample; sets share no sequence.
    """

    guides: torch.Tensor
    targets: torch.Tensor
    motion: torch.Tensor
    sequence: torch.Tensor

    def __post_init__(self) -> None:
        count, size = len(self.guides), tuple(self.guides.shape[-2:])
        channels = self.guides.shape[2] if self.guides.ndim == 5 else 0
        if channels not in map(len, GUIDES.values()):
            raise ValueError(
                f"guides: expected shape [N, 2, C, H, W] with C planes of a kind in GUIDES, got {[*self.guides.shape]}"
            )
        shapes = {
            "guides": (count, 2, channels, *size),
            "targets": (count, 2, len(PLANES), *size),
            "motion": (count, 2, *size),
            "sequence": (count,),
        }
        for name, shape in shapes.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"{name}: expected shape {list(shape)}, got {list(getattr(self, name).shape)}")

    def __len__(self) -> int:
        return len(self.guides)

    @property
    def device(self) -> torch.device:
        """Device of the samples."""
        return self.guides.device

    def covered(self) -> torch.Tensor:
        """Returns the share of pixels that show smoke, 0 to 1, [N]: of a sample's two frames the smaller share."""
        return (self.targets[:, :, OPACITY_PLANE] > VISIBLE).float().mean((-2, -1)).amin(1)

    def take(self, which: torch.Tensor) -> Pool:
        """Returns the samples that an index tensor or a mask [N] selects."""
        return Pool(*(getattr(self, field.name)[which] for field in fields(self)))

    def to(self, device: str | torch.device) -> Pool:
        """Returns the same samples on another device."""
        return Pool(*(getattr(self, field.name).to(device) for field in fields(self)))
