"""The viewer: one HTML page that opens compressed files in the browser, without Python."""

import os
from importlib import resources

from wlm.atlas.model import Profile as AtlasProfile
from wlm.export.engines.kit import filled
from wlm.export.page.html import Page, asset
from wlm.lightmap.profile import Profile as LightmapProfile
from wlm.probe.model import Profile as ProbeProfile
from wlm_kernels.probe.components import GROUP

_SCRIPTS = (
    *("zstd.js", "digest.js", "artifact.js", "mesh.js", "shaders.js", "open_lightmap.js", "open_atlas.js"),
    *("open_probe.js", "open_smoke.js", "lightmap.js", "atlas.js", "probe.js", "smoke.js"),
)
_TEMPLATES = {
    "lightmap": "wlm.lightmap",
    "atlas": "wlm.atlas",
    "gaussian": "wlm.probe.gaussian",
    "pca": "wlm.probe.pca",
    "page": "wlm.export.page",
}
_NOTE = (
    "Drop a .wlm file of lightmaps, of a mesh's lightmap or of light probes here, with its mesh (.glb) if you like; or "
    "six-way lightmaps of smoke (.exr, one a frame). Nothing leaves this computer."
)


def write_viewer(path: str | os.PathLike[str]) -> int:
    """Writes an HTML page that opens files in a browser, and returns its size in bytes.

    It reads `.wlm` files of lightmaps over time, of one lightmap of a mesh and of light probes of one region, and EXR
    files of six-way lightmaps, and makes the pages of `write_page` from them, without an original.

    Args:
        path: The page, `.html`; its folder must exist.

    Raises:
        WlmError: The page cannot be written.
    """
    templates = {
        name: {
            each.name: each.read_text(encoding="utf-8")
            for each in sorted((resources.files(package) / "assets").iterdir(), key=lambda each: each.name)
            if each.name.endswith(".glsl")
        }
        for name, package in _TEMPLATES.items()
    }
    profiles = {"lightmap": LightmapProfile, "atlas": AtlasProfile, "probe": ProbeProfile}
    defaults = {name: profile(name="").model_dump() for name, profile in profiles.items()}
    scripts = [filled("lightmap_table.js").rstrip("\n"), *map(asset, _SCRIPTS)]
    manifest = {"templates": templates, "defaults": defaults, "group": int(GROUP)}
    return Page("viewer", "wlm viewer", _NOTE, [], manifest, {}, scripts).write(path)
