# Written by python -m wlm._facade from `_PLACES` of the package.
from wlm.fluid.faces import FACES as FACES
from wlm.fluid.lattice import Domain as Domain
from wlm.fluid.lattice import Lattice as Lattice
from wlm.fluid.obstacles import Mesh as Mesh
from wlm.fluid.obstacles import Obstacle as Obstacle
from wlm.fluid.obstacles import Sphere as Sphere
from wlm.fluid.obstacles import Trajectory as Trajectory
from wlm.fluid.obstacles import box_mesh as box_mesh
from wlm.fluid.solver import Buoyancy as Buoyancy
from wlm.fluid.solver import Solver as Solver
from wlm.fluid.solver import Source as Source
from wlm.fluid.volume import DensityVolume as DensityVolume
from wlm.fluid.volume import from_array as from_array
from wlm.fluid.volume import load_volume as load_volume
from wlm.fluid.volume import save_volume as save_volume
