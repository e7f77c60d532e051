# The public names of the package; `wlm._facade` reads these lines, too.
from wlm.lightmap.data import Layer as Layer
from wlm.lightmap.data import LightmapSet as LightmapSet
from wlm.lightmap.data import from_arrays as from_arrays
from wlm.lightmap.data import from_groups as from_groups
from wlm.lightmap.data import from_layers as from_layers
from wlm.lightmap.data import load as load
from wlm.lightmap.decode import Decoder as Decoder
from wlm.lightmap.evaluation import Report as Report
from wlm.lightmap.evaluation import evaluate as evaluate
from wlm.lightmap.fit import compress as compress
from wlm.lightmap.fit import open_checkpoint as open_checkpoint
from wlm.lightmap.model import LightmapModel as LightmapModel
from wlm.lightmap.profile import Profile as Profile
from wlm.lightmap.sheet import Sheet as Sheet
from wlm.lightmap.virtual.texture import VirtualTexture as VirtualTexture
