// Starts the page: its kind, the loop that draws after changes, and the interface for scripts.

const KINDS = {
  lightmap: typeof LightmapPage === 'undefined' ? null : LightmapPage,
  atlas: typeof AtlasPage === 'undefined' ? null : AtlasPage,
  probe: typeof ProbePage === 'undefined' ? null : ProbePage,
  scene: typeof ScenePage === 'undefined' ? null : ScenePage,
  smoke: typeof SmokePage === 'undefined' ? null : SmokePage,
};

const BUSY_FRAME = 400;  // milliseconds between two pictures while an hour is decoded

function fail(error) {
  const message = document.getElementById('message');
  message.textContent = String(error.message ?? error);
  message.hidden = false;
}

// Shows a page until `signal`, if given, is aborted.
async function start(page, signal) {
  const {manifest} = page;
  const graphics = new Graphics(document.getElementById('view'));
  graphics.black = graphics.plain(1, 1, graphics.shared(), new Uint32Array(1), graphics.gl.NEAREST);
  const panel = new Panel(document.getElementById('panel'), manifest.title, manifest.note, signal);
  let dirty = true, last = performance.now(), drawn = -Infinity;
  const changed = () => { dirty = true; };
  const kind = new KINDS[manifest.kind](graphics, page, panel, changed);
  for (const [name, text] of manifest.figures) panel.figure(name, text);
  panel.key('h', 'H', 'fold this panel', panel.fold);
  document.getElementById('message').hidden = true;
  // For scripts; `first` is when the first picture was drawn, in milliseconds.
  const shown = {kind, page, manifest, graphics, first: undefined};
  graphics.canvas.addEventListener('webglcontextlost', (event) => {
    event.preventDefault();
    fail('the browser took the GPU from this page, which begins again when it is back');
  }, {signal});
  graphics.canvas.addEventListener('webglcontextrestored', () => location.reload(), {signal});
  const loop = (time) => {
    if (signal?.aborted) {
      // Browsers keep few contexts.
      graphics.gl.getExtension('WEBGL_lose_context')?.loseContext();
      return;
    }
    if (graphics.gl.isContextLost()) return;
    const elapsed = time - last;
    last = time;
    try {
      kind.advance?.(elapsed);
      if (kind.work?.(elapsed)) dirty = true;
      // A large scene can take longer to draw than a tile to decode, so it is drawn less often while decoding.
      const busy = kind.waiting?.length && kind.playing === undefined && time - drawn < BUSY_FRAME;
      if ((dirty || kind.playing !== undefined) && !busy) {
        dirty = false;
        drawn = time;
        kind.draw();
        shown.first ??= performance.now();
      }
    } catch (error) {
      fail(error);
      return;
    }
    requestAnimationFrame(loop);
  };
  window.addEventListener('resize', changed, {signal});
  matchMedia('(prefers-color-scheme: light)').addEventListener('change', changed, {signal});
  requestAnimationFrame(loop);
  return shown;
}

// A script awaits `wlm` and calls `kind.read(...)`; of the viewer it calls `open(files)`, which gives the same.
const begin = async () => typeof openViewer === 'undefined' ? start(await readContent()) : openViewer();
window.wlm = begin().catch((error) => { fail(error); throw error; });
