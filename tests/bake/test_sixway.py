"""Six-way lightmaps by path tracing are those of the march, and more where light is scattered again."""

import json

import numpy as np
import pytest
from builders.smoke_plumes import facing, plume
from typer.testing import CliRunner

from wlm.bake.sixway import SixWayScene, bake_sixway
from wlm.cli import app
from wlm.fluid.volume import save_volume
from wlm.smoke import bake, read_six_way


def test_single_scattering_is_that_of_the_march():
    volume = plume()
    camera = facing(volume, size=12)
    traced, error = bake_sixway(volume, camera, SixWayScene(smoke="-", samples=256, highest=1))
    marched = bake(volume, camera)
    difference = (traced.lightmaps - marched.lightmaps).double()
    power = float(marched.lightmaps.double().square().mean()) ** 0.5
    assert float(difference.square().mean()) ** 0.5 / power < 1.3 * error < 0.1
    # Each direction has its own light: none stands for another.
    assert traced.lightmaps.mean((1, 2)).numpy() == pytest.approx(marched.lightmaps.mean((1, 2)).numpy(), rel=0.05)
    assert (traced.transparency == marched.transparency).all()


def test_the_command_bakes_all_orders(tmp_path):
    volume = plume()
    save_volume(tmp_path / "smoke.npz", volume)
    scene = {"smoke": "smoke.npz", "camera": {"resolution": 12}, "samples": 64, "extinction": volume.extinction}
    (tmp_path / "scene.yaml").write_text(json.dumps(scene))
    run = CliRunner().invoke(app, ["bake", "sixway", str(tmp_path / "scene.yaml"), "-o", str(tmp_path / "six.exr")])
    assert run.exit_code == 0, run.stderr
    six = read_six_way(tmp_path / "six.exr")
    once = bake(volume, six.camera)
    assert float(six.lightmaps.mean()) > 1.1 * float(once.lightmaps.mean())
    assert np.isfinite(six.lightmaps.numpy()).all()
