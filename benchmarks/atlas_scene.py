"""A scene of many objects and states against its parts, each object and state alone, in as many bits.

Rows of method "scene", one for each profile: the file, the compression with its stages, and the error in views of the
whole scene. After each a row of method "parts", `benchmarks.rivals.scene_parts` in the same bits or few more, by
`standard` of one lightmap with the same textures.

"gain" is what the scene's mean over views and states is above the parts'; "least gain" that of the state in which it
is least.
"""

from collections.abc import Sequence

import numpy as np

from benchmarks.rivals.scene_parts import scene_parts
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from wlm import interop
from wlm.atlas.codec import sizes
from wlm.atlas.data import LightmappedScene, from_arrays
from wlm.atlas.evaluation import SHARED_RESOLUTION, SHARED_VIEWS, Sampler, compare
from wlm.atlas.fit import compress
from wlm.atlas.model import Profile
from wlm.atlas.shared.weights import peaks_of, scene_weights, variation

PROFILES = ("standard",)
"""Profiles of a run."""

_SEED = 1  # seed of the views of the parts' weights


def run(
    scene: LightmappedScene,
    names: Sequence[str] = (),
    *,
    budget: float | None = None,
    device: str,
    parts: bool = True,
    views: int = SHARED_VIEWS,
    resolution: int = SHARED_RESOLUTION,
    progress: Note | None = None,
) -> list[Row]:
    """Measures a scene against its parts.

    Args:
        scene: The scene, as `benchmarks.scene_inputs.load` cuts it.
        names: Profiles; none: `PROFILES`.
        budget: The budget in place of the profiles'.
        device: "cpu" or "cuda:0".
        parts: With the parts, which take most of the time.
        views: Cameras around the scene, and as many from inside.
        resolution: Pixels along a side.
        progress: Called with a line before each part of the work.

    Returns:
        The rows, profile by profile.

    Raises:
        WlmError: A profile or the device isn't there, or the budget is less than the smallest model takes.
    """
    profiles = [Profile.load(name) for name in names or PROFILES]
    if budget is not None:
        profiles = [profile.override({"budget": budget}) for profile in profiles]
    title = f"{scene.name}, {len(scene.sheets)} objects, {len(scene.states)} states"
    bench = _SceneBench(title, scene, interop.check_device(device), (views, resolution), progress)
    rows = []
    for profile in profiles:
        rows += bench.rows(profile, parts)
    return rows


class _SceneBench(Bench):
    """A scene, and the views in which it is scored."""

    def __init__(
        self, title: str, scene: LightmappedScene, device: str, views: tuple[int, int], progress: Note | None
    ) -> None:
        super().__init__("atlas", device, progress, scene=title)
        self._scene, self._views = scene, dict(zip(("views", "resolution"), views, strict=True))
        self._varies = variation(scene, peaks_of(scene), device)

    def rows(self, profile: Profile, parts: bool) -> list[Row]:
        """Measures the scene and its parts."""
        scene, device = self._scene, self.device
        self.note(f"{profile.name}: compiling")
        compress(_small(len(scene.states)), profile.override({"budget": 1.0, "views": 1}), device=device)
        self.note(f"{profile.name}: compressing")
        fit = self.fit(profile.name, lambda: compress(scene, profile, device=device))
        model = fit.model
        stages = {f"{name}_seconds": seconds for name, seconds in fit.fitted.report["seconds"].items()}
        decoders: dict[str, Sampler] = {"scene": model.decoder(device)}
        row = self.row(
            "scene",
            profile.name,
            "separate tiles of each state" if model.later else "tiles shared by the states",
            bytes=fit.bytes - sizes(model)[1],
            bpp=self._bpp(model.bits),
            compression_ratio=model.compression_ratio,
            encode_seconds=fit.seconds,
            lightmaps=len(scene.sheets) * len(scene.states),
            **stages,
        )
        rows = [row]
        if parts:
            self.note(f"{profile.name}: {len(scene.sheets) * len(scene.states)} parts")
            weights = scene_weights(scene, self._varies, profile, _SEED, device)
            alone = scene_parts(scene, weights, model.bits, profile.colour, device)
            decoders["parts"] = alone
            plain = sum(each.method == "plain" for of_sheet in alone.models for each in of_sheet)
            share = alone.bits / model.source_bits
            notes = f"each object and state alone, {plain} of them plain smaller lightmaps; no file"
            rows.append(
                self.row(
                    "parts", f"bits of {profile.name}", notes, bpp=self._bpp(alone.bits), compression_ratio=1.0 - share
                )
            )
        self.note("scoring")
        scores = compare(scene, decoders, device=device, **self._views)
        for number, name in enumerate(scores):
            figures = {each: getattr(scores[name], each) for each in ("psnr", "psnr_worst", "texel_psnr")}
            rows[number] = rows[number].with_figures(**figures)
        if parts:
            gains = np.subtract(*(scores[name].psnr_by_state for name in ("scene", "parts")))
            rows[0] = rows[0].with_figures(
                gain=scores["scene"].psnr - scores["parts"].psnr,
                gain_min=float(np.nanmin(gains)),
            )
        return rows

    def _bpp(self, bits: float) -> float:
        """Bits for each texel and state."""
        return bits / self._scene.texels


def _small(states: int) -> LightmappedScene:
    """Makes a square with a number of states, to compile with."""
    side = np.linspace(0.1, 1.0, 32)
    image = np.stack([np.outer(side, side), np.outer(side, side[::-1]), np.outer(side, side) ** 2], -1)
    uv = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    light = np.stack([image ** (1 + state) for state in range(max(states, 2))])
    return from_arrays(np.insert(uv, 2, 0.0, 1), np.array([[0, 1, 2], [2, 1, 3]]), uv, light, name="square")
