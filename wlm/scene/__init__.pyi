# The public names of the package; `wlm._facade` reads these lines, too.
from wlm.scene.content import Moving as Moving
from wlm.scene.content import Puff as Puff
from wlm.scene.content import Scene as Scene
from wlm.scene.content import load as load
from wlm.scene.frame import Frame as Frame
from wlm.scene.frame import Renderer as Renderer
from wlm.scene.mesh import Mesh as Mesh
