# Written by python -m wlm._facade from `_PLACES` of the package.
# ruff: noqa: I001
from wlm.atlas.scene.data import LightmappedScene as LightmappedScene
from wlm.atlas.scene.data import load_scene as load_scene
from wlm.atlas.scene.data import scene_of as scene_of
from wlm.atlas.scene.decode import Decoder as Decoder
from wlm.atlas.scene.evaluation import SceneReport as SceneReport
from wlm.atlas.scene.evaluation import compare_scene as compare_scene
from wlm.atlas.scene.evaluation import evaluate_scene as evaluate_scene
from wlm.atlas.scene.exporter import export_scene as export_scene
from wlm.atlas.scene.fit import compress_scene as compress_scene
from wlm.atlas.scene.model import SceneModel as SceneModel
from wlm.atlas.scene.model import SceneProfile as SceneProfile
