# The public names of the package; `wlm._facade` reads these lines, too.
from wlm.bake.lightmaps import bake_lightmaps as bake_lightmaps
from wlm.bake.lightmaps import write_lightmaps as write_lightmaps
from wlm.bake.probes import bake_probes as bake_probes
from wlm.bake.probes import write_probes as write_probes
from wlm.bake.settings import BakeScene as BakeScene
from wlm.bake.work import open_checkpoint as open_checkpoint
from wlm.bake.work import open_task as open_task
