"""How the network learns: everything that its training needs and its use doesn't.

A network turns a guiding map, a cheap render of smoke, into six-way lightmaps. It learns that from pairs of the two,
rendered from simulated smoke while it trains. To read it all, in order:

1.  `wlm/smoke/network/planes.py`: the planes of a guiding map and of lightmaps, encoded to a common range. All that
    follows is in these.
2.  `wlm/smoke/model.py`: the network, a U-Net with NAFBlocks behind it: `NetworkSettings`, `SixWayNetwork`.
3.  `settings.py`: how samples are made (`DatasetSettings`), weights of the losses (`LossSettings`), the
    optimiser's settings (`TrainSettings`). `Profile` in `model.py` holds the network's, the training's and the
    dataset's; `configs/smoke-network-*.yaml` are profiles.
4.  `pool.py`: `Pool`, the samples: [N, 2, C, H, W] guides and [N, 2, 8, H, W] targets, the motion between the two
    frames of each; in memory and in files.
5.  `scenes.py`: `draw_scene`, a random jet, plume, flame or burst.
6.  `dataset.py`: `make_pool` and `make_validation` simulate such scenes and render their samples.
7.  `losses.py`: reconstruction and temporal loss.
8.  `trainer.py`: `plan_round` draws the order of samples, `Trainer.run` takes steps.
9.  `wlm/smoke/fit.py`: `train`, the loop over rounds: make a pool, take the steps, validate, save the best network
    and a checkpoint.
10. `wlm/smoke/evaluation.py`: `score`, by which the best network is selected; `evaluate` and `compare`, on
    sequences held out from both.

The whole in a few lines, without checkpoints:

    validation = make_validation(profile.dataset)
    trainer = Trainer(profile.network, profile.training, seed=0, device="cpu")
    for number in range(profile.training.rounds):
        pool = make_pool(profile.dataset, seed=0, round=number)
        trainer.run(pool, plan_round(profile.training, pool, seed=0, round=number))
        print(score(of_network(trainer.average), validation).psnr)
    SmokeModel(trainer.average, {"dataset": profile.dataset.model_dump(mode="json")}).save("network.safetensors")

Everything random depends on a seed, a round and a number alone: pools, orders and weights repeat to the bit on one
device. `synthetic.py` makes smoke of noise, for demos and measurements; no training uses it.
"""
