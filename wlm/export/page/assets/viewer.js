// The viewer: opens files that are dropped or chosen, in the browser alone.

// An error with the name of its file. A damaged header may name what does not exist.
function named({name}, error) {
  const damaged = error instanceof TypeError || error instanceof RangeError;
  return new Error(`${name}: ${damaged ? 'the file is damaged' : error.message}`, {cause: error});
}

// Makes the content of a page from files: one .wlm, which a mesh may come with, or EXRs of smoke.
async function openFiles(files, manifest) {
  const ending = (end) => files.filter(({name}) => name.toLowerCase().endsWith(end));
  const [file, ...more] = ending('.wlm'), meshes = ending('.glb');
  if (!file) {
    if (!ending('.exr').length) throw new Error('expected a .wlm file, or six-way lightmaps of smoke (.exr)');
    return openSmoke(ending('.exr'));
  }
  if (more.length || meshes.length > 1) throw new Error('expected one .wlm file, and at most one mesh');
  try {
    const bytes = new Uint8Array(await file.arrayBuffer()), artifact = readArtifact(bytes);
    if (artifact.system === 'smoke-network') throw new Error('a smoke network has no picture of its own; expected lightmaps predicted by it');
    const open = {lightmap: openLightmap, atlas: openAtlas, probe: openProbe}[artifact.system];
    if (!open) throw new Error(`expected a file of lightmaps, meshes or probes, found one of ${artifact.system}`);
    const page = open(artifact, manifest, bytes.length, file.name.replace(/\.wlm$/i, ''));
    if (meshes.length && artifact.system !== 'atlas') {
      const mesh = readGlb(new Uint8Array(await meshes[0].arrayBuffer()));
      const {arrays, box} = packTriangles(mesh, artifact.system === 'lightmap'), probes = page.manifest.low ? page.manifest : box;
      Object.assign(page.arrays, arrays);
      Object.assign(page.manifest, box, {
        low: box.low.map((x, k) => Math.min(x, probes.low[k])), high: box.high.map((x, k) => Math.max(x, probes.high[k])),
      });
    }
    return page;
  } catch (error) {
    throw named(file, error);
  }
}

// Rows of the table: the size of the file, of the original, and their ratio.
function compareSizes(stored, original, kind = 'half floats', name = 'file') {
  const bytes = (count) => `${count.toLocaleString('en')} bytes`;
  return [[name, bytes(stored)], [`original as ${kind}`, bytes(original)], ['ratio', `${(original / stored).toFixed(1)}×`]];
}

// A page of typed arrays, as `readContent` gives one.
function pageOf({manifest, arrays}) {
  const array = (name, Type) => {
    const held = arrays[name];
    return held ? new Type(held.buffer, held.byteOffset, held.byteLength / Type.BYTES_PER_ELEMENT) : new Type(0);
  };
  return {manifest: {exposure: 1, ...manifest}, arrays, exposed: 'exposure' in manifest, array, has: (name) => name in arrays};
}

// Opens the files that a person chooses or drops. Each has a canvas and a panel of its own, without listeners of the file
// before.
async function openViewer() {
  const {manifest} = await readContent(), message = document.getElementById('message'), home = document.getElementById('panel');
  const input = Object.assign(document.createElement('input'), {type: 'file', multiple: true, accept: '.wlm,.glb,.exr', hidden: true, id: 'file'});
  const button = Object.assign(document.createElement('button'), {onclick: () => input.click()});
  const note = Object.assign(document.createElement('p'), {textContent: manifest.note});
  const empty = () => {
    button.textContent = 'choose a file';
    home.replaceChildren(Object.assign(document.createElement('h1'), {textContent: manifest.title}), note, button, input);
    message.textContent = 'drop a file here';
  };
  let current = new AbortController();
  const open = async (files) => {
    current.abort();
    current = new AbortController();
    message.textContent = 'opening …';
    message.hidden = false;
    try {
      await new Promise(requestAnimationFrame);
      const page = pageOf(await openFiles([...files], manifest)), canvas = document.getElementById('view');
      canvas.replaceWith(canvas.cloneNode());
      home.replaceChildren();
      const shown = await start(page, current.signal);
      button.textContent = 'open another file';
      home.append(button, input);
      if (!page.exposed) shown.kind.display.expose(exposureOf(await shown.kind.brightness()));
      return shown;
    } catch (error) {
      empty();
      fail(error);
      throw error;
    } finally {
      input.value = '';
    }
  };
  input.onchange = () => { window.wlm = open(input.files); };
  document.addEventListener('dragover', (event) => event.preventDefault());
  document.addEventListener('drop', (event) => {
    event.preventDefault();
    if (event.dataTransfer.files.length) window.wlm = open(event.dataTransfer.files);
  });
  empty();
  return {open, first: performance.now()};
}

// The exposure at which all but a hundredth of the numbers above 0 are at most 0.8 on the screen.
function exposureOf(light) {
  const lit = Float32Array.from(light.filter((x) => x > 0)).sort();
  return lit.length ? WHITE / lit[Math.floor(0.99 * (lit.length - 1))] : 1;
}
