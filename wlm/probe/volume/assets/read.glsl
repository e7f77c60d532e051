// Reads the light of a cascaded lighting volume (Gaussian Compression for Precomputed Indirect Illumination, section
// 3.4) at a point, from three buffers. For GLSL 4.30 and later, with or without Vulkan; include
// it below #version. It fits every volume of @outputs@ numbers per block.
//
// Buffer volume, 32-bit words, little-endian:
//   0    levels L, slots of all windows, numbers per block, rows of the pool, number of the frame, probes, blocks near
//        probes, longest side of a window in blocks: integers
//   8    L times 16 words, the finest level first: 4 floats, position of the viewer in the window in blocks, from the
//        centre of the first block, and 1 / side of a block; 3 integers, the first block of the window; 1, the first
//        slot of the level; 3, the blocks along the axes of the window; 1, the first of its blocks near probes; 3, the
//        first block of the window in the frame before; 1, the side of a block divided by that of the finest level
// Buffer pages, two signed 16-bit integers a word, the first in the lower half, one for each slot. Block b of a level
//        has slot first + ((b.x mod sides.x) * sides.y + (b.y mod sides.y)) * sides.z + (b.z mod sides.z). Its entry is
//        its row of the pool, or negative where the block is missing.
// Buffer pool, rows of @row_words@ words: a float, the factor of the row, then @outputs@ half floats, two a word.
//
// Moving the viewer changes the buffer volume; a new block changes one entry of pages and one row of the pool. The
// buffers are storage buffers, unless WLM_VOLUME_HEAD(i), WLM_VOLUME_PAGE(i) and WLM_VOLUME_POOL(i) are defined before
// this file as other ways to read word i.
@buffers@
const int WLM_VOLUME_OUTPUTS = @outputs@;

int wlm_volume_row(int slot)
{
    uint word = WLM_VOLUME_PAGE(slot / 2);
    return slot % 2 == 0 ? int(word << 16u) >> 16 : int(word) >> 16;
}

// The light at a point relative to the viewer: scene position less viewpoint. With the unit normal of its surface the
// light is read half a block in front of it, so that the far side of a wall contributes less; with a normal of 0 it is
// read at the point. The finest level that has all eight surrounding blocks answers; the weight of missing blocks
// passes on to the next level. Returns the share of the weight that was found, 0 to 1; where it is 0, so are the
// values.
float wlm_volume_read(vec3 p, vec3 normal, out float values[@outputs@])
{
    int levels = int(WLM_VOLUME_HEAD(0));
    for (int c = 0; c < WLM_VOLUME_OUTPUTS; ++c)
        values[c] = 0.0;
    float left = 1.0;
    float covered = 0.0;
    for (int level = 0; level < levels && left > 0.0; ++level) {
        int at = @head@ + @level_words@ * level;
        float scale = uintBitsToFloat(WLM_VOLUME_HEAD(at + 3));
        float x = p.x * scale + uintBitsToFloat(WLM_VOLUME_HEAD(at)) + 0.5 * normal.x;
        float y = p.y * scale + uintBitsToFloat(WLM_VOLUME_HEAD(at + 1)) + 0.5 * normal.y;
        float z = p.z * scale + uintBitsToFloat(WLM_VOLUME_HEAD(at + 2)) + 0.5 * normal.z;
        int sx = int(WLM_VOLUME_HEAD(at + 8));
        int sy = int(WLM_VOLUME_HEAD(at + 9));
        int sz = int(WLM_VOLUME_HEAD(at + 10));
        if (min(x, min(y, z)) >= -1.0 && x < float(sx) && y < float(sy) && z < float(sz)) {
            float fx = x - floor(x);
            float fy = y - floor(y);
            float fz = z - floor(z);
            int i = int(floor(x));
            int j = int(floor(y));
            int k = int(floor(z));
            float missing = 0.0;
            float here = 0.0;
            for (int corner = 0; corner < 8; ++corner) {
                int u = i + corner % 2;
                int v = j + corner / 2 % 2;
                int w = k + corner / 4;
                float share = (corner % 2 == 1 ? fx : 1.0 - fx) * (corner / 2 % 2 == 1 ? fy : 1.0 - fy)
                    * (corner / 4 == 1 ? fz : 1.0 - fz);
                int row = -1;
                if (min(u, min(v, w)) >= 0 && u < sx && v < sy && w < sz) {
                    u = (u + int(WLM_VOLUME_HEAD(at + 4))) % sx; // no block has a negative coordinate
                    v = (v + int(WLM_VOLUME_HEAD(at + 5))) % sy;
                    w = (w + int(WLM_VOLUME_HEAD(at + 6))) % sz;
                    int slot = int(WLM_VOLUME_HEAD(at + 7)) + (u * sy + v) * sz + w;
                    row = wlm_volume_row(slot);
                }
                if (row < 0) {
                    missing += share;
                } else if (share > 0.0) {
                    here += share;
                    int first = row * @row_words@;
                    float factor = left * share * uintBitsToFloat(WLM_VOLUME_POOL(first));
                    for (int c = 0; c < WLM_VOLUME_OUTPUTS; ++c) {
                        vec2 pair = unpackHalf2x16(WLM_VOLUME_POOL(first + 1 + c / 2));
                        values[c] += factor * (c % 2 == 0 ? pair.x : pair.y);
                    }
                }
            }
            if (here > 0.0) {
                covered += left * here;
                left *= missing;
            }
        }
    }
    for (int c = 0; c < WLM_VOLUME_OUTPUTS; ++c)
        values[c] = covered > 0.0 ? values[c] / covered : 0.0;
    return min(covered, 1.0);
}
