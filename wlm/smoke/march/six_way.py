"""Ray marches of six-way lightmaps, fine or in large steps, and of guiding maps.

The paper's references are single scattering by path tracing with 512 samples per pixel (section 5). Single scattering
is an integral, which `bake` computes by quadrature, without noise and with an estimate of its error.

The paper's guiding map is marched in steps of 10 voxels for the sum of three lights, and a network computes six
lightmaps from this sum (section 4.2). The same march can compute the six lightmaps separately, as `bake_coarse` does.
Errors come from the step along the rays, from the step to the lights, and from interpolation on the lattice that stores
optical depths to the lights; `March` sets these three sizes.
"""

from dataclasses import dataclass, replace

import torch

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.lightmaps import SixWay, StepError
from wlm.smoke.march.launch import in_bricks, run
from wlm.smoke.scene import Looks
from wlm_kernels.smoke import march_six, marches
from wlm_kernels.smoke.settings import March

_SURFACE = March(step=1.0, jitter=0.0)  # march for the depth at which obstacles and their shadows are drawn
_STEPS = 130  # steps through the box of `coarse_march`
_TRANSPARENCY, _EMISSION = (marches.PLANES.index(name) for name in ("transparency", "emission"))


def bake(
    volume: DensityVolume,
    camera: Camera,
    *,
    step: float = 0.5,
    g: float = 0.0,
    supersample: int = 1,
    estimate: bool = True,
) -> SixWay:
    """Computes the lightmaps, the transparency and, for hot smoke, the emission (eq. 4).

    Args:
        volume: The smoke.
        camera: Orthographic. Smoke behind its plane or outside the image is not visible but casts shadows.
        step: Longest step, in voxels, along rays and to the lights. Steps are shorter where the smoke is dense and
            its density changes: a step of 0.5 gives a PSNR of 60 dB and more at extinctions up to 100 per voxel.
        g: Mean cosine of the Henyey-Greenstein phase function, between -1 and 1.
        supersample: Number n of rays along a pixel's edge, whose n x n results are averaged; 1: only the centre.
        estimate: Whether to estimate the error by a second march with twice the step, which adds half of the work.
            Transparencies below 1e-7 are not resolved.

    Returns:
        The lightmaps on the smoke's device.

    Raises:
        ValueError: A setting is out of its range, or the camera is in perspective.
    """
    if supersample < 1:
        raise ValueError(f"supersample: expected at least 1 ray along a pixel's edge, got {supersample}")
    volume = in_bricks(volume)
    with stream(device_name(volume.device)):
        fine = _planes(volume, camera, March(step=step, g=g), supersample)
        error = None
        if estimate:
            coarse = _planes(volume, camera, March(step=2.0 * step, g=g), supersample)
            difference = (fine - coarse).double()
            energy = float(fine[:6].double().square().mean())
            error = StepError(
                float(difference[:6].abs().max()),
                (float(difference[:6].square().mean()) / energy) ** 0.5 if energy > 0 else 0.0,
                float(difference[march_six.TRANSPARENCY].abs().max()),
            )
    hot = fine[march_six.EMISSION] if volume.temperature is not None else None
    return SixWay(fine[:6], fine[march_six.TRANSPARENCY], hot, camera, None, error, f"fine march, step {step:g}")


def _planes(volume: DensityVolume, camera: Camera, march: March, supersample: int) -> torch.Tensor:
    out = run(march_six.six_way, volume, camera.finer(supersample), (8,), march)
    return out if supersample == 1 else torch.nn.functional.avg_pool2d(out[None], supersample)[0]


def bake_coarse(volume: DensityVolume, camera: Camera, march: March = March()) -> SixWay:
    """Computes six-way lightmaps by one march in large steps.

    Args:
        volume: The smoke.
        camera: Orthographic.
        march: Settings. Nodes of the lattice that stores optical depths to the lights are at least a quarter of a voxel
            apart, and farther apart if there would be more than 2^28 nodes; a node takes 32 bytes. There are 64
            different seeds of the jitter, which is gradient noise.

    Returns:
        Lightmaps, transparency, emission of hot smoke, and depth, on the smoke's device.

    Raises:
        ValueError: The camera is in perspective.
    """
    planes = march_planes(volume, camera, march)
    hot = planes[_EMISSION] if volume.temperature is not None else None
    light, method = planes[: len(DIRECTIONS)], f"coarse march, step {march.step:.3g}"
    return SixWay(light, planes[_TRANSPARENCY], hot, camera, planes[marches.DEPTH], method=method)


def coarse_march(volume: DensityVolume, seed: int = 0) -> March:
    """Returns settings of a march in steps of 1/130 of the smoke's longest edge, but at least of a quarter of a voxel,
    or on a CPU of a voxel: finer ones take longer than `bake` there. `seed` is that of the jitter."""
    return March(max(max(volume.shape) / _STEPS, 1.0 if volume.device.type == "cpu" else 0.25), seed=seed)


def march_planes(volume: DensityVolume, camera: Camera, march: March) -> torch.Tensor:
    """Returns the result of `bake_coarse` as one tensor, float32 [9, H, W], see `wlm_kernels.smoke.marches.PLANES`."""
    return run(marches.coarse_six_way, volume, camera, (len(marches.PLANES),), march)


@dataclass(frozen=True, eq=False)
class Guide:
    """A guiding map of H x W pixels (algorithm 1): a cheap picture of smoke, from which a network predicts lightmaps.

    Attributes:
        maps: float32 tensor [3, H, W] on the smoke's device: light, transparency and depth.
        camera: The camera that sees them.
        light: Light scattered to the camera from three lights of irradiance 4 pi: at the front, top and bottom, [H, W].
        transparency: Transparency of the smoke, 0 to 1, [H, W]: 1 where there is no smoke.
        depth: Distance along the ray to the smoke in world units, [H, W]: 0 where there is no smoke.
    """

    maps: torch.Tensor
    camera: Camera

    light = property(lambda self: self.maps[0])
    transparency = property(lambda self: self.maps[1])
    depth = property(lambda self: self.maps[2])


def guide(volume: DensityVolume, camera: Camera, march: March = March(), *, shared: bool = True) -> Guide:
    """Computes a guiding map by a march in large steps (algorithm 1).

    Args:
        volume: The smoke.
        camera: Orthographic or in perspective. If it is inside the smoke, the light from the front starts there.
        march: Settings without `spacing`, which is the step.
        shared: Whether pixels share the marches to the lights, on a lattice with a node per step, which is much faster;
            light is then interpolated between nodes.

    Returns:
        The maps, on the smoke's device.

    Raises:
        ValueError: The march has a spacing.
    """
    if march.spacing is not None:
        raise ValueError(f"spacing: expected None, since a guiding map uses the step, got {march.spacing}")
    return Guide(run(marches.guide, volume, camera, (3,), march, shared=shared), camera)


def with_surface(six: SixWay, volume: DensityVolume, looks: Looks | None) -> SixWay:
    """Returns lightmaps with the depth of the smoke's surface if `looks` has obstacles, else without a depth."""
    obstacles = looks is not None and looks.obstacles
    return replace(six, depth=run(marches.unlit, volume, six.camera, (3,), _SURFACE)[2] if obstacles else None)
