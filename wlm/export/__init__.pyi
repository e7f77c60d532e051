# The public names of the package; `wlm._facade` reads these lines, too.
from wlm.export.engines.kit import ENGINES as ENGINES
from wlm.export.page.pages import make_page as make_page
from wlm.export.page.pages import write_page as write_page
from wlm.export.page.viewer import write_viewer as write_viewer
from wlm.export.shading import LANGUAGES as LANGUAGES
from wlm.export.shading import translate as translate
from wlm.export.writing import export as export
