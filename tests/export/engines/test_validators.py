"""Exported files, read by others: meshes by Khronos' glTF validator, textures by ktx-parse.

They come from npm: WLM_THREE names the folder of `three`, and `gltf-validator` and `ktx-parse` lie beside it.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from builders.atlas_meshes import charts
from builders.atlas_models import KINDS, MIXED, random_model

from wlm.export import export
from wlm.formats.ktx2 import VK_FORMATS

_SCRIPT = """
const [folder, packages] = process.argv.slice(-2), fs = require('fs');
(async () => {
  const validator = require(`${packages}/gltf-validator`);
  const {read} = await import(`${packages}/ktx-parse/dist/index.mjs`);
  const found = {};
  for (const name of fs.readdirSync(folder)) {
    const bytes = new Uint8Array(fs.readFileSync(`${folder}/${name}`));
    if (name.endsWith('.glb')) {
      const {issues: {messages}} = await validator.validateBytes(bytes);
      found[name] = messages.filter(({severity}) => severity < 2).map(({code, message}) => `${code}: ${message}`);
    } else if (name.endsWith('.ktx2')) {
      const {vkFormat, pixelWidth, pixelHeight, levels} = read(bytes);
      found[name] = [vkFormat, pixelWidth, pixelHeight, levels.map(({levelData}) => levelData.byteLength)];
    }
  }
  console.log(JSON.stringify(found));
})();
"""


@pytest.mark.parametrize(
    ("kind", "stored"), [*((kind, "half") for kind in KINDS), ("plain", "bc6h"), ("tiles", "rgb9e5"), (MIXED, "mixed")]
)
def test_others_read_what_an_atlas_exports(kind, stored, tmp_path):
    packages = Path(os.environ.get("WLM_THREE", "/none")).resolve().parent
    if not all((packages / name).is_dir() for name in ("gltf-validator", "ktx-parse")):
        pytest.skip("no gltf-validator and ktx-parse beside WLM_THREE: npm install three gltf-validator ktx-parse")
    if shutil.which("node") is None:
        pytest.skip("no node: install nodejs")
    model = random_model(charts(), kind, stored)
    export(model, tmp_path)
    words = ["node", "-e", _SCRIPT, "--", tmp_path, packages]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found.pop("mesh.glb") == []
    sizes = {"colour.ktx2": model.texels[0].shape, "lut.ktx2": model.lut.shape}
    sizes["blocks.ktx2"] = model.block_texels.shape[1:]
    assert set(found) == {path.name for path in tmp_path.glob("*.ktx2")}
    for name, (number, width, height, levels) in found.items():
        assert (height, width) == sizes[name][:2] and len(levels) == 1 and levels[0] > 0
        # Those that three.js' loader takes, but for BC6H and the table of tiles.
        assert number in {97, 103, 123, VK_FORMATS["BC6H_UFLOAT_BLOCK"], VK_FORMATS["R16G16_UINT"]}
