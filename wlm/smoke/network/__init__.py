"""The network that predicts six-way lightmaps, and its training.

A network maps a guiding map, a cheap render of smoke, to six-way lightmaps. It is trained on pairs of the two, rendered
from smoke that is simulated during the training. Reading order:

1.  `planes.py`: encoding of guiding maps and lightmaps as planes of a common range, which all other modules use.
2.  `settings.py`: shape of the network (`NetworkSettings`), samples (`DatasetSettings`), optimiser (`TrainSettings`),
    and `Profile` with all three; `configs/smoke-network-*.yaml` are profiles.
3.  `unet.py`: the network, a U-Net followed by NAFBlocks.
4.  `pool.py`: `Pool`, the samples: [N, 2, C, H, W] guides, [N, 2, 8, H, W] targets, and the motion between the frames.
5.  `scenes.py`: `draw_scene`, a random jet, plume, flame or burst.
6.  `dataset.py`: `make_pool` and `make_validation` simulate such scenes and render their samples.
7.  `losses.py`: reconstruction and temporal loss.
8.  `trainer.py`: `plan_round` draws the order of samples, `Trainer.run` takes steps.
9.  `wlm/smoke/fit.py`: `train`, the loop over rounds with validation, checkpoints and the best network.
10. `wlm/smoke/evaluation.py`: `score`, which selects the best network; `evaluate` and `compare` on the test set.
11. `wlm/smoke/decode.py` and `prediction.py`: the network at run time. `onnx_file.py`: the network as ONNX.

The training in a few lines, without checkpoints:

    validation = make_validation(profile.dataset)
    trainer = Trainer(profile.network, profile.training, seed=0, device="cpu")
    for number in range(profile.training.rounds):
        pool = make_pool(profile.dataset, seed=0, round=number)
        trainer.run(pool, plan_round(profile.training, pool, seed=0, round=number))
        print(score(of_network(trainer.average), validation).psnr)
    SmokeModel(trainer.average, {"dataset": profile.dataset.model_dump(mode="json")}).save("network.safetensors")

All random numbers depend only on a seed, a round and a number: pools, orders and weights repeat to the bit on one
device.
"""
