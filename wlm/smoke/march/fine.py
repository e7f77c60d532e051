"""Six-way lightmaps of smoke by a fine march: single scattering without noise, with an estimate of its error.

The paper's references are single scattering by path tracing with 512 samples per pixel (section 5). Single scattering
is an integral, which is computed here by quadrature. The camera must be orthographic.
"""

import torch

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream
from wlm.smoke.camera import Camera
from wlm.smoke.lightmaps import SixWay, StepError
from wlm.smoke.march.launch import run
from wlm_kernels.smoke import march_six
from wlm_kernels.smoke.settings import March


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
        step: Longest step, in voxels, along rays and to the lights. Samples lie in the middles of the steps.
        g: Mean cosine of the Henyey-Greenstein phase function, between -1 and 1.
        supersample: Number n of rays along a pixel's edge, whose n x n results are averaged; 1: only the centre.
        estimate: Whether to estimate the error by a second march with twice the step, which adds half of the work.

    Returns:
        The lightmaps on the smoke's device.

    Raises:
        ValueError: A setting is out of its range, or the camera is in perspective.
    """
    if supersample < 1:
        raise ValueError(f"supersample: expected at least 1 ray along a pixel's edge, got {supersample}")
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
    return SixWay(fine[:6], fine[march_six.TRANSPARENCY], hot, camera, error=error)


def _planes(volume: DensityVolume, camera: Camera, march: March, supersample: int) -> torch.Tensor:
    """Returns the six lightmaps, the transparency and the emission, [8, H, W]."""
    out = run(march_six.six_way, volume, camera.finer(supersample), (8,), march)
    return out if supersample == 1 else torch.nn.functional.avg_pool2d(out[None], supersample)[0]
