"""Heading, unit and number format of every figure that the benchmarks measure, by the figure's name in a `Row`.

`TABLES` states the order of columns. Its groups become separate tables where one table would be too wide.
"""

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Figure:
    """How tables and plots show one measured quantity.

    Attributes:
        title: The quantity, in a word or two.
        unit: The unit of the quantity, `""` if it has none. `"%"`: a ratio, stored as 1.0 and shown as 100%.
        form: Python format specification; empty: three significant digits, or no decimals from 100 on.
    """

    title: str
    unit: str = ""
    form: str = ""

    @property
    def heading(self) -> str:
        """The heading of the figure's table column, such as "size, bytes"."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    @property
    def label(self) -> str:
        """The label of the figure's plot axis, such as "size (bytes)"."""
        return f"{self.title} ({self.unit})" if self.unit else self.title

    def text(self, value: float, form: str = "") -> str:
        """Returns a value as text without its unit, by the format specification `form` or by the figure's own."""
        if self.unit == "%":
            value *= 100.0
        form = form or self.form or (",.0f" if abs(value) >= 100.0 else ".3g")
        return format(value, form)


_WHOLE = ",.0f"

_TABLES: dict[str, dict[str, Figure]] = {
    "Size and error": {
        "bytes": Figure("size", "bytes", _WHOLE),
        "bpp": Figure("size", "bpp", ".3f"),  # bits for each texel and time, or for each probe
        "disk_bytes": Figure("on disk", "bytes", _WHOLE),
        "disk_bpp": Figure("on disk", "bpp", ".3f"),
        "compression_ratio": Figure("CR", "%", ".1f"),  # eq. 9 of lightmap-uv-clustering-cascade
        "share_of_float32": Figure("of float32", "%", ".2f"),
        "psnr": Figure("PSNR", "dB", ".2f"),
        "relative_error": Figure("relative error", "%", ".2f"),  # this and the next ones as in `benchmarks.probe_table`
        "relative_db": Figure("relative error", "dB", ".2f"),
        "held_out_psnr": Figure("held out", "dB", ".2f"),
        "held_out_relative_db": Figure("held out, relative", "dB", ".2f"),
        "volume_psnr": Figure("in the volume", "dB", ".2f"),
        "volume_relative_db": Figure("in the volume, relative", "dB", ".2f"),
        "gain": Figure("gain", "dB", "+.3f"),  # PSNR minus the PSNR of another method
        "psnr_worst": Figure("worst view", "dB", ".2f"),
        "texel_psnr": Figure("texels", "dB", ".2f"),
        "tone_psnr": Figure("tone mapped", "dB", ".2f"),  # as a screen shows it, `wlm.atlas.evaluation`
        "irradiance_psnr": Figure("irradiance", "dB", ".2f"),
        "nearest_psnr": Figure("nearest", "dB", ".2f"),  # interpolation of uncompressed probes, as the next figure
        "distance_psnr": Figure("by distance", "dB", ".2f"),
        "half_way_psnr": Figure("half-way", "dB", ".2f"),
        "mixed_psnr": Figure("originals mixed", "dB", ".2f"),  # as `wlm.lightmap.held_out.HeldOut.mixed`
        "stored_psnr": Figure("stored times", "dB", ".2f"),
        "coarse_psnr": Figure("coarse march", "dB", ".2f"),
        "network_psnr": Figure("network", "dB", ".2f"),
        "opacity_psnr": Figure("opacity", "dB", ".2f"),
        "emission_psnr": Figure("emission", "dB", ".2f"),
        "seen": Figure("seen", "dB", ".2f"),  # this and the next ones as in `wlm.lightmap.view_scores`
        "worst_seen": Figure("worst", "dB", ".2f"),
        "ring": Figure("ring", "dB", ".2f"),
        "between": Figure("between", "dB", ".2f"),
        "worst_between": Figure("worst", "dB", ".2f"),
        "border": Figure("borders", form=".2f"),
        "excess_change": Figure("flicker", "%", ".3f"),
        "view_psnr": Figure("views", "dB", ".2f"),
        "view_flip": Figure("FLIP of views", form=".4f"),
        "ssim": Figure("SSIM", form=".4f"),
        "one_minus_ssim": Figure("1 − SSIM", form=".2g"),
        "flip": Figure("FLIP", form=".4f"),
        "seam_ratio": Figure("seams", form=".2f"),  # error at charts' borders over that elsewhere
        "light_rms": Figure("light RMS", "%", ".3g"),
        "still_light_rms": Figure("without jitter", "%", ".3g"),
        "transparency_rms": Figure("transparency RMS", form=".3g"),
        "bias": Figure("bias", "%", "+.1f"),
        "rms": Figure("RMS", "%", ".3g"),  # RMS difference over the RMS of the exact values
        "texel_rms": Figure("RMS of a texel", "%", ".3g"),  # relative to its brightest channel
        "worst_rms": Figure("worst light's RMS", "%", ".3g"),
        "halving_rms": Figure("RMS by halving", "%", ".3g"),
        "finest_rms": Figure("RMS from the finest", "%", ".3g"),
        "largest": Figure("largest", "%", ".3g"),
        "mass_drift": Figure("mass drift", form=".2g"),
        "smoke_gained": Figure("smoke gained", "%", "+.2g"),
        "max_error": Figure("largest error", form=".2g"),
        "value_error": Figure("error of values", form=".1e"),  # as a share of the largest number, against float64
        "gradient_error": Figure("of gradients", form=".1e"),
        "error_999": Figure("99.9% within", form=".2g"),  # error of all but 0.1% of the points, against float64
        "flicker": Figure("flicker", "levels", ".3g"),  # levels of 255
        "flicker_ratio": Figure("over the reference's", form=".3f"),
    },
    "Time": {
        "encode_seconds": Figure("encode", "s", ".3g"),
        "hours": Figure("time", "h", ".3g"),
        "core_seconds": Figure("of a core", "s", ".3g"),
        "load_ms": Figure("load a tile", "ms", ".2g"),
        "open_ms": Figure("open the file", "ms", ".3g"),
        "open_tile_ms": Figure("open it and decode a tile", "ms", ".3g"),
        "read_bytes": Figure("read for that", "bytes", _WHOLE),
        "decode_ms": Figure("decode time", "ms", ".3g"),
        "time_ms": Figure("time", "ms", ".3g"),
        "replay_ms": Figure("replayed", "ms", ".3g"),
        "call_ms": Figure("as calls", "ms", ".3g"),
        "step_ms": Figure("a step", "ms", ".3g"),
        "forward_ms": Figure("forward", "ms", ".3g"),
        "backward_ms": Figure("backward", "ms", ".3g"),
        "torch_forward_ms": Figure("torch forward", "ms", ".3g"),
        "torch_backward_ms": Figure("torch backward", "ms", ".3g"),
        "times_ours": Figure("times ours", form=".3g"),
        "point_rate": Figure("points", "G/s", ".2f"),
        "bandwidth": Figure("bandwidth", "GB/s", ".4g"),
        "mlups": Figure("MLUPS"),  # million lattice cells a second
        "voxel_rate": Figure("voxels", "M/s"),
        "rate": Figure("rate", "G/s", ".4g"),  # of one kind of work, `benchmarks.ceilings`
        "floor_ms": Figure("floor", "ms", ".3g"),  # the next ones as in `benchmarks.kernels`
        "of_floor": Figure("of the floor", "%", ".3g"),
        "slope": Figure("slope", form=".2f"),
        "launches": Figure("launches", form=".3g"),
        "share_of_time": Figure("of the time", "%", ".3g"),  # the next ones as in `benchmarks.kernels_profile`
        "memory_busy": Figure("memory", "%", ".2g"),
        "l2_busy": Figure("L2", "%", ".2g"),
        "l1_busy": Figure("L1", "%", ".2g"),
        "issue_busy": Figure("issue", "%", ".2g"),
        "warps_active": Figure("warps", "%", ".2g"),
        "registers": Figure("registers", form=_WHOLE),
        "moved_bytes": Figure("bytes", "bytes", _WHOLE),
        "operations": Figure("operations", form=".3g"),
        "storage_busy": Figure("storage busy", "%", ".1f"),  # this and the next ones as in `benchmarks.growth`
        "cores_busy": Figure("cores busy", "%", ".1f"),
        "gpus_busy": Figure("GPUs busy", "%", ".1f"),
        "repeated": Figure("repeated", form=_WHOLE),
        "of_copy": Figure("of the copy", "%", ".3g"),  # the copy's bandwidth, at the bytes that must be moved
        "worked_on": Figure("worked on", "%", ".3g"),
        "speedup": Figure("speedup", form=".2f"),
        "frame_rate": Figure("frames/s", form=".3g"),
    },
    "Stages": {  # seconds of each stage of the compression of an atlas
        "weights_seconds": Figure("weights", "s", ".2g"),
        "tiles_seconds": Figure("tiles", "s", ".2g"),  # scenes only
        "curves_seconds": Figure("curves", "s", ".2g"),
        "balance_seconds": Figure("balance", "s", ".2g"),
        "separate_seconds": Figure("separate", "s", ".2g"),  # scenes only: separate tiles of each state
        "allocate_seconds": Figure("allocate", "s", ".2g"),
        "solve_seconds": Figure("solve", "s", ".2g"),
        "cluster_seconds": Figure("cluster", "s", ".2g"),
        "pack_seconds": Figure("pack", "s", ".2g"),
        "regenerate_seconds": Figure("regenerate", "s", ".2g"),
        "fit_seconds": Figure("fit", "s", ".2g"),
        "write_seconds": Figure("write", "s", ".2g"),
        "compare_seconds": Figure("compare", "s", ".2g"),
        "mips_seconds": Figure("mips", "s", ".2g"),
    },
    "Volume": {  # around a viewer of probes
        "coverage": Figure("coverage", "%", ".1f"),
        "light_rmse": Figure("RMSE", form=".3g"),
        "light": Figure("light's RMS", form=".3g"),
        "light_psnr": Figure("PSNR of the probes read", "dB", ".2f"),
        "far_psnr": Figure("PSNR farther away", "dB", ".2f"),
        "frames_first": Figure("frames until all is there", form=_WHOLE),
        "first_coverage": Figure("first frame's", "%", ".1f"),
        "first_light_rmse": Figure("RMSE", form=".3g"),
        "first_light": Figure("light's RMS", form=".3g"),
        "first_ms": Figure("first frame", "ms", ".3g"),
        "update_ms": Figure("update", "ms", ".3g"),
        "update_decode_ms": Figure("of it decode", "ms", ".3g"),
        "blocks": Figure("blocks", form=".3g"),
        "blocks_waiting": Figure("waiting", form=".3g"),
        "probes_decoded": Figure("probes decoded", form=".3g"),
        "memory": Figure("memory", "MiB", ".1f"),
        "memory_before": Figure("of it before the file is opened", "MiB", ".1f"),
    },
    "Virtual texture": {  # `benchmarks.lightmap_run_time`
        "frame_ms": Figure("frame", "ms", ".3f"),
        "feedback_ms": Figure("of it feedback", "ms", ".3f"),
        "select_ms": Figure("selection", "ms", ".3f"),
        "table_ms": Figure("page table", "ms", ".3f"),
        "host_ms": Figure("on the host", "ms", ".3f"),
        "host_ms_p95": Figure("on the host 95%", "ms", ".3f"),
        "host_ms_max": Figure("on the host, most", "ms", ".2f"),
        "pages_visible": Figure("pages in view", form=".3g"),
        "pages_decoded": Figure("decoded", form=".3g"),
        "current": Figure("current", "%", ".2f"),
        "nearly_current": Figure("or a level coarser", "%", ".2f"),
        "staleness": Figure("staleness", "%", ".2f"),
        "cached_psnr": Figure("PSNR to all decoded", "dB", ".2f"),
        "texture_memory": Figure("texture", "MiB", ".1f"),
        "tiles_memory": Figure("tiles", "MiB", ".1f"),
        "coarse_memory": Figure("coarse texels", "MiB", ".1f"),
        "pages_memory": Figure("page table", "MiB", ".1f"),
        "masks_memory": Figure("masks", "MiB", ".1f"),
        "tables_memory": Figure("tables", "MiB", ".1f"),
        "memory_full": Figure("all tiles", "MiB", ".1f"),
    },
    "Settings": {
        "steps": Figure("steps", form=_WHOLE),
        "samples": Figure("samples", form=_WHOLE),
        "times": Figure("times", form=_WHOLE),
        "times_scored": Figure("scored", form=_WHOLE),
        "constant_tiles": Figure("constant tiles", form=_WHOLE),
        "dynamic_tiles": Figure("dynamic tiles", form=_WHOLE),
        "frames_tiles": Figure("tiles of frames", form=_WHOLE),
        "tiles_timed": Figure("tiles timed", form=_WHOLE),
        "lightmaps": Figure("lightmaps", form=_WHOLE),
        "resolution": Figure("resolution", "pixels", _WHOLE),
        "colour_width": Figure("colour width", "texels", _WHOLE),
        "colour_height": Figure("height", "texels", _WHOLE),
        "lut_width": Figure("table width", "texels", _WHOLE),
        "lut_height": Figure("height", "texels", _WHOLE),
        "probes": Figure("probes", form=_WHOLE),
        "gaussians": Figure("Gaussians", form=_WHOLE),
        "dropped": Figure("dropped", form=_WHOLE),
        "list_entries": Figure("list entries", form=_WHOLE),
        "frames": Figure("frames", form=_WHOLE),
        "size": Figure("size", form=_WHOLE),
        "cells": Figure("edge", "cells", _WHOLE),
        "voxels": Figure("edge", "voxels", _WHOLE),
        "pixels": Figure("edge", "pixels", _WHOLE),
        "lights": Figure("lights", form=_WHOLE),
        "parameters": Figure("parameters", form=_WHOLE),
        "file_size": Figure("file", "MB", ".2f"),
    },
}
_VARIANTS = {"": "", "_spread": "p90−p10", "_p95": "95%", "_min": "least", "_max": "most"}

TABLES: dict[str, dict[str, Figure]] = {
    title: {
        name + suffix: replace(figure, title=heading or figure.title)
        for name, figure in table.items()
        for suffix, heading in _VARIANTS.items()
    }
    for title, table in _TABLES.items()
}
"""The figures by their table's title, then by name. A suffix of a name stands for a statistic of several values."""

FIGURES: dict[str, Figure] = {name: figure for table in TABLES.values() for name, figure in table.items()}
"""Every figure by its name, with the variants of each."""
