"""Scenes of smoke drawn at random from a seed, at the ends of what a file may say: speeds, viscosities, thin things."""

from pathlib import Path

import numpy as np

from wlm.fluid.faces import FACES

FAN = Path(__file__).parents[2] / "configs" / "meshes" / "fan.ply"
SAIL = "v -1 0 -1\nv 1 0 -1\nv 0 .5 1\nv 2 1 2\nf 1 2 3\nf 2 3 4\n"
"""An OBJ file of two triangles, which bound no solid."""


def random_scene(seed: int, folder: Path) -> dict:
    """Draws a small scene in which every setting may be extreme, as its YAML file in a folder, where its mesh is."""
    (folder / "sail.obj").write_text(SAIL)
    random = np.random.default_rng([39, seed])
    pick, chance = random.choice, lambda share: bool(random.random() < share)
    cells = random.integers(1 if chance(0.1) else 4, 13, 3)
    cell = 10.0 ** random.uniform(-3, 1)
    size, speed = cell * cells, 10.0 ** random.uniform(-2, 2)
    origin = random.uniform(-1, 1, 3) * size

    def place(margin: float) -> np.ndarray:
        return origin + size * random.uniform(-margin, 1 + margin, 3)

    faces = {face: str(pick(["slip", "open"])) for face in FACES}
    if chance(0.3):
        faces |= dict.fromkeys(FACES if chance(0.3) else ("-y",), "wall")
    elif chance(0.3):
        faces |= {"-x": "periodic", "+x": "periodic"}
    inlets = []
    bounded = [face for face in FACES if faces[face] != "periodic"]
    opened, *others = random.permutation(bounded)
    if chance(0.8):
        faces[str(opened)] = "open"
    for face in others[: random.integers(0, 3)]:
        axis, high = divmod(FACES.index(face), 2)
        velocity = 0.3 * random.normal(size=3)
        velocity[axis] = -1.0 if high else 1.0
        inlet = {"face": str(face), "velocity": (speed * velocity).tolist(), "density": float(pick([0.0, 1.0, 50.0]))}
        if chance(0.6):
            inlet |= {"centre": place(0.1).tolist(), "radius": cell * 10 ** random.uniform(-0.5, 1)}
        inlets.append(inlet | {"temperature": float(pick([0.0, 1.0, 30.0]))})

    def body() -> dict:
        """Draws a shape at a place, on a path and in turns up to ten times as fast as the inlets."""
        shape = str(pick(["sphere", "box", "cylinder", str(folder / "sail.obj"), str(FAN)]))
        radius = cell * 10 ** random.uniform(-2, 0.8, 3)
        out = {"shape": shape, "radius": radius.max() if shape == "sphere" else radius.tolist()}
        if "." in shape:
            out = {"shape": shape, "scale": radius.max(), "shell": [None, True, False][random.integers(3)]}
        path = [[random.uniform(-1, 1) / rate, *place(0.4)]]
        for _ in range(random.integers(0, 4)):
            moved = random.normal(size=3)
            moved *= cell * 10 ** random.uniform(-1, 1) / np.linalg.norm(moved)
            taken = np.linalg.norm(moved) / (speed * 10 ** random.uniform(-1, 1))
            path.append([path[-1][0] + taken, *(np.array(path[-1][1:]) + moved)])
        span = np.radians(700) * radius.max() / (speed * 10 ** random.uniform(-1, 1))
        turn = [[k * span, *random.uniform(-400, 400, 3)] for k in range(pick([0, 1, 2]))]
        keys = {"path": path, "turn": turn, "offset": [radius.min() * chance(0.2), 0, 0]}
        return out | {name: np.array(rows).astype(float).tolist() for name, rows in keys.items()}

    # Frames of some twenty steps at the speed of the inlets.
    rate = speed / (cell * random.uniform(1, 4))
    frames = int(random.integers(1, 6))
    sources = []
    for _ in range(random.integers(0, 3)):
        start = random.uniform(-0.2, 1.2) * frames / rate
        stop = None if chance(0.5) else start + 10 ** random.uniform(-4, 0.5) / rate
        what = {"density": float(pick([0.0, 1.0, 100.0])), "temperature": float(pick([0.0, 1.0, 10.0]))}
        if chance(0.3):
            noise = {"amount": 10 ** random.uniform(-1, 2), "size": cell * 10 ** random.uniform(-1, 1)}
            what["noise"] = noise | {"duration": 1.0 / rate}
        sources.append(body() | what | {"start": start, "stop": stop})
    obstacles = [body() for _ in range(random.integers(0, 4))]
    pull = speed * speed / float(size.max())  # a speed over the box
    smoke = {"buoyancy": pull * 10 ** random.uniform(-2, 2) if chance(0.6) else 0.0}
    smoke["weight"] = pull * 10 ** random.uniform(-3, 1) if chance(0.3) else 0.0
    smoke["up"] = random.normal(size=3).tolist()
    smoke |= {"scheme": str(pick(["maccormack", "semi-lagrangian"])), "bricks": chance(0.3)}
    smoke |= {"dissipation": rate * 0.3 * chance(0.3), "cooling": rate * 0.3 * chance(0.3)}
    smoke |= {"storage": "float16" if chance(0.3) else "float32", "substeps": int(pick([1, 2, 3, 4, 8]))}
    viscosity = 0.0 if chance(0.3) else speed * cell * 10 ** random.uniform(-6, 2)
    air = {"viscosity": viscosity, "smagorinsky": float(pick([0.17, 0.17, 0.1, 0.3, 0.0]))}
    air |= {"lattice_speed": float(random.uniform(0.02, 0.202)), "storage": "float16" if chance(0.2) else "float32"}
    if chance(0.2):
        air["speed"] = speed * 10 ** random.uniform(-0.5, 2)
    if chance(0.3):
        keys = [[0.0, *(speed * random.normal(size=3))], [frames / rate, *(speed * random.normal(size=3))]]
        keys = [[float(number) for number in key] for key in keys]
        air["wind"] = {"keys": keys, "gusts": float(random.uniform()), "period": frames / rate}
    if chance(0.3):
        air["confinement"] = rate * 10 ** random.uniform(-1, 1)
    if chance(0.3):
        air["turbulence"] = {"strength": pull * 10 ** random.uniform(-2, 2), "size": cell * 10 ** random.uniform(0, 1)}
    if chance(0.4):
        heat, smokes, cools, burns = 10 ** random.uniform(-2, 1, 4) * (1, 1, rate, 0.1 * rate)
        smoke["fire"] = {"rate": burns, "heat": heat, "smoke": smokes, "radiation": cools, "expansion": 0.3}
        smoke["fire"]["ignition"] = float(pick([0.0, 0.5]))
        for each in (*inlets, *sources):
            each["fuel"] = float(pick([0.0, 1.0, 10.0]))
    grid = {"cells": cells.tolist(), "cell": cell, "refine": int(random.integers(1, 4)), "origin": origin.tolist()}
    lamp = {"position": place(0.5).tolist(), "intensity": [cell * cell] * 3, "radius": cell * chance(0.5)}
    scene = {"name": f"random {seed}", "grid": grid | {"faces": faces}, "smoke": smoke, "air": air, "inlets": inlets}
    return scene | {"lights": [lamp], "sources": sources, "obstacles": obstacles, "frames": frames, "rate": rate}
