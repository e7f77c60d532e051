"""Scripts for Unreal's editor, run with a stand-in for its module, and the code of the nodes that they make."""

import sys
from unittest.mock import MagicMock

import numpy as np
import pytest
from builders.shader_runs import run_hlsl
from PIL import Image

from wlm.formats.exr import read_exr


class Script:
    """A script of a folder, run with a stand-in that imports pictures of their size."""

    def __init__(self, path, monkeypatch, actors=()):
        self.nodes, self.links, self.settings, self.slots = [], [], {}, []
        self.unreal = unreal = MagicMock()
        unreal.Texture2D, unreal.StaticMesh = type("Texture2D", (MagicMock,), {}), type("Mesh", (), {})
        unreal.MaterialInstanceConstant = type("Instance", (), {})
        unreal.AssetImportTask, unreal.CustomInput = self._task, self._held
        unreal.MaterialEditingLibrary.create_material_expression = self._node
        unreal.MaterialEditingLibrary.connect_material_expressions = self._link
        unreal.LinearColor = lambda *values: values
        self.mesh = unreal.StaticMesh()
        self.mesh.get_name, self.mesh.set_material = lambda: "mesh", lambda number, material: self.slots.append(number)
        self.mesh.get_editor_property = lambda name: [MagicMock()]
        editor = unreal.get_editor_subsystem.return_value
        editor.get_num_uv_channels.return_value = 2
        editor.get_all_level_actors.return_value = [self._actor(name) for name in actors]
        monkeypatch.setitem(sys.modules, "unreal", unreal)
        self.names = {"__file__": str(path), "__name__": "script"}
        exec(compile(path.read_text(), str(path), "exec"), self.names)

    def _held(self):
        values = {}
        made = MagicMock(values=values)
        made.set_editor_property = values.__setitem__
        return made

    def _actor(self, name):
        part = MagicMock()
        part.get_num_materials.return_value = 1
        part.set_material = lambda slot, material: self.slots.append((name, slot))
        actor = MagicMock()
        actor.get_actor_label.return_value = name
        actor.get_components_by_class.return_value = [part]
        return actor

    def _task(self):
        made = self._held()
        made.get_objects = lambda: [self._object(made.values["filename"])]
        return made

    def _object(self, file):
        if file.endswith(".glb"):
            return self.mesh
        pixels = pixels_of(file)
        texture = self.unreal.Texture2D()
        texture.blueprint_get_size_x.return_value, texture.blueprint_get_size_y.return_value = pixels.shape[1::-1]
        texture.set_editor_property = self.settings.setdefault(file.rpartition("/")[2], {}).__setitem__
        return texture

    def _node(self, material, kind):
        made = self._held()
        made.kind = kind
        self.nodes.append(made)
        return made

    def _link(self, source, output, target, pin):
        self.links.append((target, pin))
        return True

    def customs(self):
        """The Custom nodes' codes, and the inputs that something is joined to."""
        found = [each for each in self.nodes if each.kind is self.unreal.MaterialExpressionCustom]
        return [(each.values["code"], [pin for target, pin in self.links if target is each]) for each in found]


def pixels_of(file):
    """A picture as Unreal has it: of bytes levels from 0 to 1."""
    if file.endswith((".tga", ".png")):
        return np.asarray(Image.open(file).convert("RGBA"))
    pixels, _ = read_exr(file)
    return np.pad(pixels, ((0, 0), (0, 0), (0, 4 - pixels.shape[2])))


def node_gives(code, inputs, size, place, bound, folder, numbers=None, channels=3):
    """Computes the output of a Custom node, float32 [*size, channels]."""
    numbers = numbers or {}
    structure, _, body = code.partition("WlmNode wlm;")
    textures = [name for name in inputs if name in bound]
    assert set(inputs) == {"UV", *textures, *numbers}
    declared = "".join(f"Texture2D<float4> {name};\n" for name in (*textures, *({"points"} & set(bound))))
    declared += "".join(f"SamplerState {name}Sampler;\n" for name in textures if f"{name}Sampler" in body)
    constants = "".join(f"{each};\n" for each in numbers.values())
    # A structure within a function is beyond glslang.
    # Nor has a compute shader derivatives.
    flat = "#define ddx(a) float2(0.0, 0.0)\n#define ddy(a) float2(0.0, 0.0)\n"
    head = f"{flat}{declared}{structure}float{channels} wlm_custom(float2 UV, int2 pixel)"
    text = f"{head}\n{{\n{constants}WlmNode wlm;{body}\n}}\n"
    called = f"wlm_custom({place}, pixel)"
    whole = called if channels == 4 else f"float4({called}, 1.0)"
    return run_hlsl(text, whole, size, bound, folder)[..., :channels]


def assert_csharp_parses(path) -> None:
    """Checks the syntax of a C# file; skips where the parser is not installed."""
    sharp = pytest.importorskip("tree_sitter_c_sharp", reason="tree-sitter-c-sharp is not installed (pip, extra test)")
    from tree_sitter import Language, Parser

    assert not Parser(Language(sharp.language())).parse(path.read_bytes()).root_node.has_error, path


def assert_gdscript_parses(path) -> None:
    """Checks the syntax of a script of Godot; skips where the parser is not installed."""
    pytest.importorskip("gdtoolkit", reason="gdtoolkit is not installed (pip, extra test)")
    from gdtoolkit.parser import parser

    parser.parse(path.read_text())
