// Computes the table of an hour that the shader of a lightmap reads, from bundle.json and networks.bin (see "about" there).

// The stored times before and after a time (their indices), the weight of the later one, and tau.
function wlmPlace(lightmap, time) {
  const {times, period, tau, time_axis: axis} = lightmap, count = times.length;
  if (period) time = ((time % period) + period) % period;
  else time = Math.min(Math.max(time, times[0]), times[count - 1]);
  let before = times.findLastIndex((t) => t <= time), after = before + 1, span, since;
  if (period) {
    [before, after] = [(before + count) % count, after % count];
    span = (times[after] - times[before] + period) % period || period;
    since = (time - times[before] + period) % period;
  } else {
    after = Math.min(after, count - 1);
    [span, since] = [times[after] - times[before] || 1, time - times[before]];
  }
  const share = count > 1 ? since / span : 0;
  let place = axis.rule === 'paper' && period ? time / period
    : tau[before] + share * (axis.repeats ? 1 / count : tau[after] - tau[before]);
  if (axis.repeats) place -= Math.floor(place);
  return {before, after, share, tau: place};
}

// The times to decode for a given time, each with its weight in linear light: one or two stored times; if the networks
// interpolate, the time itself. The light of a single stored time is the same at all times.
function wlmReads(lightmap, time) {
  const now = wlmPlace(lightmap, time);
  if (lightmap.interpolation === 'network' && lightmap.times.length > 1) return [{...now, key: time, weight: 1}];
  const stored = (k, weight) => ({before: k, after: k, share: 0, tau: lightmap.tau[k], key: k, weight});
  return [stored(now.before, 1 - now.share), stored(now.after, now.share)].filter((read) => read.weight > 0);
}

// The two texels of an axis that a linear filter reads at tau, and the weight of the second.
function wlmBetween(tau, count, repeats) {
  const position = tau * count - 0.5, low = Math.floor(position);
  const texel = (i) => repeats ? (i + count) % count : Math.min(Math.max(i, 0), count - 1);
  return [texel(low), texel(low + 1), position - low, 0];
}

// The table of one entry of `wlmReads`: RGBA floats in rows of 1,024 texels.
function wlmTable(lightmap, networks, now) {
  const {time_axis: axis, record, tile_columns: columns, tile_size: side, images} = lightmap;
  const count = columns * Math.ceil(lightmap.height / side), fours = 2 + record * count;
  const table = new Float32Array(4096 * Math.ceil(fours / 1024)), wide = Math.ceil(lightmap.hidden / 4);
  const put = (four, ...values) => table.set(values.flat(), 4 * four);
  const mixed = (rows) => rows[now.before].map((v, c) => v + now.share * (rows[now.after][c] - v));
  put(0, wlmBetween(now.tau, lightmap.slices, axis.repeats).slice(0, 3), columns);
  if (images.planes) put(1, wlmBetween(now.tau, images.planes.size[1], axis.repeats));
  for (const tile of lightmap.tiles) {
    const at = 2 + record * tile.number, codes = {constant: 1, dynamic: 3, frames: 4};
    put(at, codes[tile.kind], tile.image ?? 0, tile.network_four ?? 0, 0);
    if (tile.kind === 'constant') {
      put(at + 1, mixed(tile.radiance).map((v) => v ** (1 / lightmap.gamma)));
    } else if (tile.kind === 'frames') {
      table[4 * at + 3] = now.share;
      for (const [first, image] of [[1, now.before], [3, now.after]]) {
        put(at + first, tile.least[image], image, tile.greatest[image]);
      }
    } else {
      const scale = mixed(tile.scale), turn = axis.turn * now.tau;
      put(at + 1, tile.shift.map((v, c) => v * scale[c]));
      put(at + 2, tile.spread.map((v, c) => v * scale[c]));
      const time = [turn, 2 * turn].flatMap((a) => [Math.sin(a), Math.cos(a)]);
      const first = 4 * (tile.network_four + 12 * wide), row = 4 * wide;
      for (let j = 0; j < row; ++j) {
        let bias = networks[first + time.length * row + j];
        time.forEach((v, c) => { bias += v * networks[first + c * row + j]; });
        table[4 * (at + 3) + j] = bias;
      }
    }
  }
  return table;
}
