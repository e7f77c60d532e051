# The public names of the package; `wlm._facade` reads these lines, too.
from wlm import atlas as atlas
from wlm import bake as bake
from wlm import export as export
from wlm import fluid as fluid
from wlm import inspection as inspection
from wlm import lightmap as lightmap
from wlm import ops as ops
from wlm import probe as probe
from wlm import scene as scene
from wlm import smoke as smoke
from wlm.errors import WlmError as WlmError
from wlm.system import load as load

__version__: str
