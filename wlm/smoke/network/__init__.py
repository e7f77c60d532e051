"""The network that predicts six-way lightmaps, and its training.

A network maps a guiding map, a cheap render of smoke, to six-way lightmaps. It is trained on pairs of the two, rendered
from smoke that is simulated during the training. Reading order: `planes.py` encodes guiding maps and lightmaps as
planes, `settings.py` has all settings, `unet.py` the network, `pool.py` the samples, `scenes.py` random scenes, and
`dataset.py` simulates them and renders their samples. `losses.py` and `trainer.py` take the steps; `wlm/smoke/fit.py`
is the loop over rounds with validation and checkpoints. Training in a few lines, without checkpoints:

    validation = make_validation(profile.dataset)
    trainer = Trainer(profile.network, profile.training, seed=0, device="cpu")
    for number in range(profile.training.rounds):
        pool = make_pool(profile.dataset, seed=0, round=number)
        trainer.run(pool, plan_round(profile.training, pool, seed=0, round=number))
        print(score(of_network(trainer.average), validation).psnr)

All random numbers depend only on a seed, a round and a number: pools, orders and weights repeat to the bit on one
device.
"""
