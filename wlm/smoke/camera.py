"""Cameras, the directions of the six lightmaps, their weights under a light, and the texture channels of engines.

Directions are in the camera's axes: x to the right, y up, z from the smoke towards the camera. A lightmap is named
after the direction from which its light comes: "right" is brighter on the image's right side, "front" is lit from the
camera's side and "back" from behind the smoke. A light's direction points from the smoke to the light. Images have row
0 at the top.

Unity's local z axis points away from the viewer: a light behind the smoke has a positive z in Unity and a negative z
here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm_kernels.smoke.march import View, make_view

DIRECTIONS = ("right", "left", "top", "bottom", "front", "back")
"""The order of the lightmaps in all arrays."""

VECTORS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
"""Direction to the light of each lightmap, in the camera's axes."""

ALPHA, EMISSION = "alpha", "emission"
"""Channels of a file other than the lightmaps; alpha is opacity, 1 - transparency."""

LAYOUTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "unity": (("right", "top", "back", ALPHA), ("left", "bottom", "front", EMISSION)),
    "o3de": (("right", "left", "top", ALPHA), ("bottom", "back", "front", EMISSION)),
    "o3de-tlrb": (("top", "left", "right", "bottom"), ("front", "back", EMISSION, ALPHA)),
    "embergen": (("top", "left", "right", ALPHA), ("bottom", "back", "front", EMISSION)),
}
"""Channels R, G, B, A of an engine's two textures. O3DE reads opacity from a third texture, which may be this alpha."""

RULES = ("squared", "absolute", "normalised")
"""Rules for the weight of lightmap p under a light from w: w_p^2; |w_p|, the paper's eq. 5; |w_p| / (|w_x| + |w_y| +
|w_z|)."""

_SHORTEST = 1e-12
_MARGIN = 1.05  # image height over box height, so that no smoke touches the edge


def unit(vector: Sequence[float] | np.ndarray, name: str = "toward") -> np.ndarray:
    """Returns a direction scaled to length 1, float64 [3]."""
    vector = np.asarray(vector, np.float64)
    length = np.linalg.norm(vector)
    if vector.shape != (3,) or not _SHORTEST < length < np.inf:
        raise ValueError(f"{name}: expected three finite numbers that are not all 0, got {vector.tolist()}")
    return vector / length


def weights(toward: Sequence[float] | np.ndarray, rule: str = "squared") -> np.ndarray:
    """Returns the weights of the lightmaps, float64 [..., 6] in the order of `DIRECTIONS`, under lights from directions
    [..., 3] in the camera's axes, of any length except 0, by one of `RULES`.

    The paper's weights (eq. 5) are the absolute components of the unit direction; their sum is up to 1.73, for a light
    along a diagonal. Their squares, which engines use, always sum to 1.
    """
    if rule not in RULES:
        raise ValueError(f"rule: expected one of {', '.join(RULES)}, got {rule!r}")
    toward = np.asarray(toward, np.float64)
    length = np.linalg.norm(toward, axis=-1, keepdims=True)
    if toward.shape[-1:] != (3,) or not (np.isfinite(length) & (length > _SHORTEST)).all():
        raise ValueError(f"toward: expected finite directions [..., 3], none of them 0, got {toward.tolist()}")
    along = np.maximum((toward / length) @ VECTORS.T, 0.0)
    if rule == "squared":
        return along**2
    return along / along.sum(-1, keepdims=True) if rule == "normalised" else along


@dataclass(frozen=True)
class Camera:
    """An orthographic or perspective camera.

    Attributes:
        position: In world units: the eye of a perspective camera, or the image centre of an orthographic one. Smoke
            behind it is not visible.
        right, up, toward: The image's axes in the world, orthogonal and of length 1; toward, the cross product of
            right and up, points from the smoke to the camera.
        extent: Height in world units of the region that the image shows; in perspective, at distance 1 from the eye.
        height, width: Size of the image in pixels; pixels are square.
        perspective: Whether all rays start at the eye; six-way lightmaps are always orthographic.
    """

    position: tuple[float, float, float]
    right: tuple[float, float, float]
    up: tuple[float, float, float]
    toward: tuple[float, float, float]
    extent: float
    height: int
    width: int
    perspective: bool = False

    def __post_init__(self) -> None:
        axes = self.axes
        if axes.shape != (3, 3) or not np.allclose(axes @ axes.T, np.eye(3), atol=1e-5):
            raise ValueError(f"right, up, toward: expected orthogonal directions of length 1, got {axes.tolist()}")
        if np.linalg.det(axes) < 0:
            raise ValueError("toward: expected the cross product of right and up, got the opposite direction")
        if np.shape(self.position) != (3,) or not np.isfinite(self.position).all():
            raise ValueError(f"position: expected three finite numbers, got {self.position}")
        if not 0 < self.extent < np.inf:
            raise ValueError(f"extent: expected a length above 0, got {self.extent}")
        if self.height < 1 or self.width < 1:
            raise ValueError(f"height, width: expected at least 1 pixel, got {self.height}, {self.width}")

    @staticmethod
    def look_at(
        position: Sequence[float],
        target: Sequence[float],
        *,
        extent: float,
        height: int,
        width: int,
        world_up: Sequence[float] = (0.0, 1.0, 0.0),
        perspective: bool = False,
    ) -> "Camera":
        """Makes a camera that looks from a position to a target.

        `world_up` is upwards in the image; if the camera looks along it, an axis of the world is used instead.

        Raises:
            ValueError: The position equals the target, or a size is wrong.
        """
        toward = np.asarray(position, np.float64) - np.asarray(target, np.float64)
        length = np.linalg.norm(toward)
        if not _SHORTEST < length < np.inf:
            raise ValueError(f"position: expected another point than the target {tuple(target)}, got {tuple(position)}")
        toward = toward / length
        right = np.cross(world_up, toward)
        if np.linalg.norm(right) < 1e-6 * max(np.linalg.norm(world_up), 1e-300):
            right = np.cross(np.eye(3)[np.argmin(np.abs(toward))], toward)
        right = right / np.linalg.norm(right)
        up = np.cross(toward, right)
        axes = (tuple(map(float, axis)) for axis in (position, right, up, toward))
        return Camera(*axes, float(extent), height, width, perspective)

    @staticmethod
    def around(
        smoke: DensityVolume | tuple[Sequence[float], Sequence[float]],
        *,
        toward: Sequence[float] = (0.0, 0.0, 1.0),
        pixels: int = 512,
        aspect: float = 1.0,
        target: Sequence[float] | None = None,
        extent: float | None = None,
        distance: float | None = None,
        up: Sequence[float] = (0.0, 1.0, 0.0),
        perspective: bool = False,
    ) -> "Camera":
        """Makes a camera that shows a whole volume of smoke from outside.

        Args:
            smoke: A volume, or a box in the world: its corner [3] and its edges [3].
            toward: Direction from the smoke to the camera, of any length except 0.
            pixels: Height of the image in pixels.
            aspect: Width of the image divided by its height.
            target: Point in the middle of the image; None: the box's centre.
            extent: As in `Camera`; None: large enough that the image shows the whole box.
            distance: Distance in world units from the camera to the target; None: far enough to be outside the box.
            up: Direction in the world that is upwards in the image.
            perspective: Whether all rays start at the eye; six-way lightmaps are always orthographic.

        Raises:
            ValueError: A direction has length 0, or a size is not above 0.
            WlmError: Numbers of float64 cannot tell the eye from the target.
        """
        if isinstance(smoke, DensityVolume):
            smoke = (smoke.origin, smoke.voxel * np.asarray(smoke.shape))
        origin, size = (np.asarray(part, np.float64) for part in smoke)
        target = origin + 0.5 * size if target is None else np.asarray(target, np.float64)
        toward = unit(toward)
        corners = origin + size * np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)]) - target
        nearest = float((corners @ toward).max())
        if distance is None:
            # At least as far away as the box is large, which avoids an extreme perspective.
            distance = nearest + float(np.linalg.norm(size))
        if not np.linalg.norm((target + distance * toward) - target) > _SHORTEST:
            raise WlmError(
                f"camera: the smoke is too small, or too far from 0 for its size: {size} at {origin}, or the distance "
                f"to the target is too short: {distance:.3g}"
            )
        width = max(round(pixels * aspect), 1)
        shape = {"height": pixels, "width": width, "world_up": up, "perspective": perspective}
        camera = Camera.look_at(target + distance * toward, target, extent=1.0 if extent is None else extent, **shape)
        if extent is not None:
            return camera
        across, rise, _ = np.abs(corners @ camera.axes.T).max(axis=0)
        extent = 2.0 * _MARGIN * max(float(rise), float(across) * pixels / width)
        if perspective:
            # At the distance of the box's nearest side, or of its centre if the camera is inside.
            extent /= distance - nearest if distance > nearest else distance
        return replace(camera, extent=extent)

    @property
    def axes(self) -> np.ndarray:
        """Rotation matrix from the world to the camera's axes, float64 [3, 3], with the rows right, up and toward."""
        return np.array([self.right, self.up, self.toward], np.float64)

    @property
    def pitch(self) -> float:
        """Edge of a pixel in world units; for a perspective camera, at distance 1 from the eye."""
        return self.extent / self.height

    def finer(self, factor: int) -> "Camera":
        """Returns the same view with each pixel divided into factor x factor pixels."""
        return replace(self, height=self.height * factor, width=self.width * factor)

    def in_world(self) -> View:
        """Returns the camera in the world's unit and axes, with its position as the origin, for kernels."""
        right, up, toward = self.axes
        return make_view(np.zeros(3), right, up, -toward, self.pitch, self.width, self.height, self.perspective)

    def view(self, volume: DensityVolume) -> View:
        """Returns the camera in the voxel coordinates of a volume, as the structure that ray march kernels take.

        An orthographic camera far from the volume is moved along its axis to just in front of the volume, which reduces
        rounding errors and changes nothing else.
        """
        position = (np.asarray(self.position, np.float64) - np.asarray(volume.origin, np.float64)) / volume.voxel
        right, up, toward = self.axes
        moved, pitch = 0.0, self.pitch
        if not self.perspective:
            ends = (-0.5 - position, np.asarray(volume.shape) + 0.5 - position)
            moved = max(float(sum(min(-a * t, -b * t) for a, b, t in zip(*ends, toward, strict=True))) - 1.0, 0.0)
            position = position - moved * toward
            pitch = self.pitch / volume.voxel
        size = (self.width, self.height)
        return make_view(position, right, up, -toward, pitch, *size, self.perspective, volume.voxel, moved)
