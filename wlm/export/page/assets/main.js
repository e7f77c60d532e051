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

async function start() {
  const page = await readContent(), {manifest} = page;
  const graphics = new Graphics(document.getElementById('view'));
  graphics.black = graphics.plain(1, 1, graphics.shared(), new Uint32Array(1), graphics.gl.NEAREST);
  const panel = new Panel(document.getElementById('panel'), manifest.title, manifest.note);
  let dirty = true, last = performance.now(), drawn = -Infinity;
  const changed = () => { dirty = true; };
  const kind = new KINDS[manifest.kind](graphics, page, panel, changed);
  for (const [name, text] of manifest.figures) panel.figure(name, text);
  panel.key('h', 'H', 'fold this panel', panel.fold);
  document.getElementById('message').hidden = true;
  const loop = (time) => {
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
      }
    } catch (error) {
      fail(error);
      return;
    }
    requestAnimationFrame(loop);
  };
  window.addEventListener('resize', changed);
  requestAnimationFrame(loop);
  return {kind, manifest, graphics};
}

// A script awaits `wlm` and calls `kind.read(...)`.
window.wlm = start().catch((error) => { fail(error); throw error; });
