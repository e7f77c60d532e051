"""Exported meshes, read by Khronos' glTF validator.

It comes from npm: WLM_THREE names the folder of `three`, and `gltf-validator` lies beside it.
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

_SCRIPT = """
const [folder, packages] = process.argv.slice(-2), fs = require('fs');
(async () => {
  const validator = require(`${packages}/gltf-validator`);
  const found = {};
  for (const name of fs.readdirSync(folder)) {
    const bytes = new Uint8Array(fs.readFileSync(`${folder}/${name}`));
    if (name.endsWith('.glb')) {
      const {issues: {messages}} = await validator.validateBytes(bytes);
      found[name] = messages.filter(({severity}) => severity < 2).map(({code, message}) => `${code}: ${message}`);
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
    if not (packages / "gltf-validator").is_dir():
        pytest.skip("no gltf-validator beside WLM_THREE: npm install three gltf-validator")
    if shutil.which("node") is None:
        pytest.skip("no node: install nodejs")
    model = random_model(charts(), kind, stored)
    export(model, tmp_path)
    words = ["node", "-e", _SCRIPT, "--", tmp_path, packages]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"mesh.glb": []}
