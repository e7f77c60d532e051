"""The bakes that a demo starts from are of its scene as it is now; none of it needs Mitsuba."""

import numpy as np
from builders.bake_rooms import ROOM

from wlm.bake.geometry import read_geometry
from wlm.bake.probes import place_probes
from wlm.bake.work import open_task
from wlm.lightmap import load
from wlm.probe.data import load as load_probes

BAKED = ROOM.parent / "data" / "cornell"


def test_lightmaps_are_of_the_scenes_hours():
    scene = open_task(ROOM / "room.yaml").scene
    lightmaps = load(BAKED).light
    assert lightmaps.times.tolist() == list(scene.hours) and lightmaps.period == scene.period
    assert lightmaps.mask.shape == (scene.lightmap.resolution, scene.lightmap.resolution)
    means = (float(frame[lightmaps.mask].mean()) for frame in lightmaps.frames)
    light = dict(zip(scene.hours, means, strict=True))
    # The sun is low in the window at eight, and has left it at noon; at 20 h the lamp is lit.
    assert light[8] > 3 * light[12] and light[20] > 3 * light[17]


def test_probes_are_where_the_scene_has_them():
    task = open_task(ROOM / "room.yaml")
    scene, path = task.scene, task.geometry
    places = place_probes(scene.probes, read_geometry(path, None))
    for hour in scene.hours:
        probes = load_probes(BAKED / "probes.npz", key=f"{hour:g}h")
        np.testing.assert_allclose(probes.position, places, atol=1e-6)
        assert probes.live.any()
