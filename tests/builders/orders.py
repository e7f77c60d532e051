"""A model of light of all orders that learned nothing."""

import torch

from wlm.smoke.transport.orders import OrdersModel, load_orders

_DIFFUSED = 18  # among the features


def input_alone() -> OrdersModel:
    """Makes a mix that returns its input: single scattering and diffusion."""
    model = load_orders()
    weights = torch.zeros(model.weights.shape)
    weights[:, 0, _DIFFUSED] = 1.0
    return OrdersModel(weights, model.known)
