# The public names of the package; `wlm._facade` reads these lines, too.
from wlm.inspection.finding import Finding as Finding
from wlm.inspection.folders import input_system as input_system
from wlm.inspection.folders import inspect as inspect
