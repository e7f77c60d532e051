"""Compressed precomputed lighting on NVIDIA Warp kernels.

    import wlm

    day = wlm.lightmap.load("demos/data/city")
    model = wlm.lightmap.compress(day, "M")
    model.save("city.wlm")
    frame = wlm.load("city.wlm").decoder("cpu").frame(18.5)

`wlm.lightmap`, `wlm.atlas`, `wlm.probe` and `wlm.smoke` have the same functions, and `load` reads the files of all.
`wlm.fluid` simulates smoke, `wlm.ops` has the kernels as differentiable torch operations, `wlm.export` writes folders,
kits for engines and HTML pages, `wlm.inspection` describes files, `wlm.bake` makes inputs, and `wlm.scene` reads a
scene that all four systems light over a day.
"""

from wlm._facade import facade

__version__ = "0.2.0"

__getattr__, __dir__, _public = facade(__name__, __file__)

__all__ = sorted([*_public, "__version__"])
