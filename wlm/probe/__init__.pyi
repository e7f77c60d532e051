# The public names of the package; `wlm._facade` reads these lines, too.
from wlm.probe.data import ProbeSet as ProbeSet
from wlm.probe.data import from_arrays as from_arrays
from wlm.probe.data import load as load
from wlm.probe.data import load_positions as load_positions
from wlm.probe.data import save_probes as save_probes
from wlm.probe.decode import Decoder as Decoder
from wlm.probe.evaluation import Report as Report
from wlm.probe.evaluation import evaluate as evaluate
from wlm.probe.evaluation import score as score
from wlm.probe.fit import compress as compress
from wlm.probe.fit import open_checkpoint as open_checkpoint
from wlm.probe.model import ProbeModel as ProbeModel
from wlm.probe.model import Profile as Profile
from wlm.probe.views import score_views as score_views
from wlm.probe.volume.cascade import Volume as Volume
