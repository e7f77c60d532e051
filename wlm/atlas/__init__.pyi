# Written by python -m wlm._facade from `_PLACES` of the package.
# ruff: noqa: I001
from wlm.atlas.data import LightmappedMesh as LightmappedMesh
from wlm.atlas.data import from_arrays as from_arrays
from wlm.atlas.data import load as load
from wlm.atlas.decode import Decoder as Decoder
from wlm.atlas.evaluation import Report as Report
from wlm.atlas.evaluation import compare as compare
from wlm.atlas.evaluation import evaluate as evaluate
from wlm.atlas.exporter import describe as describe
from wlm.atlas.exporter import export as export
from wlm.atlas.exporter import read_folder as read_folder
from wlm.atlas.fit import compress as compress
from wlm.atlas.model import AtlasModel as AtlasModel
from wlm.atlas.model import Profile as Profile
from wlm.ops.views import View as View
