# The public names of the package; `wlm._facade` reads these lines, too.
from wlm.atlas.data import LightmappedScene as LightmappedScene
from wlm.atlas.data import Sheet as Sheet
from wlm.atlas.data import from_arrays as from_arrays
from wlm.atlas.data import join as join
from wlm.atlas.data import load as load
from wlm.atlas.decode import Decoder as Decoder
from wlm.atlas.evaluation import Report as Report
from wlm.atlas.evaluation import compare as compare
from wlm.atlas.evaluation import evaluate as evaluate
from wlm.atlas.fit import compress as compress
from wlm.atlas.fit import open_checkpoint as open_checkpoint
from wlm.atlas.model import AtlasModel as AtlasModel
from wlm.atlas.model import Profile as Profile
from wlm.atlas.views import Points as Points
from wlm.ops.views import View as View
