# The public names of the package; `wlm._facade` reads these lines, too.
from wlm.ops import funcs as funcs
from wlm.ops.blocks import bc7_blocks as bc7_blocks
from wlm.ops.blocks import bc7_map as bc7_map
from wlm.ops.blocks import bc7_texels as bc7_texels
from wlm.ops.gaussians import gaussian_sum as gaussian_sum
from wlm.ops.marching import march as march
from wlm.ops.networks import mlp as mlp
from wlm.ops.raster import Raster as Raster
from wlm.ops.raster import interpolate as interpolate
from wlm.ops.raster import rasterize as rasterize
from wlm.ops.raster import rasterize_uv as rasterize_uv
from wlm.ops.raster import texture as texture
from wlm.ops.sampling import plane as plane
from wlm.ops.sampling import triplane as triplane
from wlm.ops.sampling import volume as volume
from wlm.ops.silhouettes import antialias as antialias
