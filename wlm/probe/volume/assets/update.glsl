int wlm_update_number(int i)
{
    return int(WLM_UPDATE_HEAD(i));
}

ivec3 wlm_update_three(int i)
{
    return ivec3(wlm_update_number(i), wlm_update_number(i + 1), wlm_update_number(i + 2));
}

// The first word of a level in the buffer head.
int wlm_update_at(int level)
{
    return 8 + 16 * level;
}

// The place, from 0 to side - 1, of a block whose coordinate has the remainder i, in a window from base >= 0 on.
int wlm_update_wrap(int i, int base, int side)
{
    int r = i - base % side;
    return r < 0 ? r + side : r;
}

uint wlm_update_spread(int i)
{
    uint x = uint(i) & 1023u;
    x = (x | (x << 16)) & 50331903u;
    x = (x | (x << 8)) & 50393103u;
    x = (x | (x << 4)) & 51130563u;
    return (x | (x << 2)) & 153391689u;
}

int wlm_update_compact(uint i)
{
    uint x = i & 153391689u;
    x = (x | (x >> 2)) & 51130563u;
    x = (x | (x >> 4)) & 50393103u;
    x = (x | (x >> 8)) & 50331903u;
    return int((x | (x >> 16)) & 1023u);
}

// The Morton key of a cell: the interleaved bits of three coordinates of 21 bits, as the low and the high word.
uvec2 wlm_update_key(ivec3 cell)
{
    uint low = wlm_update_spread(cell.x) | (wlm_update_spread(cell.y) << 1) | (wlm_update_spread(cell.z) << 2);
    uint high = wlm_update_spread(cell.x >> 10) | (wlm_update_spread(cell.y >> 10) << 1);
    high = high | (wlm_update_spread(cell.z >> 10) << 2);
    uint top = uint(cell.x >> 20) | (uint(cell.y >> 20) << 1) | (uint(cell.z >> 20) << 2);
    return uvec2(low | (high << 30), (high >> 2) | (top << 28));
}

ivec3 wlm_update_cell(uvec2 key)
{
    uint high = (key.x >> 30) | (key.y << 2);
    int x = wlm_update_compact(key.x) + 1024 * wlm_update_compact(high) + 1048576 * int((key.y >> 28) & 1u);
    int y = wlm_update_compact(key.x >> 1) + 1024 * wlm_update_compact(high >> 1) + 1048576 * int((key.y >> 29) & 1u);
    int z = wlm_update_compact(key.x >> 2) + 1024 * wlm_update_compact(high >> 2) + 1048576 * int((key.y >> 30) & 1u);
    return ivec3(x, y, z);
}

// The first entry of a sorted list whose key is not less than a key, or, with `beyond`, is above it; `high` if none is.
int wlm_update_search(int word, int stride, int low, int high, uvec2 key, bool beyond)
{
    for (int n = 0; n < 32; ++n) {
        if (low < high) {
            int middle = (low + high) / 2;
            uvec2 found = uvec2(WLM_UPDATE_INDEX(word + stride * middle), WLM_UPDATE_INDEX(word + stride * middle + 1));
            bool less = found.x < key.x || (beyond && found.x == key.x);
            if (found.y < key.y || (found.y == key.y && less))
                low = middle + 1;
            else
                high = middle;
        }
    }
    return low;
}

// The number of a block in the list of blocks near probes, or -1.
int wlm_update_find(int level, ivec3 block)
{
    if (min(block.x, min(block.y, block.z)) < 0 || max(block.x, max(block.y, block.z)) >= 1048576)
        return -1;
    int last = wlm_update_number(6);
    if (level + 1 < wlm_update_number(0))
        last = wlm_update_number(wlm_update_at(level + 1) + 11);
    uvec2 key = wlm_update_key(block);
    int i = wlm_update_search(0, 2, wlm_update_number(wlm_update_at(level) + 11), last, key, false);
    if (i < last) {
        if (WLM_UPDATE_INDEX(2 * i) == key.x && WLM_UPDATE_INDEX(2 * i + 1) == key.y)
            return i;
    }
    return -1;
}

int wlm_update_level(int slot)
{
    int level = 0;
    for (int n = 1; n < wlm_update_number(0); ++n) {
        if (slot >= wlm_update_number(wlm_update_at(n) + 7))
            level = n;
    }
    return level;
}

// The place of a slot's block in its window, from 0 along each axis.
ivec3 wlm_update_local(int level, int slot)
{
    int at = wlm_update_at(level);
    ivec3 base = wlm_update_three(at + 4);
    ivec3 sides = wlm_update_three(at + 8);
    int i = slot - wlm_update_number(at + 7);
    int x = wlm_update_wrap(i / (sides.y * sides.z), base.x, sides.x);
    int y = wlm_update_wrap(i / sides.z % sides.y, base.y, sides.y);
    return ivec3(x, y, wlm_update_wrap(i % sides.z, base.z, sides.z));
}

// The squared distance of a block from the viewer, who is moved into the window if outside of it.
float wlm_update_distance(int level, ivec3 local)
{
    int at = wlm_update_at(level);
    vec3 view = vec3(0.0, 0.0, 0.0);
    view.x = uintBitsToFloat(WLM_UPDATE_HEAD(at));
    view.y = uintBitsToFloat(WLM_UPDATE_HEAD(at + 1));
    view.z = uintBitsToFloat(WLM_UPDATE_HEAD(at + 2));
    vec3 most = vec3(wlm_update_three(at + 8)) - vec3(1.0, 1.0, 1.0);
    vec3 d = vec3(local) - clamp(view, vec3(0.0, 0.0, 0.0), most);
    return d.x * d.x + d.y * d.y + d.z * d.z;
}

int wlm_update_bin(float away)
{
    float side = float(wlm_update_number(7));
    return min(int(away * 1024.0 / (3.0 * side * side)), 1023);
}

int wlm_update_page(int slot)
{
    uint word = WLM_UPDATE_PAGES(slot / 2);
    return slot % 2 == 0 ? int(word << 16) >> 16 : int(word) >> 16;
}

// The entry of the page table for a slot's block: its row, -2 where its light is missing, or -1 if no probe is near.
int wlm_update_enter(int slot)
{
    int row = wlm_update_page(slot);
    int level = wlm_update_level(slot);
    int at = wlm_update_at(level);
    ivec3 local = wlm_update_local(level, slot);
    ivec3 block = wlm_update_three(at + 4) + local;
    ivec3 old = block - wlm_update_three(at + 12);
    ivec3 sides = wlm_update_three(at + 8);
    if (min(old.x, min(old.y, old.z)) < 0 || old.x >= sides.x || old.y >= sides.y || old.z >= sides.z) {
        row = -1;
        int wanted = wlm_update_find(level, block);
        if (wanted >= 0)
            row = int(WLM_UPDATE_TABLES(wanted));
        if (wanted >= 0 && row < 0)
            row = -2;
    }
    if (row >= 0 && wlm_update_number(3) < wlm_update_number(6))
        WLM_UPDATE_TABLES(wlm_update_number(6) + row) = WLM_UPDATE_HEAD(4);
    if (row == -2) {
        int bin = wlm_update_bin(wlm_update_distance(level, local));
        atomicAdd(WLM_UPDATE_COUNTS(2 + bin), 1u);
        atomicAdd(WLM_UPDATE_COUNTS(1026 + bin / 32), 1u);
    }
    return row;
}

// 1. For each word of pages: moves the windows.
void wlm_update_scroll(int i)
{
    if (i < WLM_UPDATE_BUDGET)
        WLM_UPDATE_WORK(1 + 8 * i) = 4294967295u;
    if (2 * i < wlm_update_number(1)) {
        int first = wlm_update_enter(2 * i);
        int second = -1;
        if (2 * i + 1 < wlm_update_number(1))
            second = wlm_update_enter(2 * i + 1);
        WLM_UPDATE_PAGES(i) = (uint(first) & 65535u) | (uint(second) << 16);
    }
}

// 2. One thread: the distance within which enough blocks wait.
void wlm_update_limit(int i)
{
    if (i == 0) {
        int total = 0;
        int before = 0;
        int group = -1;
        for (int n = 0; n < 32; ++n) {
            int count = int(WLM_UPDATE_COUNTS(1026 + n));
            if (group < 0 && (total + count >= WLM_UPDATE_BUDGET || n == 31)) {
                group = n;
                before = total;
            }
            total += count;
        }
        int limit = -1;
        for (int n = 0; n < 32; ++n) {
            before += int(WLM_UPDATE_COUNTS(2 + 32 * group + n));
            if (limit < 0 && (before >= WLM_UPDATE_BUDGET || n == 31))
                limit = 32 * group + n;
        }
        WLM_UPDATE_WORK(0) = uint(limit);
        WLM_UPDATE_COUNTS(1) = uint(total);
    }
}

// 3. For each slot: lists the blocks that wait within this distance.
void wlm_update_gather(int slot)
{
    if (slot < wlm_update_number(1)) {
        if (wlm_update_page(slot) == -2) {
            int level = wlm_update_level(slot);
            float away = wlm_update_distance(level, wlm_update_local(level, slot));
            if (wlm_update_bin(away) <= int(WLM_UPDATE_WORK(0))) {
                int n = int(atomicAdd(WLM_UPDATE_COUNTS(0), 1u));
                if (n < WLM_UPDATE_MOST) {
                    WLM_UPDATE_WORK(WLM_UPDATE_RANKED + 2 * n) = uint(slot);
                    WLM_UPDATE_WORK(WLM_UPDATE_RANKED + 2 * n + 1) = floatBitsToUint(away);
                }
            }
        }
    }
}

// 4. For each listed block: chooses the nearest, at equal distances the finer one and the lower slot; clears the
// histogram.
void wlm_update_rank(int i)
{
    if (i < 1056)
        WLM_UPDATE_COUNTS(2 + i) = 0u;
    int count = min(int(WLM_UPDATE_COUNTS(0)), WLM_UPDATE_MOST);
    if (i < count) {
        uint slot = WLM_UPDATE_WORK(WLM_UPDATE_RANKED + 2 * i);
        uint away = WLM_UPDATE_WORK(WLM_UPDATE_RANKED + 2 * i + 1);
        int nearer = 0;
        for (int n = 0; n < count; ++n) {
            uint other = WLM_UPDATE_WORK(WLM_UPDATE_RANKED + 2 * n + 1); // positive floats are in the order of their bits
            if (other < away || (other == away && WLM_UPDATE_WORK(WLM_UPDATE_RANKED + 2 * n) < slot))
                ++nearer;
        }
        if (nearer < WLM_UPDATE_BUDGET)
            WLM_UPDATE_WORK(1 + 8 * nearer) = slot;
    }
}

// 5. For each chosen block: gives it a row of the pool, its own or the least recently used one of a group.
void wlm_update_allocate(int k)
{
    if (k == 0)
        WLM_UPDATE_COUNTS(0) = 0u;
    if (k < WLM_UPDATE_BUDGET) {
        int record = 1 + 8 * k;
        int slot = int(WLM_UPDATE_WORK(record));
        int taken = -1;
        if (slot >= 0) {
            int level = wlm_update_level(slot);
            ivec3 block = wlm_update_three(wlm_update_at(level) + 4) + wlm_update_local(level, slot);
            WLM_UPDATE_WORK(record + 2) = uint(block.x);
            WLM_UPDATE_WORK(record + 3) = uint(block.y);
            WLM_UPDATE_WORK(record + 4) = uint(block.z);
            WLM_UPDATE_WORK(record + 5) = uint(level);
            int rows = wlm_update_number(3);
            int blocks = wlm_update_number(6);
            int wanted = wlm_update_find(level, block);
            if (rows == blocks) {
                taken = wanted;
            } else {
                int frame = wlm_update_number(4);
                int size = max(1, min(64, rows / WLM_UPDATE_BUDGET));
                int groups = (rows + size - 1) / size;
                int first = (frame % groups * WLM_UPDATE_BUDGET + k) % groups * size;
                int oldest = frame;
                for (int row = first; row < min(first + size, rows); ++row) {
                    int stamp = int(WLM_UPDATE_TABLES(blocks + row));
                    if (stamp < oldest) {
                        oldest = stamp;
                        taken = row;
                    }
                }
                if (taken >= 0) {
                    int before = int(WLM_UPDATE_TABLES(blocks + rows + taken));
                    if (before >= 0)
                        WLM_UPDATE_TABLES(before) = 4294967295u;
                    WLM_UPDATE_TABLES(blocks + rows + taken) = uint(wanted);
                    WLM_UPDATE_TABLES(blocks + taken) = uint(frame);
                }
            }
            if (taken >= 0) {
                WLM_UPDATE_TABLES(wanted) = uint(taken);
                // From -2 to the row, beside the other slot of the word.
                uint change = (65534u ^ uint(taken)) << uint(16 * (slot % 2));
                atomicXor(WLM_UPDATE_PAGES(slot / 2), change);
            }
        }
        WLM_UPDATE_WORK(record + 1) = uint(taken);
    }
}

// 6. For each chosen block and each of the 64 cells of its reach: the range of the sorted probes.
void wlm_update_ranges(int i)
{
    if (i < 64 * WLM_UPDATE_BUDGET) {
        int record = 1 + 8 * (i / 64);
        int j = i % 64;
        int begin = 0;
        int end = 0;
        if (int(WLM_UPDATE_WORK(record + 1)) >= 0) {
            int ratio = wlm_update_number(wlm_update_at(int(WLM_UPDATE_WORK(record + 5))) + 15);
            int x = 2 * int(WLM_UPDATE_WORK(record + 2)) + j / 16 - 1;
            int y = 2 * int(WLM_UPDATE_WORK(record + 3)) + j / 4 % 4 - 1;
            int z = 2 * int(WLM_UPDATE_WORK(record + 4)) + j % 4 - 1;
            if (min(x, min(y, z)) >= 0) {
                int word = 2 * wlm_update_number(6);
                ivec3 low = ivec3(ratio * x, ratio * y, ratio * z);
                ivec3 high = ivec3(low.x + ratio - 1, low.y + ratio - 1, low.z + ratio - 1);
                int probes = wlm_update_number(5);
                begin = wlm_update_search(word, 12, 0, probes, wlm_update_key(low), false);
                end = wlm_update_search(word, 12, begin, probes, wlm_update_key(high), true);
            }
        }
        WLM_UPDATE_WORK(WLM_UPDATE_RANGES + 2 * i) = uint(begin);
        WLM_UPDATE_WORK(WLM_UPDATE_RANGES + 2 * i + 1) = uint(end - begin);
    }
}

float wlm_update_overlap(float x, float y)
{
    float low = floor(x);
    float other = floor(y);
    float a = x - low;
    float b = y - other;
    if (low == other)
        return (1.0 - a) * (1.0 - b) + a * b;
    if (low == other + 1.0)
        return (1.0 - a) * b;
    if (low == other - 1.0)
        return a * (1.0 - b);
    return 0.0;
}

// The covariance of the light at two places, in sides of a block from its centre.
float wlm_update_covariance(vec4 x, vec4 y)
{
    float read = wlm_update_overlap(x.x, y.x) * wlm_update_overlap(x.y, y.y) * wlm_update_overlap(x.z, y.z);
    vec3 d = vec3(x.x - y.x, x.y - y.y, x.z - y.z);
    return read + 0.3 * exp(-length(d) / 3.0);
}

vec3 wlm_update_floats(int word)
{
    float x = uintBitsToFloat(WLM_UPDATE_INDEX(word));
    float y = uintBitsToFloat(WLM_UPDATE_INDEX(word + 1));
    return vec3(x, y, uintBitsToFloat(WLM_UPDATE_INDEX(word + 2)));
}

// 7. For each chosen block: picks at most 16 probes, and computes their weights by ordinary kriging.
void wlm_update_weigh(int k)
{
    if (k >= WLM_UPDATE_BUDGET)
        return;
    int record = 1 + 8 * k;
    int total = 0;
    for (int j = 0; j < 64; ++j)
        total += int(WLM_UPDATE_WORK(WLM_UPDATE_RANGES + 128 * k + 2 * j + 1));
    int count = min(total, 16);
    WLM_UPDATE_WORK(record + 6) = uint(count);
    float variance = 0.03 * clamp(float(total) / 16.0, 1.0, 10.0);
    int ratio = wlm_update_number(wlm_update_at(int(WLM_UPDATE_WORK(record + 5))) + 15);
    vec4 places[16];
    for (int i = 0; i < count; ++i) {
        // Every n-th probe is taken, so that they are spread over the whole block.
        int at = i * (total / count) + i * (total % count) / count;
        int p = -1;
        int passed = 0;
        for (int j = 0; j < 64; ++j) {
            int range = WLM_UPDATE_RANGES + 128 * k + 2 * j;
            int here = int(WLM_UPDATE_WORK(range + 1));
            if (p < 0 && at < passed + here)
                p = int(WLM_UPDATE_WORK(range)) + at - passed;
            passed += here;
        }
        WLM_UPDATE_WORK(WLM_UPDATE_PICKS + 16 * k + i) = uint(p);
        int word = 2 * wlm_update_number(6) + 12 * p;
        ivec3 cell = wlm_update_cell(uvec2(WLM_UPDATE_INDEX(word), WLM_UPDATE_INDEX(word + 1)));
        int x = cell.x - ratio * (2 * int(WLM_UPDATE_WORK(record + 2)) + 1);
        int y = cell.y - ratio * (2 * int(WLM_UPDATE_WORK(record + 3)) + 1);
        int z = cell.z - ratio * (2 * int(WLM_UPDATE_WORK(record + 4)) + 1);
        vec3 place = (vec3(float(x), float(y), float(z)) + wlm_update_floats(word + 3)) * (0.5 / float(ratio));
        // The light of a probe counts less behind its surface.
        float behind = max(dot(wlm_update_floats(word + 6), place), 0.0);
        places[i] = vec4(place.x, place.y, place.z, 3.0 * behind * behind);
    }
    // The lower triangle of the Cholesky decomposition, row after row, and two right sides: the covariance with the
    // block, and ones.
    float lower[136];
    float u[16];
    float v[16];
    for (int i = 0; i < count; ++i) {
        int row = i * (i + 1) / 2;
        vec4 x = places[i];
        float square = wlm_update_covariance(x, x) + variance + x.w;
        float a = (1.0 - abs(x.x)) * (1.0 - abs(x.y)) * (1.0 - abs(x.z)) + 0.3 * exp(-length(vec3(x.x, x.y, x.z)) / 3.0);
        float b = 1.0;
        for (int j = 0; j < i; ++j) {
            int other = j * (j + 1) / 2;
            float s = wlm_update_covariance(x, places[j]);
            for (int m = 0; m < j; ++m)
                s -= lower[other + m] * lower[row + m];
            s = s / lower[other + j];
            lower[row + j] = s;
            square -= s * s;
            a -= s * u[j];
            b -= s * v[j];
        }
        float diagonal = sqrt(square);
        lower[row + i] = diagonal;
        u[i] = a / diagonal;
        v[i] = b / diagonal;
    }
    float sum_u = 0.0;
    float sum_v = 0.0;
    for (int n = 0; n < count; ++n) {
        int i = count - 1 - n;
        int row = i * (i + 1) / 2;
        float a = u[i] / lower[row + i];
        float b = v[i] / lower[row + i];
        for (int m = 0; m < i; ++m) {
            u[m] -= lower[row + m] * a;
            v[m] -= lower[row + m] * b;
        }
        u[i] = a;
        v[i] = b;
        sum_u += a;
        sum_v += b;
    }
    for (int i = 0; i < count; ++i)
        WLM_UPDATE_LIGHT(WLM_UPDATE_WEIGHTS + 16 * k + i) = u[i] + (1.0 - sum_u) / sum_v * v[i];
}

// 8. For each picked probe, 16 for each chosen block: decodes its light.
void wlm_update_decode(int i)
{
    if (i < 16 * WLM_UPDATE_BUDGET) {
        if (i % 16 < int(WLM_UPDATE_WORK(1 + 8 * (i / 16) + 6))) {
            int word = 2 * wlm_update_number(6) + 12 * int(WLM_UPDATE_WORK(WLM_UPDATE_PICKS + i));
            float values[WLM_UPDATE_OUTPUTS];
            wlm_probe_values(PROBE, values);
            for (int c = 0; c < WLM_UPDATE_OUTPUTS; ++c)
                WLM_UPDATE_LIGHT(WLM_UPDATE_OUTPUTS * i + c) = values[c];
        }
    }
}

// 9. For each number of each chosen block: the weighted sum, clamped to the probes' range, which is extended by half its
// width on both sides. It replaces the light of the block's first probe.
void wlm_update_combine(int i)
{
    int k = i / WLM_UPDATE_OUTPUTS;
    if (k < WLM_UPDATE_BUDGET) {
        int at = 16 * k * WLM_UPDATE_OUTPUTS + i % WLM_UPDATE_OUTPUTS;
        float sum = 0.0;
        float low = 0.0;
        float high = 0.0;
        for (int n = 0; n < int(WLM_UPDATE_WORK(1 + 8 * k + 6)); ++n) {
            float value = WLM_UPDATE_LIGHT(at + n * WLM_UPDATE_OUTPUTS);
            sum += WLM_UPDATE_LIGHT(WLM_UPDATE_WEIGHTS + 16 * k + n) * value;
            low = n == 0 ? value : min(low, value);
            high = n == 0 ? value : max(high, value);
        }
        float room = 0.5 * (high - low);
        WLM_UPDATE_LIGHT(at) = clamp(sum, low - room, high + room);
    }
}

// 10. For each word of the rows of all chosen blocks: stores their light.
void wlm_update_store(int i)
{
    int k = i / WLM_UPDATE_ROW_WORDS;
    if (k < WLM_UPDATE_BUDGET) {
        int row = int(WLM_UPDATE_WORK(1 + 8 * k + 1));
        if (row >= 0) {
            int at = 16 * k * WLM_UPDATE_OUTPUTS;
            float most = 0.0;
            for (int c = 0; c < WLM_UPDATE_OUTPUTS; ++c)
                most = max(most, abs(WLM_UPDATE_LIGHT(at + c)));
            float factor = most / 16384.0;
            int number = 2 * (i % WLM_UPDATE_ROW_WORDS) - 2;
            uint word = floatBitsToUint(factor);
            if (number >= 0) {
                float scale = factor > 0.0 ? 1.0 / factor : 0.0;
                float second = 0.0;
                if (number + 1 < WLM_UPDATE_OUTPUTS)
                    second = WLM_UPDATE_LIGHT(at + number + 1);
                word = packHalf2x16(vec2(WLM_UPDATE_LIGHT(at + number) * scale, second * scale));
            }
            WLM_UPDATE_POOL(row * WLM_UPDATE_ROW_WORDS + i % WLM_UPDATE_ROW_WORDS) = word;
        }
    }
}
