# Written by python -m wlm._facade from `_PLACES` of the package.
from wlm.inspection.finding import Finding as Finding
from wlm.inspection.folders import input_system as input_system
from wlm.inspection.folders import inspect as inspect
