"""Exports the update of a cascaded volume: compute shaders that fill it as the viewer moves, with the buffers they use.

The shaders do what `wlm_kernels.probe.volume_frame` and `volume_weights` do, with the same result within rounding.
"""

from pathlib import Path

import numpy as np

from wlm.bundle import Bundle, filled
from wlm.errors import WlmError
from wlm.probe.glsl import buffer_glsl
from wlm.probe.model import ProbeModel
from wlm.probe.volume.bundle import head_words, pool_words
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.shader import HEAD_WORDS, LEVEL_WORDS, row_words
from wlm.probe.volume.walk import camera_path
from wlm_kernels.probe.volume_frame import HALVES, MOST, PROBES

_FRAMES = 8  # of the reference
_BINS = 1024  # of the distances of waiting blocks; the kernels have more
_SUMS = 32  # of _BINS / _SUMS bins each
_RECORD = 12  # words of a probe in the buffer index
_FIRST_BINDING = 2  # the shader of the probes has the first two
_BUFFERS = ("HEAD", "INDEX", "PAGES", "POOL", "TABLES", "COUNTS", "WORK", "LIGHT")
_READ_ONLY = ("HEAD", "INDEX")

_USED = {
    "scroll": "head index pages tables counts work",
    "limit": "counts work",
    "gather": "head pages counts work",
    "rank": "counts work",
    "allocate": "head index pages tables counts work",
    "ranges": "head index work",
    "weigh": "head index work light",
    "decode": "head index work light",
    "combine": "work light",
    "store": "pool work light",
}
"""Buffers of each dispatch; the decoding one has those of the probes, too."""

_ABOUT = {
    "order": "In each frame the engine writes the buffer head, then runs the functions of `dispatches` in their order, "
    "each in a compute shader whose main calls it with the index of the thread, for at least `threads` threads; a "
    "function does nothing for further threads, and uses `buffers`. Writes of a dispatch must be visible to the next "
    "one: a memory barrier in GLSL, nothing to do in WebGPU. `shader` of this folder is an include file with all of "
    "the functions.",
    "head": "See the head of the shader that reads the volume. In each frame: the word 4 is a number that rises by 1 "
    "from 1; for each level, in doubles, at = viewpoint / block - start, base = clamp(floor(at + 1/2) - floor(sides / "
    "2), low, high + 1 - sides), view = at - base - 1/2; the words 12 to 14 of the level are the base of the frame "
    "before, in the first frame base + sides.",
    "buffers": "The engine makes the buffers of `words` with as many 32-bit words. Before the first frame all bits of "
    "pages and tables are 1, and counts is 0. volume, pages and pool are those that the volume's shader reads: bind "
    "head as volume.",
    "budget": "A frame decodes at most `budget` blocks. After a jump of the viewer, run the dispatches again, with the "
    "frame's number raised and before = base, as long as the word 1 of counts, the number of blocks that waited at the "
    "start of a frame, is above the budget.",
    "probes": "The shader of the probes is included, and the buffers it reads lie beside this document.",
    "reference": "viewpoint: that of each frame, from an empty volume on; pages and pool: the buffers after the last.",
}

_BODY = Path(__file__).parent / "assets" / "update.glsl"


def update_bundle(volume: Volume, model: ProbeModel, *, frames: int = _FRAMES) -> Bundle:
    """Returns the compute shaders that fill a volume from a model, their buffers, and an example of some frames.

    Args:
        volume: A volume of the model's own probes that are live, without any light yet: its frames are the example.
        model: The model that is decoded.
        frames: Number of frames of the example, along a loop through the scene.

    Raises:
        WlmError: The volume has been updated, or has no block near probes.
    """
    index, budget, blocks = volume.index, volume.budget, len(volume.index.block)
    if not blocks:
        raise WlmError("volume: cannot export its update: no probe is live")
    if volume.frame:
        raise WlmError("volume: cannot export its update: expected one that has not been updated")
    form, outputs, rows = model.bundle(), volume.channels, volume.rows
    if form.parts:
        raise WlmError(f"volume: cannot export its update: expected one region, {model.name} has {len(form.parts)}")
    most, slots = min(MOST, blocks), int(volume.sides.prod(1).sum())
    ranked = 1 + 8 * budget
    ranges = ranked + 2 * most
    picks = ranges + 2 * HALVES * budget
    weights = budget * PROBES * outputs
    buffers = [
        buffer_glsl("update", name, _FIRST_BINDING + i, "float" if name == "LIGHT" else "uint", name not in _READ_ONLY)
        for i, name in enumerate(_BUFFERS)
    ]
    layout = {"ranked": ranked, "ranges": ranges, "picks": picks, "weights": weights, "row_words": row_words(outputs)}
    head = filled(
        __package__,
        "update_head.glsl",
        record=_RECORD,
        buffers="".join(buffers),
        outputs=outputs,
        budget=budget,
        most=most,
        **layout,
    )
    # A probe of principal components is found by its number, of Gaussians by its place.
    probe = "int(WLM_UPDATE_INDEX(word + 2))" if "live" in form.reference else "wlm_update_floats(word + 9)"
    path = camera_path(volume.position[volume.numbers], frames)
    heads = []
    for viewpoint in path:
        volume.update(viewpoint)
        state = volume.state()
        heads.append(head_words(volume, state, rows))
    threads = {
        "scroll": max(-(-slots // 2), budget),
        "limit": 1,
        "gather": slots,
        "rank": max(most, _BINS + _SUMS),
        "allocate": budget,
        "ranges": HALVES * budget,
        "weigh": budget,
        "decode": PROBES * budget,
        "combine": outputs * budget,
        "store": row_words(outputs) * budget,
    }
    used = {name: names.split() for name, names in _USED.items()}
    used["decode"] += [name for name in form.buffers if name != "positions"]
    words = {
        "head": HEAD_WORDS + LEVEL_WORDS * len(volume.sizes),
        "pages": -(-slots // 2),
        "pool": rows * row_words(outputs),
        "tables": blocks + (2 * rows if rows < blocks else 0),
        "counts": 2 + _BINS + _SUMS,
        "work": picks + PROBES * budget,
        "light": weights + PROBES * budget,
    }
    levels = zip(volume.sizes, index.start, index.low, index.high, volume.sides, strict=True)
    names = ("block", "start", "low", "high", "sides")
    document = {
        "about": _ABOUT,
        "budget": budget,
        "dispatches": [
            {"function": f"wlm_update_{name}", "threads": count, "buffers": used[name]}
            for name, count in threads.items()
        ],
        "words": words,
        "levels": [dict(zip(names, (row[0], *(each.tolist() for each in row[1:])), strict=True)) for row in levels],
    }
    buffers_of = {"index": _index_words(volume, model), "head": np.concatenate(heads)}
    reference = {"viewpoint": path, "pages": state.pages, "pool": pool_words(state.pool, state.factor)}
    shader = form.shader + head + _BODY.read_text().replace("PROBE, values", f"{probe}, values")
    return Bundle("probe", "update", shader, document, buffers=form.buffers | buffers_of, reference=reference)


def _index_words(volume: Volume, model: ProbeModel) -> np.ndarray:
    """Returns the buffer index, uint32; its layout is at the head of the shader."""
    index = volume.index
    number = volume.numbers[index.number]
    live = np.cumsum(model.live) - 1
    normal = np.zeros((index.count, 3), np.float32) if volume.normal is None else volume.normal[number]
    floats = np.column_stack([index.place, normal, model.normalise(volume.position[number])]).astype("<f4")
    keys = index.key.astype("<u8").view("<u4").reshape(-1, 2)
    records = np.column_stack([keys, live[number].astype("<u4"), floats.view("<u4")])
    return np.concatenate([index.block.astype("<u8").view("<u4"), records.reshape(-1)])
