"""References of the kernels in float64 torch: plain, slow, and written from the formulas alone."""
