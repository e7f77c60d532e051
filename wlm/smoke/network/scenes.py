"""Random scenes: jets, plumes, flames and bursts past obstacles (neural-six-way-lightmaps, section 5).

The paper has 14 jets past cylinders. A scene here is a jet, a plume, a flame or a burst, in a box of 1 m in which the
fastest air moves at 1 m/s, so that it crosses the box in a second.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from wlm.fluid.solver import LEAST_HALF_LOSS
from wlm.smoke.network.settings import EDGE, LATTICE_SPEED, SPEED, DatasetSettings
from wlm.smoke.scene import Air, Grid, Inlet, ObstacleSettings, Scene, Smoke, SourceSettings

# Viscosity in m^2/s: at the low end the turbulence model dominates, at the high end the smoke is smooth.
_VISCOSITY = (1.5e-5, 6e-4)
_RADIUS = (0.055, 0.14)  # radii of inlets and spheres; at least a cell of the coarsest grid
_CYLINDERS, _SPHERES = 0.65, 0.85  # cumulative probabilities of the obstacles' shapes; the rest are boxes
# A moving obstacle is at most as fast as the air; a faster one would empty the box.
_CROSSING = (0.9, 1.6)  # seconds in which it crosses the box


def generator(validation: bool, *numbers: int) -> np.random.Generator:
    """Returns a random generator seeded by the numbers; validation and training never share a generator."""
    return np.random.default_rng([int(validation), *numbers])


def draw_scene(settings: DatasetSettings, seed: int, index: int, *, validation: bool = False) -> Scene:
    """Draws random scene number `index` of a set with a seed; frames are as far apart in time as the two frames of a
    pair. Sets for validation are not used in training."""
    random = generator(validation, seed, index, 0)
    if random.random() < settings.hot:
        kind = "burst" if random.random() < 0.6 else "flame"
    else:
        kind = "jet" if random.random() < 0.7 else "plume"
    parts: dict[str, Any] = {"jet": _jet, "plume": _plume, "flame": _flame, "burst": _burst}[kind](random)
    obstacles = [_obstacle(random) for _ in range(random.integers(kind == "jet", 3 if parts["hot"] else 4))]
    if obstacles and random.random() < settings.moving:
        obstacles[0] = _moving(random, obstacles[0], settings.warmup)
    cell = EDGE / settings.cells
    rate = 1.0 / (settings.steps * LATTICE_SPEED * cell / SPEED)
    lost = -np.expm1(-parts["smoke"].get("cooling", 0.0) * settings.substeps / (rate * settings.steps))
    return Scene(
        name=f"{kind} {'validation ' * validation}{seed}/{index}",
        grid=Grid(cells=(settings.cells,) * 3, cell=cell, refine=settings.refine, faces=parts["faces"]),
        air=Air(speed=SPEED, lattice_speed=LATTICE_SPEED, viscosity=_log(random, *_VISCOSITY)),
        smoke=Smoke(
            extinction=settings.extinction / EDGE,
            storage="float32" if 0.0 < lost < LEAST_HALF_LOSS else "float16",
            bricks=True,
            substeps=settings.substeps,
            **parts["smoke"],
            **({"emission": settings.extinction / EDGE * random.uniform(0.4, 1.6)} if parts["hot"] else {}),
        ),
        inlets=parts["inlets"],
        sources=parts["sources"],
        obstacles=tuple(obstacles),
        frames=settings.frames,
        rate=rate,
    )


def _log(random: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def _place(random: np.random.Generator, low: tuple, high: tuple) -> tuple[float, float, float]:
    return tuple(map(float, EDGE * random.uniform(low, high)))


def _jet(random: np.random.Generator) -> dict[str, Any]:
    """Returns scene settings of one or two jets from the floor, upright or leaning, sometimes with wind."""
    inlets = []
    for number in range(1 + (random.random() < 0.3)):
        speed = SPEED * (1.0 if number == 0 else random.uniform(0.5, 1.0))
        lean, around = np.radians(random.uniform(0.0, 28.0)), random.uniform(0.0, 2 * np.pi)
        # Leaning jets start off-centre, so that they lean into the box.
        back = -0.35 * np.tan(lean) * np.array([np.cos(around), 0.0, np.sin(around)])
        centre = np.array(_place(random, (0.38, 0.0, 0.38), (0.62, 0.0, 0.62))) + EDGE * back
        velocity = speed * np.array([np.sin(lean) * np.cos(around), np.cos(lean), np.sin(lean) * np.sin(around)])
        inlets.append(
            Inlet(
                face="-y",
                centre=tuple(map(float, centre)),
                radius=EDGE * _log(random, *_RADIUS),
                velocity=tuple(map(float, velocity)),
                density=random.uniform(0.6, 1.0),
            )
        )
    sides = ("-x", "+x", "-z", "+z")
    faces = {} if random.random() < 0.4 else dict.fromkeys(sides, "slip")
    if random.random() < 0.2:
        faces = {}
        inlets.append(Inlet(face="-x", velocity=(SPEED * random.uniform(0.1, 0.3), 0.0, 0.0), density=0.0))
    return {"inlets": tuple(inlets), "sources": (), "faces": faces, "smoke": {}, "hot": False}


def _flame(random: np.random.Generator) -> dict[str, Any]:
    parts = _jet(random)
    inlets = tuple(inlet.model_copy(update={"temperature": float(inlet.density > 0.0)}) for inlet in parts["inlets"])
    smoke = {"buoyancy": random.uniform(0.5, 2.0), "cooling": random.uniform(1.0, 3.0)}
    return parts | {"inlets": inlets, "smoke": smoke, "hot": True}


def _plume(random: np.random.Generator) -> dict[str, Any]:
    """Returns scene settings of a sphere of constant density and temperature, from which smoke rises."""
    sphere = SourceSettings(
        centre=_place(random, (0.35, 0.1, 0.35), (0.65, 0.16, 0.65)),
        radius=EDGE * _log(random, *_RADIUS),
        density=random.uniform(0.6, 1.0),
        temperature=1.0,
    )
    smoke = {"buoyancy": random.uniform(2.0, 4.0), "cooling": random.uniform(0.5, 1.0)}
    return {"inlets": (), "sources": (sphere,), "faces": {"-y": "wall"}, "smoke": smoke, "hot": False}


def _burst(random: np.random.Generator) -> dict[str, Any]:
    """Returns scene settings of spheres that emit hot smoke for a short time."""
    spheres = [
        SourceSettings(
            centre=_place(random, (0.32, 0.12, 0.32), (0.68, 0.3, 0.68)),
            radius=EDGE * random.uniform(0.08, 0.17),
            density=random.uniform(0.7, 1.0),
            temperature=random.uniform(0.7, 1.2),
            start=(start := float(number > 0) * random.uniform(0.0, 0.2)),
            stop=start + random.uniform(0.1, 0.35),
        )
        for number in range(random.integers(1, 4))
    ]
    smoke = {"buoyancy": random.uniform(3.0, 6.0), "cooling": random.uniform(0.5, 2.0)}
    return {"inlets": (), "sources": tuple(spheres), "faces": {"-y": "wall"}, "smoke": smoke, "hot": True}


def _obstacle(random: np.random.Generator) -> ObstacleSettings:
    kind = random.random()
    centre = _place(random, (0.28, 0.28, 0.28), (0.72, 0.7, 0.72))
    shape = "cylinder" if kind < _CYLINDERS else "sphere" if kind < _SPHERES else "box"
    radius: Any = EDGE * random.uniform(0.06, 0.13)
    if shape == "cylinder":
        radius = (radius, EDGE * random.uniform(0.15, 0.5), radius)
    elif shape == "box":
        radius = tuple(map(float, EDGE * random.uniform(0.05, 0.15, 3)))
    return ObstacleSettings(shape=shape, radius=radius, path=((0.0, *centre),), turn=tilted(random.normal(size=3)))


def tilted(axis: np.ndarray) -> tuple[tuple[float, float, float, float]]:
    """Returns the `turn` of an obstacle whose y axis has a direction, of any length except 0, in the world."""
    up = axis / np.linalg.norm(axis)
    right = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    right /= np.linalg.norm(right)
    turn = Rotation.from_matrix(np.stack([right, up, np.cross(right, up)], 1)).as_euler("xyz", degrees=True)
    return ((0.0, *map(float, turn)),)


def _moving(random: np.random.Generator, obstacle: ObstacleSettings, begin: float) -> ObstacleSettings:
    """Returns the obstacle with a path through the box; it moves after about the time `begin`, in box crossings."""
    _, *middle = obstacle.path[0]
    around = random.uniform(0.0, 2 * np.pi)
    half = 0.36 * EDGE * np.array([np.cos(around), 0.0, np.sin(around)])
    ends = [np.clip(np.array(middle) + way * half, 0.1 * EDGE, 0.9 * EDGE) for way in (-1.0, 1.0)]
    start = begin * EDGE / SPEED * random.uniform(0.4, 0.8)
    times = (start, start + random.uniform(*_CROSSING))
    path = tuple((float(t), *map(float, at)) for t, at in zip(times, ends, strict=True))
    return obstacle.model_copy(update={"path": path})
