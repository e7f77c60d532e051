"""The kernels against `reference`, on every device."""
