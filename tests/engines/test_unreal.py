"""Folders for Unreal: what their nodes compute of the pictures beside them, and that their scripts run through."""

import json
import re
import sys
from unittest.mock import MagicMock

import numpy as np
import pytest
from builders.atlas_meshes import charts
from builders.atlas_models import KINDS, MIXED
from builders.atlas_models import random_model as random_atlas
from builders.checks import error_of
from builders.shader_runs import run_hlsl
from builders.synthetic import random_model as random_lightmap
from PIL import Image

from wlm.atlas import exporter
from wlm.atlas.exact import decode64
from wlm.engines import export_atlas, export_lightmap
from wlm.engines import unreal as unreal_folders
from wlm.formats.exr import read_exr
from wlm.lightmap.decode import Decoder

ALL = (4, 3, 2, 1, 5, 0)


class Script:
    """A script of a folder, run with a stand-in for Unreal's module that imports pictures of their size."""

    def __init__(self, path, monkeypatch):
        self.nodes, self.links, self.settings, self.slots = [], [], {}, []
        self.unreal = MagicMock()
        self.unreal.Texture2D, self.unreal.StaticMesh = type("Texture2D", (MagicMock,), {}), type("Mesh", (), {})
        self.unreal.MaterialInstanceConstant = type("Instance", (), {})
        self.unreal.AssetImportTask = self.task
        self.unreal.CustomInput = self.held
        self.unreal.MaterialEditingLibrary.create_material_expression = self.node
        self.unreal.MaterialEditingLibrary.connect_material_expressions = self.link
        mesh = self.unreal.StaticMesh()
        mesh.get_name, mesh.set_material = lambda: "mesh", lambda number, material: self.slots.append(number)
        mesh.get_editor_property = lambda name: [MagicMock()]
        self.mesh = mesh
        self.unreal.get_editor_subsystem.return_value.get_num_uv_channels.return_value = 2
        monkeypatch.setitem(sys.modules, "unreal", self.unreal)
        self.names = {"__file__": str(path), "__name__": "script"}
        exec(compile(path.read_text(), str(path), "exec"), self.names)

    def held(self):
        values = {}
        made = MagicMock(values=values)
        made.set_editor_property = values.__setitem__
        return made

    def task(self):
        made = self.held()
        made.get_objects = lambda: [self.object(made.values["filename"])]
        return made

    def object(self, file):
        if file.endswith(".glb"):
            return self.mesh
        name = file.rpartition("/")[2]
        pixels = pixels_of(file)
        texture = self.unreal.Texture2D()
        texture.blueprint_get_size_x.return_value, texture.blueprint_get_size_y.return_value = pixels.shape[1::-1]
        texture.set_editor_property = self.settings.setdefault(name, {}).__setitem__
        return texture

    def node(self, material, kind):
        made = self.held()
        made.kind = kind
        self.nodes.append(made)
        return made

    def link(self, source, output, target, pin):
        self.links.append((target, pin))
        return True

    def customs(self):
        """The Custom nodes' codes, and the inputs that something is joined to."""
        found = [each for each in self.nodes if each.kind is self.unreal.MaterialExpressionCustom]
        return [(each.values["code"], [pin for target, pin in self.links if target is each]) for each in found]


def pixels_of(file):
    """A picture as Unreal has it: of bytes levels from 0 to 1."""
    if file.endswith(".tga"):
        return np.asarray(Image.open(file).convert("RGBA"))
    pixels, _ = read_exr(file)
    return np.pad(pixels, ((0, 0), (0, 0), (0, 4 - pixels.shape[2])))


def computed(code, inputs, size, place, bound, folder, numbers=None):
    """What a Custom node gives at `place`, an expression of the pixel."""
    structure, _, body = code.partition("WlmNode wlm;")
    numbers = numbers or {}
    textures = [name for name in inputs if name in bound and name != "u_points"]
    declared = "".join(f"Texture2D<float4> {name};\n" for name in (*textures, *({"u_points"} & set(bound))))
    for name in textures:
        if f"{name}Sampler" in body:
            declared += f"SamplerState {name}Sampler;\n"
    declared += "".join(f"static const float {name} = {value};\n" for name, value in numbers.items())
    assert set(inputs) == {"UV", *textures, *numbers}
    text = f"{declared}{structure}float3 wlm_custom(float2 UV)\n{{\nWlmNode wlm;{body}\n}}\n"
    return run_hlsl(text, f"float4(wlm_custom({place}), 1.0)", size, bound, folder)[..., :3]


@pytest.mark.parametrize("kind", [*KINDS, MIXED])
def test_an_atlas_node_gives_its_light(kind, tmp_path, monkeypatch):
    mesh = charts()
    model = random_atlas(mesh, kind)
    exporter.export(model, tmp_path / "made", mesh)
    export_atlas(exporter.read_folder(tmp_path / "made"), tmp_path / "out", "unreal")
    script = Script(tmp_path / "out" / "wlm_atlas.py", monkeypatch)
    files = json.loads((tmp_path / "out" / "atlas.json").read_text())["textures"]
    assert set(script.settings) == set(files.values()) and script.slots == [0]
    ((code, inputs),) = script.customs()
    uv = np.random.default_rng(0).random((1000, 2)).astype(np.float32)
    if model.method == "tiles":
        place = (uv * [model.width, model.height] - 0.5) / model.profile.tile
        uv = uv[np.abs(place - np.rint(place)).min(1) > 1e-4]
    bound = {f"wlm_atlas_{name}": pixels_of(str(tmp_path / "out" / file)) for name, file in files.items()}
    # What is filtered are halves there; a table of coordinates is floats, which WebGPU doesn't filter.
    bound = {
        name: v.astype(np.float16) if model.method == "cascade" or "lut" not in name else v for name, v in bound.items()
    }
    bound["u_points"] = np.pad(uv, ((0, 0), (0, 2)))[None]
    found = computed(code, inputs, (1, len(uv)), "u_points.Load(int3(pixel, 0)).xy", bound, tmp_path)[0]
    allowed = 3.0 / 512 * 2 * (1 + 22 * (model.method == "cascade"))
    np.testing.assert_allclose(found, decode64(model, uv), rtol=0, atol=allowed)


@pytest.mark.parametrize("kinds", [ALL, (2, 1, 0, 2)], ids=str)
def test_lightmap_nodes_decode_an_hour_and_fill_its_gaps(kinds, tmp_path, monkeypatch):
    mask = np.ones((128 * len(kinds) // 2 - 20, 247), bool)
    mask[40:42, 60:62] = False
    model = random_lightmap(kinds, mask=mask)
    export_lightmap(model, tmp_path, "unreal")
    script = Script(tmp_path / "wlm_lightmap.py", monkeypatch)
    decode, fill = script.customs()
    pictures = {path.stem: pixels_of(str(path)) for path in tmp_path.iterdir() if path.suffix in (".tga", ".exr")}
    assert set(script.settings) == {path.name for path in tmp_path.iterdir() if path.suffix in (".tga", ".exr")}
    bound = {f"wlm_lightmap_{name}": values for name, values in pictures.items()}
    size = mask.shape
    place = f"(float2(pixel) + 0.5) / float2({size[1]}, {size[0]})"
    for number in (0, 2):
        found = computed(*decode, size, place, bound, tmp_path, {"wlm_hour": float(number)})
        filled = bound | {"Decoded": np.pad(found, ((0, 0), (0, 0), (0, 1)))}
        found = computed(*fill, size, place, filled, tmp_path)
        want = Decoder(model).frame(float(model.times[number]))
        np.testing.assert_allclose(found, want, rtol=0, atol=want.max() / 255)
    for time in (0.0, 3.0, 7.5, 12.9, 23.0):
        assert script.names["neighbours"](time) == pytest.approx(model.axis.neighbours(time))
    script.names["set_hour"](12.9)
    values = script.unreal.MaterialLibrary.set_scalar_parameter_value.call_args.args
    assert values[2:] == ("Share", pytest.approx(model.axis.neighbours(12.9)[2]))


def test_times_without_a_day(tmp_path, monkeypatch):
    model = random_lightmap((2, 1), period=None)
    export_lightmap(model, tmp_path, "unreal")
    neighbours = Script(tmp_path / "wlm_lightmap.py", monkeypatch).names["neighbours"]
    for time in (0.0, 7.5, 10.0, 19.0):
        early, late, share = model.axis.neighbours(time)
        found = neighbours(time)
        mixed = lambda pair: (1 - pair[2]) * pair[0] + pair[2] * pair[1]  # noqa: E731
        assert mixed(found) == pytest.approx(mixed((early, late, share)))
    assert neighbours(-5.0) == (0, 1, 0.0) and neighbours(50.0)[2] == 1.0


def test_what_unreal_does_not_import(tmp_path, monkeypatch):
    monkeypatch.setattr(unreal_folders, "_MOST_SIDE", 127)
    line = error_of(export_lightmap, random_lightmap(), tmp_path / "out", "unreal")
    assert re.search(r"cannot export for unreal: uv is \d+x\d+ texels, of at most 127 a side", line)
    assert not (tmp_path / "out").exists()
    assert unreal_folders.asset_name("a b/ç.1") == "a_b___1"
