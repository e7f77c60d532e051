"""What the kernels must compute, in float64 torch: plain, slow, and written from the formulas alone."""
