"""The network that predicts six-way lightmaps, and its training.

A network maps a guiding map, a cheap render of smoke, to six-way lightmaps. It is trained on pairs of guiding maps and
lightmaps of smoke that is simulated during the training. Reading order: `planes.py` encodes guiding maps and lightmaps
as planes and has the container of samples, `settings.py` has all settings, `unet.py` the network, `scenes.py` random
scenes, and `dataset.py` simulates them and renders their samples. `losses.py` and `trainer.py` take the steps;
`wlm/smoke/fit.py` is the loop over rounds with validation and checkpoints.

All random numbers depend only on a seed, a round and a number, so that the samples, their order and the weights repeat
to the bit on one device.
"""
