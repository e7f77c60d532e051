"""Probes as little spheres at their places, each shaded by its own light: what went in, what came out, the error."""

import math
import os
from typing import Literal

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.probe.sphere import irradiance, radiance, sh_count
from wlm.view.display import Display
from wlm.view.rendering import import_pyvista, require_opengl

MAX_PROBES = 4096  # more of them overlap in a picture's 600 pixels, and take seconds without a GPU
_SEED = 0  # of the choice among more

# A sphere of few probes is large and needs a round outline: probes, then subdivisions of an icosahedron, which give
# 642, 162 and 42 vertices.
_SUBDIVISIONS = ((64, 3), (1024, 2), (MAX_PROBES, 1))
_SMALLEST_RADIUS = 1 / 250  # of the box's diagonal: one probe far off must not shrink the others to nothing
_RADIUS_RANGE = 1e-6, 1e6  # of the box's longest side; float32 tells no more apart
_WHITE_PERCENTILE = 99.5  # as in `wlm.view.sheet`
# From where the box is seen, y up: half from above, so that the sides of the spheres show what their tops do.
_VIEW = (1.0, 0.8, 1.0)
_LARGEST_ASPECT = 1.6  # of a panel, either way
_MARGIN = 1.05
_BACKGROUND = "#808080"  # neither light nor dark probes vanish in it
_TITLE_PIXELS = 44
_FONT_SIZE = 11


def render_probes(
    path: str | os.PathLike[str],
    position: np.ndarray,
    original: np.ndarray,
    decoded: np.ndarray,
    *,
    up: Literal["y", "z"] = "y",
    radius: float | None = None,
    shade: Literal["irradiance", "radiance"] = "irradiance",
    width: int = 1800,
    error_gain: float = 8.0,
) -> int:
    """Writes a PNG of probes: original, decoded and their absolute difference times a gain, side by side.

    A point of a sphere shows the light of its normal: irradiance / pi, which is what a white diffuse surface shows, or
    the radiance that arrives from there. All three pictures share one exposure: the original's 99.5 percentile is
    white, what is negative is black, and light is encoded as sRGB. The difference is taken before that.

    The view is parallel, from above and from between two axes, along (-1, -0.8, -1) with y up and (-1, 1, -0.8) with z
    up, in right-handed axes; probes from an engine with left-handed ones appear mirrored. It holds all probes drawn.
    Of more than `MAX_PROBES` so many are drawn, chosen at random with a fixed seed, and the title says so. Probes
    without light are black and may hide others: pass the live ones alone.

    Rendering is VTK's, on the GPU or in software, and needs no screen, but it does need an OpenGL library of the
    system: EGL or OSMesa.

    Args:
        path: The PNG to write, whole or not at all; its folder must exist.
        position: [N, 3], in any unit.
        original: [N, D], D = 3 C, SH radiance in the convention of `wlm.probe.sphere`, RGB last.
        decoded: [N, D].
        up: The axis that points up.
        radius: Of the spheres, in the unit of the positions; None takes half of the median distance to the nearest
            other probe, but no less than 1/250 of the box's diagonal.
        shade: What the spheres show.
        width: Of the picture, 300 to 7680 pixels; its height follows the box's shape.
        error_gain: What the difference is multiplied by.

    Returns:
        The number of probes drawn.

    Raises:
        WlmError: Shapes differ, there is no probe, D is not 3 (l + 1)², a number is NaN or infinite, an argument is
            out of range, pyvista is missing, VTK finds no OpenGL, or the file cannot be written.
    """
    position = np.asarray(position, np.float64)
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused as that
        original, decoded = (np.asarray(array).astype(np.float32) for array in (original, decoded))
    _check(position, original, decoded, up, radius, shade, width, error_gain)
    total = len(position)
    if total > MAX_PROBES:
        chosen = np.sort(np.random.default_rng(_SEED).choice(total, MAX_PROBES, replace=False))
        position, original, decoded = position[chosen], original[chosen], decoded[chosen]
    pyvista = import_pyvista("spheres")
    place, size = _normalise(position, radius)
    sphere = pyvista.Icosphere(nsub=next(level for most, level in _SUBDIVISIONS if len(place) <= most))
    normals = sphere.points / np.linalg.norm(sphere.points, axis=1, keepdims=True)
    pictures = _shade(original, decoded, normals, shade, error_gain)
    # One mesh of all spheres: thousands of actors would take minutes.
    points = (place[:, None] + size * normals).reshape(-1, 3)
    corners = sphere.regular_faces + len(normals) * np.arange(len(place))[:, None, None]
    mesh = pyvista.PolyData.from_regular_faces(points, corners.reshape(-1, 3))
    which = "original" if total == len(place) else f"original, {len(place):,} of {total:,} probes"
    titles = (which, "decoded", f"error × {error_gain:g}")
    image = _render(pyvista, mesh, points, pictures, titles, up, width)
    with atomic_path(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG")
    return len(place)


def _check(position, original, decoded, up, radius, shade, width, error_gain) -> None:
    if position.ndim != 2 or position.shape[1] != 3 or len(position) == 0:
        raise WlmError(f"spheres: expected positions [N, 3] of at least one probe, got {position.shape}")
    if original.ndim != 2 or original.shape != decoded.shape or len(original) != len(position):
        raise WlmError(
            f"spheres: expected {len(position)} original and decoded probes [N, D] of one shape, got "
            f"{original.shape} and {decoded.shape}"
        )
    if sh_count(original.shape[1]) is None:
        raise WlmError(f"spheres: expected probes of 3, 12, 27, ... SH coefficients in RGB, got {original.shape[1]}")
    for label, array in (("position", position), ("original", original), ("decoded", decoded)):
        broken = ~np.isfinite(array).all(axis=1)
        if broken.any():
            raise WlmError(f"spheres: the {label} of probe {int(np.argmax(broken))} is NaN or infinite")
    with np.errstate(over="ignore"):
        if not np.isfinite(np.ptp(position, axis=0)).all():
            raise WlmError("spheres: the positions span more than float64 holds")
    for label, value, choices in (("up", up, ("y", "z")), ("shade", shade, ("irradiance", "radiance"))):
        if value not in choices:
            raise WlmError(f"spheres: {label}: expected {' or '.join(choices)}, got {value!r}")
    for label, value in (("radius", radius), ("error_gain", error_gain)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise WlmError(f"spheres: {label}: expected a finite number above 0, got {value}")
    if not 300 <= width <= 7680:
        raise WlmError(f"spheres: width: expected 300 to 7680 pixels, got {width}")


def _normalise(position: np.ndarray, radius: float | None) -> tuple[np.ndarray, float]:
    """Moves probes [n, 3] about the origin and scales them so that VTK's float32 holds them; and their radius."""
    low, high = position.min(0), position.max(0)
    scale = float(np.max(high - low))
    if scale == 0.0:
        return np.zeros_like(position), 1.0  # one place: a sphere of any radius fills the picture
    place = (position - (low + 0.5 * (high - low))) / scale
    if radius is not None:
        return place, min(max(radius / scale, _RADIUS_RANGE[0]), _RADIUS_RANGE[1])
    nearest = cKDTree(place).query(place, k=2)[0][:, 1]
    spread = np.linalg.norm((high - low) / scale)
    # Coincident probes tell nothing about the distance of the others.
    return place, max(0.5 * float(np.median(nearest[nearest > 0])), _SMALLEST_RADIUS * spread)


def _shade(
    original: np.ndarray, decoded: np.ndarray, normals: np.ndarray, shade: str, gain: float
) -> tuple[np.ndarray, ...]:
    """The colours of the vertices in the three pictures, uint8 [n * V, 3] each."""
    light = []
    for values in (original, decoded):
        coefficients = values.reshape(len(values), -1, 3)
        if shade == "irradiance":
            light.append(irradiance(coefficients, normals) / math.pi)
        else:
            light.append(radiance(coefficients, normals))
    white = float(np.percentile(light[0], _WHITE_PERCENTILE))
    if white <= 0:
        white = max(float(light[0].max()), 0.0) or 1.0  # all dark, or nearly: one lamp still shows
    display = Display(1.0 / white)
    error = np.abs(light[1] - light[0]) * gain
    return tuple(display.picture(picture).reshape(-1, 3) for picture in (*light, error))


def _camera(points: np.ndarray, up: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Towards the eye, upwards in the picture, the middle of the points, and their half width and half height."""
    x, y, z = _VIEW
    eye = np.array([x, y, z] if up == "y" else [x, -z, y])
    eye /= np.linalg.norm(eye)
    above = np.array([0.0, 1.0, 0.0] if up == "y" else [0.0, 0.0, 1.0])
    above -= (above @ eye) * eye
    above /= np.linalg.norm(above)
    plane = points @ np.stack([np.cross(above, eye), above], axis=1)
    low, high = plane.min(0), plane.max(0)
    middle = 0.5 * (low + high)
    return eye, above, middle[0] * np.cross(above, eye) + middle[1] * above, 0.5 * (high - low)


def _render(pyvista, mesh, points, pictures, titles, up, width) -> np.ndarray:
    """Three panels of one mesh, uint8 [H, W, 3]."""
    require_opengl("spheres")
    eye, above, middle, half = _camera(points, up)
    panel = width / len(pictures)
    aspect = min(max(half[1] / half[0], 1 / _LARGEST_ASPECT), _LARGEST_ASPECT)
    tall = round(panel * aspect)
    # Half the height of a panel in the mesh's unit; the strip of the title lies above the spheres.
    reach = _MARGIN * max(half[1], half[0] * tall / panel)
    strip = reach * _TITLE_PIXELS / tall
    focus = middle + strip * above
    # Messages about a missing display would alarm for nothing: rendering is off screen.
    with pyvista.vtk_verbosity("off"):
        plotter = pyvista.Plotter(
            shape=(1, len(pictures)),
            off_screen=True,
            border=False,
            window_size=(width, tall + _TITLE_PIXELS),
        )
        try:
            plotter.set_background(_BACKGROUND)
            for column, (colours, title) in enumerate(zip(pictures, titles, strict=True)):
                plotter.subplot(0, column)
                plotter.add_mesh(mesh.copy(), scalars=colours, rgb=True, lighting=False)
                plotter.add_text(title, position="upper_edge", font_size=_FONT_SIZE, color="white")
                camera = plotter.camera
                camera.parallel_projection = True
                camera.focal_point, camera.position, camera.up = focus, focus + 4.0 * eye, above
                camera.parallel_scale = reach + strip
                plotter.renderer.ResetCameraClippingRange()
            plotter.enable_anti_aliasing("ssaa", all_renderers=True)
            return plotter.screenshot(return_img=True)
        finally:
            plotter.close()
