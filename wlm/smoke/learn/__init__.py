"""Training of the six-way network: data, losses and optimiser."""
