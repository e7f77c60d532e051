"""The networks' benchmark on tiny grids: every row has its figures, and they agree with what they are of."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import wlm.bench.path_tracer as path_tracer
import wlm.bench.smoke_network as bench
import wlm.bench.smoke_network_rivals as rivals
from wlm.bench import Row, plot, read_json, write_json
from wlm.bench.path_tracer import PathTracer, denoise
from wlm.bench.report import figures, report
from wlm.bench.smoke_network import PANELS, plotted, run, run_rows
from wlm.bench.smoke_network_setup import QUICK, NetworkBench, Subject, open_subjects, score
from wlm.config import profile_names
from wlm.errors import WlmError
from wlm.smoke.baking import bake
from wlm.smoke.codec import shipped
from wlm.smoke.learn.settings import DatasetSettings
from wlm.smoke.learn.synthetic import make_plume
from wlm.smoke.model import NetworkSettings, SixWayNetwork, SmokeModel
from wlm.smoke.scene import CameraSettings, make_camera

TINY = replace(
    QUICK,
    refine=2,
    resolution=32,
    kinds=("jet",),
    frames=2,
    six=(4.0, 1.0, 0.5),
    coarse=(4.0, 0.8),
    swept=((4.0, 1.0), (0.8, 4.0)),
    turns=(0.0, 60.0),
    scales=(1.0, 2.0),
    profile=16,
    samples=(1,),
    repeats=1,
)
STEP = 0.8  # of a guiding map of 32 voxels
NETWORK = NetworkSettings(guide="six", width=8, levels=2, stem=2)
SETTINGS = DatasetSettings(guide="six")


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """A file with a network that is as it begins: its outputs are the guide's own planes."""
    path = tmp_path_factory.mktemp("networks") / "young.safetensors"
    torch.manual_seed(1)
    SmokeModel(SixWayNetwork(NETWORK), {"dataset": SETTINGS.model_dump(mode="json")}).save(path)
    return path


@pytest.fixture(scope="module")
def rows(network):
    """Without a path tracer, whether there is one or not."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rivals, "has_tracer", lambda: False)
        untrained = Subject("raw", SmokeModel(SixWayNetwork(NETWORK), {}), SETTINGS, False)
        return run_rows(TINY, [*open_subjects([network], []), untrained], device="cpu")


def of(rows, method: str) -> dict[str, Row]:
    return {row.option: row for row in rows if row.method == method}


def test_every_row_has_its_figures(rows):
    methods = ["time against error", "frame", "flip book", "profiles", "density"]
    assert list(dict.fromkeys(row.method for row in rows)) == methods
    keys = [(row.method, row.option) for row in rows]
    assert len(set(keys)) == len(keys)
    for row in rows:
        assert (row.system, row.scene) == ("smoke-network", "unseen smoke")
        assert row.method == "density" or row.decode_ms > 0.0
        assert "most dB" not in figures(row) or (
            float(figures(row)["least dB"]) - 0.01 <= row.psnr <= float(figures(row)["most dB"]) + 0.01
        )


def test_time_against_error(rows):
    found = of(rows, "time against error")
    assert found["six ways, step 0.5"].psnr is None and "held against" in found["six ways, step 0.5"].notes
    assert found["six ways, step 1"].psnr > found["six ways, step 4"].psnr + 6.0
    assert found["coarse, h 0.8"].psnr > found["coarse, h 4"].psnr + 6.0
    least, one, other, most = (found[f"coarse, h {h}"].psnr for h in ("4", "4, nodes 1", "0.8, nodes 4", "0.8"))
    assert least < min(one, other) and max(one, other) < most
    # A network that hasn't learned yet gives back its guide, which is the coarse march.
    assert found["young, fp32"].psnr == pytest.approx(found["coarse, h 0.8"].psnr, abs=0.01)
    assert found["raw, fp32"].psnr is None and found["raw, fp32"].notes == "not trained"


def test_parts_of_a_frame(rows):
    found = of(rows, "frame")
    for name in ("young", "raw"):
        parts = [found[f"{name}, {part}"].decode_ms for part in ("guide", "network", "decode")]
        assert found[f"{name}, all four"].decode_ms == pytest.approx(sum(parts) + found["shade"].decode_ms)
    assert "32x32x32" in figures(found["simulation"])["of"]


def test_flip_book(rows):
    """Right from where it was baked, and wrong from elsewhere, where march and network are as good as ever."""
    found = of(rows, "flip book")
    assert found["turned 0°"].psnr > 60.0 > 35.0 > found["turned 60°"].psnr
    for row in found.values():
        march, ours = (float(figures(row)[f"{name}, dB"]) for name in ("coarse march, h 0.8", "young"))
        assert march > 40.0 and ours == pytest.approx(march, abs=0.01)


def test_profiles(rows):
    found = of(rows, "profiles")
    names = profile_names("smoke-network")
    assert list(found) == [f"{name}, fp32" for name in names] and {"16", "24", "32", "fast"} <= set(names)
    for row in found.values():
        count = int(figures(row)["parameters"].replace(",", ""))
        assert float(figures(row)["MB"]) == pytest.approx(2e-6 * count, abs=0.006)


def test_density_and_flicker(rows):
    found = of(rows, "density")
    marches = [f"coarse, h {h}" for h in ("0.8", "0.4", "0.24")]
    assert list(found) == [f"{name}, x{scale}" for scale in (1, 2) for name in ("young", *marches)]
    for scale in (1, 2):
        ours, march = found[f"young, x{scale}"], found[f"coarse, h 0.8, x{scale}"]
        assert ours.psnr == pytest.approx(march.psnr, abs=0.05)
        ratio = float(figures(march)["over the reference's"])
        assert 0.9 < ratio < 1.5 and float(figures(march)["flicker, levels"]) > 0.0
    assert found["coarse, h 0.8, x2"].psnr < found["coarse, h 0.8, x1"].psnr


def test_a_score():
    wanted = [torch.zeros(8, 4, 4), torch.ones(8, 4, 4)]
    off = [torch.full((8, 4, 4), 0.1), torch.ones(8, 4, 4) - 0.01]
    off[0][6:] = 9.0  # opacity and emission don't count
    found = score(off, wanted)
    assert (found.least, found.most, found.mean) == pytest.approx((20.0, 40.0, 30.0), abs=1e-3)


def test_scenes_that_do_not_come_up():
    with pytest.raises(WlmError, match="expected scenes of jet, whirl, got "):
        NetworkBench("cpu", replace(TINY, kinds=("jet", "whirl"), cells=16, refine=1, resolution=8), [])


def test_networks_are_named_and_read(network, tmp_path):
    (subject,) = open_subjects([network], [])
    assert subject.name == "young" and subject.trained and subject.settings == SETTINGS
    (raw,) = open_subjects([], ["16"])
    assert raw.name == "network-16 untrained" and not raw.trained and raw.model.settings.width == 16
    with pytest.raises(WlmError, match="got young 2 times"):
        open_subjects([network, network], [])
    with pytest.raises(WlmError, match="nosuch"):
        open_subjects([], ["nosuch"])
    path = tmp_path / "bare.safetensors"
    SmokeModel(SixWayNetwork(NETWORK), {}).save(path)
    with pytest.raises(WlmError, match="summary.dataset"):
        open_subjects([path], [])


def test_rows_make_a_file_a_page_and_a_plot(rows, tmp_path):
    path = tmp_path / "rows.json"
    environment = {"device": "cpu", "device_name": "a CPU", "command": "wlm bench", "date": "2026-01-02T03:04:05"}
    environment |= {"threads": 1, "python": "3", "warp": "1", "torch": "2"}
    write_json(path, rows, environment)
    assert read_json(path)[0] == rows
    page = report([path])
    for method in dict.fromkeys(row.method for row in rows):
        assert page.count(f"#### {method}: unseen smoke\n") == 1
    shown = plotted(rows)
    assert [row.method for row in shown] == ["six ways"] * 3 + ["coarse"] * 4 + ["young", "raw"]
    assert shown[0].option == "step 4" and shown[-3].option == "h 0.8, nodes 4"
    plot(shown, tmp_path / "rows.png", PANELS)
    assert (tmp_path / "rows.png").stat().st_size > 10_000


def test_the_command(rows, network, tmp_path, monkeypatch):
    """What it writes, and the command line that it keeps."""
    from wlm.cli.bench import app

    seen = {}

    def measured(*given, **options):
        seen.update(options, given=given)
        return rows

    monkeypatch.setattr(bench, "run", measured)
    json, png = str(tmp_path / "a.json"), str(tmp_path / "a.png")
    arguments = ["--quick", "--network", str(network), "--profile", "16", "--json", json, "--plot", png]
    result = CliRunner().invoke(app, ["smoke-network", *arguments])
    assert result.exit_code == 0, result.output
    assert seen["quick"] and seen["device"] == "cpu" and seen["given"] == ([network], ["16"])
    found, environment = read_json(json)
    told = "wlm bench smoke-network --quick --device cpu --network young.safetensors --profile 16"
    assert found == rows and environment["command"] == told
    assert "#### profiles: unseen smoke" in result.output and (tmp_path / "a.png").stat().st_size > 1000
    # Without any, the network that ships; a profile alone stays alone.
    for words, given in (([], ([shipped()], ())), (["--profile", "16"], ([], ["16"]))):
        result = CliRunner().invoke(app, ["smoke-network", "--quick", *words])
        assert result.exit_code == 0 and seen["given"] == given, result.output


def test_networks_or_profiles_are_needed(monkeypatch):
    seen = []
    monkeypatch.setattr(bench, "run_rows", lambda sizes, subjects, **options: seen.append((sizes, subjects)))
    with pytest.raises(WlmError, match="^bench: expected --network FILE or --profile NAME, found neither$"):
        run(quick=True, device="cpu")
    run([], ["16"], quick=True, device="cpu")
    ((sizes, (subject,)),) = seen
    assert sizes == QUICK and subject.name == "network-16 untrained"


def test_without_the_extra(monkeypatch):
    monkeypatch.setattr(path_tracer, "has_tracer", lambda: False)
    monkeypatch.setattr(path_tracer, "has_denoiser", lambda: False)
    volume, camera = _plume()
    with pytest.raises(WlmError, match=r"mitsuba: install wlm\[bake\]"):
        PathTracer(volume, camera)
    with pytest.raises(WlmError, match=r"pyoidn: install wlm\[bake\]"):
        denoise(np.zeros((6, 8, 8)))
    with pytest.raises(ValueError, match="orthographic"):
        PathTracer(volume, replace(camera, perspective=True))


def test_a_path_tracer_finds_the_same_light():
    """Its noise is the most of what it differs by, and where that is much a denoiser takes most of it away."""
    pytest.importorskip("mitsuba")
    volume, camera = _plume()
    # A tracer's pixels are means over their area.
    wanted = bake(volume, camera, step=0.5, supersample=4, estimate=False)
    trace = PathTracer(volume, camera)
    lightmaps, transparency = trace(256)
    exact = wanted.lightmaps.numpy()
    np.testing.assert_allclose(lightmaps.mean((1, 2)), exact.mean((1, 2)), rtol=0.04)
    assert np.abs(transparency - wanted.transparency.numpy()).mean() < 0.02
    few, _ = trace(4)
    fine, rough = (float(np.square(found - exact).mean()) for found in (lightmaps, few))
    # 64 times the samples, and as many times less of the mean square.
    assert fine < 2e-4 and rough == pytest.approx(64.0 * fine, rel=0.4)
    pytest.importorskip("pyoidn")
    assert float(np.square(denoise(few) - exact).mean()) < 0.3 * rough


def test_rows_of_a_path_tracer():
    pytest.importorskip("mitsuba")
    setup = NetworkBench("cpu", TINY, [])
    found = of(rivals.traced_rows(setup), "path tracing")
    plain = found["1 sample"]
    assert 5.0 < plain.psnr < 30.0 and plain.decode_ms > 0.0
    if path_tracer.has_denoiser():
        cleaned = found["1 sample, denoised"]
        assert cleaned.psnr > plain.psnr + 3.0 and cleaned.decode_ms > plain.decode_ms


def _plume():
    volume = make_plume(24, hot=False, extinction=14.0)
    return volume, make_camera(CameraSettings(resolution=24).turned(20.0), volume.origin, (1.0, 1.0, 1.0))
