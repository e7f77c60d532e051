# The public names of the package; `wlm._facade` reads these lines, too.
from wlm.smoke.shading import PointLight as PointLight
from wlm.smoke.shading import sky_lights as sky_lights
from wlm.smoke.transport.lighting import LitSmoke as LitSmoke
from wlm.smoke.transport.lighting import fine_march as fine_march
from wlm.smoke.transport.lighting import light_smoke as light_smoke
from wlm.smoke.transport.orders import OrdersModel as OrdersModel
from wlm.smoke.transport.orders import ScatteredSmoke as ScatteredSmoke
from wlm.smoke.transport.orders import load_orders as load_orders
from wlm.smoke.transport.orders import scatter as scatter
from wlm.smoke.transport.sphere import bake_sphere as bake_sphere
