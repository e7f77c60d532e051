"""Two models beside each other."""

import numpy as np
import pytest
from builders import probe_models, small_sets
from builders.contract import FILES, SUBJECTS
from typer.testing import CliRunner

import wlm
from wlm.cli.app import app
from wlm.errors import WlmError
from wlm.view.compare import compare


def test_lightmaps_of_two_profiles(tmp_path):
    lightmaps = small_sets.moving_light()
    for name, steps in (("a", 40), ("b", 20)):
        wlm.lightmap.compress(lightmaps, small_sets.tiny_profile(steps=steps)).save(tmp_path / f"{name}.wlm")
    small_sets.write_set(tmp_path / "set", lightmaps)
    files = tmp_path / "a.wlm", tmp_path / "b.wlm"
    alike = compare(files[0], files[0])
    assert alike.apart == 120.0 and not alike.settings and not alike.scores
    reports = []
    both = compare(*files, original=tmp_path / "set", progress=reports.append)
    assert {report.stage for report in reports} == {"decode", "score A", "score B"}
    assert both.names == ("a.wlm", "b.wlm") and alike.names == (str(files[0]),) * 2
    sizes = [max(pair) for pair in both.parts.values()]
    assert sizes == sorted(sizes, reverse=True)
    assert both.settings == {"steps": (40, 20)}
    assert both.bytes == tuple(file.stat().st_size for file in files)
    report = wlm.lightmap.evaluate(wlm.load(files[1]), wlm.lightmap.load(tmp_path / "set"))
    assert both.scores["PSNR dB"][1] == report.psnr
    assert list(both.pictures) == ["A", "B", "original"] and 5.0 < both.apart < 60.0
    page = tmp_path / "page.html"
    result = CliRunner().invoke(app, ["compare", *map(str, files), "--html", str(page)])
    assert result.exit_code == 0 and "steps" in result.output
    assert page.read_text(encoding="utf-8").count("data:image/png") == 3
    quick = small_sets.tiny_profile(steps=10).model_copy(update={"name": "quick"})
    wlm.lightmap.compress(lightmaps, quick).save(files[1])
    assert ("profile", "tiny", "quick") in compare(*files).rows()


def test_probes(tmp_path):
    for seed in (0, 1):
        probe_models.whole_model(positions=True, seed=seed).save(tmp_path / f"{seed}.wlm")
    both = compare(tmp_path / "0.wlm", tmp_path / "1.wlm")
    assert np.isfinite(both.apart) and both.apart < 40.0
    assert ("PSNR of B against A, dB", "", f"{both.apart:.2f}") in both.rows()


def test_atlases(tmp_path):
    subject = SUBJECTS["atlas-tiles"]()
    mesh = subject.data()
    for name, budget in (("a", 0.2), ("b", 0.5)):
        profile = wlm.atlas.Profile(name="t", views=2, budget=budget)
        wlm.atlas.compress(mesh, profile).save(tmp_path / f"{name}.wlm")
    both = compare(tmp_path / "a.wlm", tmp_path / "b.wlm")
    assert (
        both.names == ("a.wlm", "b.wlm")
        and both.settings == {"budget": (0.2, 0.5)}
        and both.bytes[0] < both.bytes[1]
        and both.apart > 10.0
    )


def test_what_cannot_be_compared(tmp_path):
    probe_models.whole_model().save(tmp_path / "probe.wlm")
    probe_models.whole_model(probes=100).save(tmp_path / "fewer.wlm")
    for files, said in (
        ((FILES / "lightmap.wlm", tmp_path / "probe.wlm"), "expected a model of lightmap"),
        ((tmp_path / "probe.wlm", tmp_path / "fewer.wlm"), "expected 200 probes"),
        ((tmp_path / "probe.wlm", tmp_path / "probe.wlm"), "--original"),
        ((FILES / "smoke.wlm", FILES / "smoke.wlm"), "networks are compared by wlm evaluate"),
        ((tmp_path, tmp_path), "found a folder"),
    ):
        with pytest.raises(WlmError, match=said):
            compare(*files)
