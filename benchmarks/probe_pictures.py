"""Fits to pictures of a mesh (`python -m benchmarks probe --mesh SCENE.glb`) beside fits to the probes alone.

Both fits are by Gaussians with the same profile, and of the same size. Rows "fit" have the time and the errors of the
probes; the other rows are the errors of pictures by viewers on a loop, whom no fit has seen, see `wlm.probe.views`.
"""

import time
from collections.abc import Callable, Sequence

from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from wlm.formats.geometry import Geometry
from wlm.probe.data import ProbeSet
from wlm.probe.evaluation import score
from wlm.probe.fit import compress
from wlm.probe.model import Profile
from wlm.probe.views import score_views

_VIEWS = 24
_WARM = 30  # steps of the fit that compiles kernels


def picture_rows(
    sets: Sequence[ProbeSet],
    profile: Profile,
    geometry: Geometry,
    *,
    device: str,
    views: int = _VIEWS,
    progress: Note | None = None,
    done: Callable[[Sequence[Row]], None] | None = None,
) -> list[Row]:
    """Measures fits to the probes alone and to pictures.

    Args:
        sets: The sets of probes, which light the mesh.
        profile: Settings of the fits.
        geometry: The mesh.
        device: "cpu" or "cuda:0".
        views: Number of viewers.
        progress: Called with a line before each part of the work.
        done: Called with all rows so far after each fit.
    """
    rows: list[Row] = []
    profile = profile.model_copy(update={"method": "gaussians"})
    for probes in sets:
        key = probes.key.removeprefix("sh").removeprefix("_")
        bench = Bench("probe", device, progress, scene=f"{probes.name} {key}".strip())
        for name, lit in (("plain fit", None), ("fit to pictures", geometry)):
            bench.note(name)
            compress(probes, profile.model_copy(update={"steps": _WARM}), device=device, geometry=lit)
            start = time.perf_counter()
            model = compress(probes, profile, device=device, geometry=lit)
            seconds = time.perf_counter() - start
            decoded = model.decoder(device, position=probes.position).decode_probes()
            errors = score(decoded, probes, model.content.nbytes)
            figures = {"psnr": errors.psnr, "relative_error": errors.relative_error, "encode_seconds": seconds}
            sizes = {"bytes": model.content.nbytes, "gaussians": model.content.count, "steps": profile.steps}
            rows.append(bench.row(name, "fit", f"profile {profile.name}", **figures, **sizes))
            for each in score_views(probes, decoded, geometry, views=views, device=device):
                shown = {"psnr": each.psnr, "ssim": each.ssim, "flip": each.flip}
                rows.append(bench.row(name, f"{each.drawn}, {each.light}", f"{each.views} views", **shown))
            if done is not None:
                done(rows)
    return rows
