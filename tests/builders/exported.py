"""Raw folders, read as their index says."""

import json

import numpy as np


def read_export(folder):
    """The index of a raw folder, and the arrays of its buffers and its reference by name."""
    index = json.loads((folder / "bundle.json").read_text())
    entries = index["buffers"] | index["reference"]
    arrays = {
        name: np.fromfile(folder / each["file"], np.dtype(each["dtype"]).newbyteorder("<")).reshape(each["shape"])
        for name, each in entries.items()
        if each["file"].endswith(".bin")
    }
    return index, arrays
