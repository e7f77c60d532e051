"""A frame of a virtual texture: finds the pages that a view needs, chooses those to decode, and updates the page table.

The launches of a frame have fixed sizes, so that a CUDA graph can contain them; only the first two have arguments that
change from frame to frame.

1. `Look` copies the frame's times to the device.
2. `mark` counts for each page the pixels that need it, at every `stride`-th pixel along both axes, shifted from frame
   to frame.
3. `select` gives each page a priority: its number of pixels, times a factor for a page that is missing, that is to be
   ready for a coming switch, or whose light has changed. It ranks the pages, decodes the first ones, up to a number of
   pages and of samples, and finds a slot of the physical texture for each page that is decoded in this frame: the least
   recently needed one of a group of slots. Each page takes from another group, and groups take turns. A slot whose page
   was needed in the last frames is never given away.
4. `wlm_kernels.lightmap.pages` decodes the chosen pages, or one of their parts each, into their slots.
5. `refer` writes the page table: the slot of each page, or of its finest ancestor that has one, with all parts.

How much light has changed is known without decoding it: `Pages.change` adds up the changes between stored times. While
the clock runs forward, a page is decoded for a time at which its light will have changed by `REFRESH` of the tolerance,
and again when it has changed by as much since: half the error of light that is only ever late. A page of many samples
is decoded for a time at which its light will have changed by `LEAD` of the tolerance, and again when it is stale: half
as often as if it were only ever late.
"""

from typing import Any

import numpy as np
import warp as wp

from wlm_kernels.least_recent import least_recent
from wlm_kernels.lightmap.matrix_pages import blocks_of
from wlm_kernels.lightmap.pages import CLOCK, Jobs, parts_of, samples_of
from wlm_kernels.shared_exponent import unpack_rgb9e5

GROUP = 32  # slots from which one is chosen
MOST = 4096  # most pages that are ranked
SAMPLES = 2.5  # most samples of a texel of all decoded pages together, for each page that a frame may decode
KEEP = 16  # frames for which a page counts as needed
REFRESH = 0.3  # of the tolerance: change of light from which on a page is decoded again if a frame has room
FEW = 4  # samples of a texel of such a page
LEAD = 0.9  # of the tolerance: change of light up to the time for which a page of more samples is decoded
VISIBLE, MISSING, STALE, AHEAD, WAITING, DECODED, GATHERED = range(7)
"""Counters of a frame: pages that are needed; pages among them without a slot, whose light has changed, that are not
ready for the coming switch, and that wait for tiles; decoded pages; and pages that could have been decoded."""

ADOPT, DROP, PREPARE, FORWARD = range(4)
"""Numbers of a light group in a frame: whether the pages for the switch are now those to show, whether they are not
needed any more; whether to decode pages for a coming switch; and whether light may be decoded for a later time."""

_VISIBLE, _MISSING, _STALE, _AHEAD, _WAITING, _DECODED, _GATHERED = (wp.constant(i) for i in range(7))
_ADOPT, _DROP, _PREPARE, _FORWARD = (wp.constant(i) for i in range(4))
_MOST, _KEEP, _SAMPLES, _REFRESH = (wp.constant(i) for i in (MOST, KEEP, SAMPLES, REFRESH))
_FEW, _LEAD = wp.constant(FEW), wp.constant(LEAD)
_FADE = wp.constant(0.75)  # share of its pixels that a page keeps in the next frame
_IF_OFF = wp.constant(1.0 / 64.0)  # factor of the priority in a group whose weight is 0
_IF_EARLY = wp.constant(1.0 / 64.0)  # and of a page whose light has changed by less than the tolerance
_IF_MISSING, _IF_AHEAD, _IF_STALE = wp.constant(64.0), wp.constant(32.0), wp.constant(8.0)  # factors of the priority
_SHARE = wp.constant(2)  # column of a clock, see `pages`

GROUPS = 8
"""Most light groups."""

Times = wp.types.matrix(shape=(2 * GROUPS, CLOCK), dtype=float)
Switches = wp.types.matrix(shape=(GROUPS, 4), dtype=int)


@wp.struct
class Pages:
    """The P pages of the S sheets of G light groups; see `wlm.lightmap.virtual.layout`.

    Attributes:
        sheets: [F, G], the sheets of each surface by group, or -1: what a pixel shows is the weighted sum of these.
        group: [S], the group of each sheet.
        weights: [G], factor of the light of each group.
        first: [S, L], number of the first page of each level of each sheet.
        columns: [S, L], pages in a row of each level.
        levels: [S], number of levels of each sheet.
        size: [S], height and width of each sheet in texels.
        place: [P], sheet, level, row and column of each page.
        parent: [P], the page that covers this one in the next coarser level; -1 for the page of a whole sheet, which
            always has a slot.
        ready: [P], 1 for a page whose tiles are on the device, 0 for one that waits for tiles, -1 for the page of a
            damaged tile: the page above is needed in its place.
        change: [P, T + 1], relative change of a page's light from the first stored time up to each one, summed up over
            time. The last is that of a whole day if the times are periodic.
        slot: [P], slot of the physical texture, or -1.
        ahead: [P], slot with the page's light after the coming switch, or -1.
        need: [P], pixels that need the page in this frame.
        area: [P], pixels that need the page, averaged over frames.
        seen: [P], last frame in which the page was needed.
        table: [P], the page table: 16 times the slot, plus the level of the page in it.
        side, border: Texels along a side of a page without its border, and of the border.
        periodic: Whether the last stored time is followed by the first.
    """

    sheets: wp.array2d[int]
    group: wp.array1d[int]
    weights: wp.array1d[wp.vec3]
    first: wp.array2d[int]
    columns: wp.array2d[int]
    levels: wp.array1d[int]
    size: wp.array1d[wp.vec2i]
    place: wp.array1d[wp.vec4i]
    parent: wp.array1d[int]
    ready: wp.array1d[int]
    change: wp.array2d[float]
    slot: wp.array1d[int]
    ahead: wp.array1d[int]
    need: wp.array1d[int]
    area: wp.array1d[float]
    seen: wp.array1d[int]
    table: wp.array1d[int]
    side: int
    border: int
    periodic: int


@wp.struct
class Slots:
    """The C slots of the physical texture.

    Attributes:
        owner: [C], page in the slot, or -1.
        stamp: [C], last frame in which the page was needed; -1 for an empty slot.
        mark: [C], value of `Pages.change` at the time for which the page was decoded.
        parts: [C], parts that were decoded since the page is in the slot; a page is shown once it has all, and is
            decoded again part by part.
    """

    owner: wp.array1d[int]
    stamp: wp.array1d[int]
    mark: wp.array1d[float]
    parts: wp.array1d[int]


@wp.struct
class Work:
    """Data that the launches of a frame pass on; a frame decodes at most B pages.

    Attributes:
        clock: [2 G, CLOCK], the time of the frame for each group, and then the time after its coming switch; see
            `pages`.
        frame: [1], number of the frame.
        switches: [G, 4], see `ADOPT`.
        counters: [7], see `VISIBLE`.
        gathered: [MOST], pages that could be decoded: twice the page, plus the row of the clock.
        priority: [MOST], priority of each gathered page.
        cost: [MOST], samples of a texel of each gathered page.
        chosen: [B], the gathered pages that are decoded, or -1.
        asked: [2, P], for each page the last frame in which it was needed, and its priority if it waits for tiles, at
            least 1, else 0.
    """

    clock: wp.array2d[float]
    frame: wp.array1d[int]
    switches: wp.array2d[int]
    counters: wp.array1d[int]
    gathered: wp.array1d[int]
    priority: wp.array1d[float]
    cost: wp.array1d[int]
    chosen: wp.array1d[int]
    asked: wp.array2d[int]


@wp.kernel(enable_backward=False)
def _look(times: Times, switches: Switches, frame: int, work: Work):
    i = wp.tid()
    row = i // work.clock.shape[1]
    if row < work.clock.shape[0]:
        column = i % work.clock.shape[1]
        work.clock[row, column] = times[row, column]
    row = i // 4
    if row < work.switches.shape[0]:
        work.switches[row, i % 4] = switches[row, i % 4]
    if i == 0:
        work.frame[0] = frame
    if i < work.counters.shape[0]:
        work.counters[i] = 0
    if i < work.chosen.shape[0]:
        work.chosen[i] = -1


@wp.func
def _level_of(pages: Pages, sheet: int, derivative: wp.vec4) -> float:
    """Returns the level at which a texel is as large as a pixel; `derivative` is du/dx, du/dy, dv/dx, dv/dy."""
    size = pages.size[sheet]
    height = float(size[0])
    width = float(size[1])
    across = derivative[0] * derivative[0] * width * width + derivative[2] * derivative[2] * height * height
    down = derivative[1] * derivative[1] * width * width + derivative[3] * derivative[3] * height * height
    level = 0.5 * wp.log2(wp.max(wp.max(across, down), 1.0))
    return wp.min(level, float(pages.levels[sheet] - 1))


@wp.func
def _finite(uv: wp.vec2, derivative: wp.vec4) -> bool:
    return wp.isfinite(uv[0] + uv[1]) and wp.isfinite(derivative[0] + derivative[1] + derivative[2] + derivative[3])


@wp.func
def _texel_of(pages: Pages, sheet: int, level: int, uv: wp.vec2) -> wp.vec2:
    """Returns the position x, y of a point in texels of a level, clamped to the level."""
    size = pages.size[sheet]
    step = float(1 << level)
    x = wp.clamp(uv[0], 0.0, 1.0) * float(size[1]) / step
    y = wp.clamp(uv[1], 0.0, 1.0) * float(size[0]) / step
    return wp.vec2(x, y)


@wp.func
def _page_at(pages: Pages, sheet: int, level: int, uv: wp.vec2) -> int:
    at = _texel_of(pages, sheet, level, uv)
    columns = pages.columns[sheet, level]
    side = float(pages.side)
    size = pages.size[sheet]
    texels = (1 << level) * pages.side
    column = wp.min(int(at[0] / side), columns - 1)
    row = wp.min(int(at[1] / side), (size[0] + texels - 1) // texels - 1)
    return pages.first[sheet, level] + row * columns + column


@wp.func
def _need(pages: Pages, sheet: int, level: int, uv: wp.vec2):
    page = _page_at(pages, sheet, level, uv)
    if pages.ready[page] < 0:
        page = pages.parent[page]
    wp.atomic_add(pages.need, page, 1)


@wp.kernel(enable_backward=False)
def _mark(
    # in:
    sheet: wp.array2d[int],
    uv: wp.array2d[wp.vec2],
    derivative: wp.array2d[wp.vec4],
    down: int,
    right: int,
    stride: int,
    # in and out:
    pages: Pages,
):
    i, j = wp.tid()
    y = i * stride + down
    x = j * stride + right
    if y < sheet.shape[0] and x < sheet.shape[1]:
        surface = sheet[y, x]
        if surface >= 0 and surface < pages.sheets.shape[0]:
            if _finite(uv[y, x], derivative[y, x]):
                for g in range(pages.sheets.shape[1]):
                    s = pages.sheets[surface, g]
                    if s >= 0:
                        level = _level_of(pages, s, derivative[y, x])
                        fine = int(level)
                        _need(pages, s, fine, uv[y, x])
                        if level > float(fine):
                            _need(pages, s, fine + 1, uv[y, x])


@wp.func
def _change_at(pages: Pages, page: int, clock: wp.array2d[float], target: int) -> float:
    before = int(clock[target, 0])
    early = pages.change[page, before]
    return early + clock[target, _SHARE] * (pages.change[page, before + 1] - early)


@wp.func
def _between(pages: Pages, page: int, a: float, b: float) -> float:
    lag = wp.abs(a - b)
    if pages.periodic == 1:
        lag = wp.abs(wp.min(lag, pages.change[page, pages.change.shape[1] - 1] - lag))
    return lag


@wp.func
def _gather(work: Work, code: int, level: int, priority: float):
    i = wp.atomic_add(work.counters, _GATHERED, 1)
    if i < _MOST:
        work.gathered[i] = code
        work.priority[i] = priority
        work.cost[i] = samples_of(level)


@wp.kernel(enable_backward=False)
def _score(pages: Pages, slots: Slots, tolerance: float, work: Work):
    p = wp.tid()
    frame = work.frame[0]
    group = pages.group[pages.place[p][0]]
    slot = pages.slot[p]
    ahead = pages.ahead[p]
    parts = parts_of(pages.place[p][1])
    if ahead >= 0:
        spare = int(-1)
        if work.switches[group, _ADOPT] == 1 and slots.parts[ahead] >= parts:
            spare = slot
            slot = ahead
            ahead = -1
        elif work.switches[group, _ADOPT] + work.switches[group, _DROP] > 0:
            spare = ahead
            ahead = -1
        if spare >= 0:
            slots.owner[spare] = -1
            slots.stamp[spare] = -1
        pages.slot[p] = slot
        pages.ahead[p] = ahead
    count = pages.need[p]
    pages.need[p] = 0
    area = _FADE * pages.area[p] + float(count)
    whole = pages.parent[p] < 0
    if whole:
        area = wp.max(area, 1.0)
    pages.area[p] = area
    if count > 0 or whole:
        pages.seen[p] = frame
    waits = int(0)
    if frame - pages.seen[p] < _KEEP:
        wp.atomic_add(work.counters, _VISIBLE, 1)
        if wp.length_sq(pages.weights[group]) == 0.0:
            area = _IF_OFF * area
        now = _change_at(pages, p, work.clock, group)
        priority = float(0.0)
        early = float(0.0)
        decoded = int(0)
        if slot >= 0:
            slots.stamp[slot] = frame
            decoded = slots.parts[slot]
        if decoded < parts:
            priority = _IF_MISSING * area
            wp.atomic_add(work.counters, _MISSING, 1)
        else:
            lag = _between(pages, p, now, slots.mark[slot])
            if decoded % parts > 0:
                priority = _IF_STALE * area
            elif lag > tolerance:
                priority = wp.min(lag / tolerance, _IF_STALE) * area
                wp.atomic_add(work.counters, _STALE, 1)
            elif lag > _REFRESH * tolerance:
                if samples_of(pages.place[p][1]) <= _FEW or work.switches[group, _FORWARD] == 0:
                    priority = _IF_EARLY * lag / tolerance * area
        if ahead >= 0:
            slots.stamp[ahead] = frame
            if slots.parts[ahead] < parts:
                early = _IF_AHEAD * area
                wp.atomic_add(work.counters, _AHEAD, 1)
        elif work.switches[group, _PREPARE] == 1:
            if _between(pages, p, now, _change_at(pages, p, work.clock, group + work.switches.shape[0])) > tolerance:
                early = _IF_AHEAD * area
                wp.atomic_add(work.counters, _AHEAD, 1)
        if pages.ready[p] == 1:
            if priority > 0.0:
                _gather(work, 2 * p, pages.place[p][1], priority)
            if early > 0.0:
                _gather(work, 2 * p + 1, pages.place[p][1], early)
        elif priority > 0.0 or early > 0.0:
            wp.atomic_add(work.counters, _WAITING, 1)
            waits = int(wp.min(wp.max(priority, early), 1.0e9)) + 1
    work.asked[0, p] = pages.seen[p]
    work.asked[1, p] = waits


@wp.kernel(enable_backward=False)
def _rank(work: Work):
    i = wp.tid()
    count = wp.min(work.counters[_GATHERED], _MOST)
    if i < count:
        code = work.gathered[i]
        priority = work.priority[i]
        better = int(0)
        cost = int(0)
        for j in range(count):
            other = work.priority[j]
            if other > priority or (other == priority and work.gathered[j] < code):
                better += 1
                cost += work.cost[j]
        most = work.chosen.shape[0]
        if better == 0 or (better < most and float(cost + work.cost[i]) <= _SAMPLES * float(most)):
            work.chosen[better] = code


@wp.kernel(enable_backward=False)
def _allocate(pages: Pages, slots: Slots, size: int, tolerance: float, work: Work, jobs: Jobs):
    k = wp.tid()
    slot = int(-1)
    code = work.chosen[k]
    if code >= 0:
        frame = work.frame[0]
        page = code // 2
        target = code % 2
        slot = pages.slot[page]
        if target == 1:
            slot = pages.ahead[page]
        if slot < 0:
            slot = least_recent(slots.stamp, size, frame, k, work.chosen.shape[0], frame - _KEEP + 1)
            if slot >= 0:
                before = slots.owner[slot]
                if before >= 0:
                    if pages.slot[before] == slot:
                        pages.slot[before] = -1
                    else:
                        pages.ahead[before] = -1
                slots.owner[slot] = page
                slots.parts[slot] = 0
                if target == 0:
                    pages.slot[page] = slot
                else:
                    pages.ahead[page] = slot
        if slot >= 0:
            slots.stamp[slot] = frame
            place = pages.place[page]
            group = pages.group[place[0]]
            row = group + target * work.switches.shape[0]
            part = slots.parts[slot] % parts_of(place[1])
            slots.parts[slot] += 1
            now = _change_at(pages, page, work.clock, row)
            if part == 0:
                slots.mark[slot] = now
            lead = float(0.0)
            if target == 0 and work.switches[group, _FORWARD] == 1:
                before = int(work.clock[row, 0])
                speed = pages.change[page, before + 1] - pages.change[page, before]
                # The other parts of a page follow the first.
                early = wp.where(samples_of(place[1]) <= _FEW, _REFRESH, _LEAD) * tolerance
                wanted = wp.where(part == 0, early, slots.mark[slot] - now)
                if speed > 0.0:
                    share = work.clock[row, _SHARE]
                    lead = wp.clamp(wanted / speed, -share, 1.0 - share)
                if part == 0:
                    slots.mark[slot] = now + lead * speed
            jobs.lead[k] = lead
            jobs.part[k] = part
            y = place[2] * pages.side - pages.border
            x = place[3] * pages.side - pages.border
            jobs.place[k] = wp.vec4i(place[0], place[1], y, x)
            jobs.target[k] = row
            wp.atomic_add(work.counters, _DECODED, 1)
    jobs.slot[k] = slot
    edge = pages.side + 2 * pages.border
    blocks = int(0)
    for i in range(k + 1):
        if i == k:
            jobs.first[k] = blocks
        if work.chosen[i] >= 0:
            blocks += blocks_of(pages.place[work.chosen[i] // 2][1], edge)
    if k == work.chosen.shape[0] - 1:
        jobs.first[k + 1] = blocks


@wp.func
def _shown(pages: Pages, slots: Slots, page: int) -> bool:
    """Returns whether all parts of a page are there, as those of a whole sheet always are."""
    if pages.parent[page] < 0:
        return True
    slot = pages.slot[page]
    if slot < 0:
        return False
    return slots.parts[slot] >= parts_of(pages.place[page][1])


@wp.kernel(enable_backward=False)
def _refer(pages: Pages, slots: Slots):
    p = wp.tid()
    page = int(p)
    while not _shown(pages, slots, page):
        page = pages.parent[page]
    pages.table[p] = 16 * pages.slot[page] + pages.place[page][1]


@wp.func
def _read(pages: Pages, texture: wp.array3d[wp.uint32], sheet: int, level: int, uv: wp.vec2) -> wp.vec3:
    """Reads a level bilinearly, from the page that the table refers to."""
    entry = pages.table[_page_at(pages, sheet, level, uv)]
    slot = entry // 16
    shown = entry % 16
    at = _texel_of(pages, sheet, shown, uv)
    place = pages.place[_page_at(pages, sheet, shown, uv)]
    # In the page, whose first texel's centre is at 0.
    x = at[0] - float(place[3] * pages.side) + float(pages.border) - 0.5
    y = at[1] - float(place[2] * pages.side) + float(pages.border) - 0.5
    i = int(y)
    j = int(x)
    fy = y - float(i)
    fx = x - float(j)
    top = (1.0 - fx) * unpack_rgb9e5(texture[slot, i, j]) + fx * unpack_rgb9e5(texture[slot, i, j + 1])
    bottom = (1.0 - fx) * unpack_rgb9e5(texture[slot, i + 1, j]) + fx * unpack_rgb9e5(texture[slot, i + 1, j + 1])
    return (1.0 - fy) * top + fy * bottom


@wp.kernel(enable_backward=False)
def _sample(
    # in:
    texture: wp.array3d[wp.uint32],
    pages: Pages,
    slots: Slots,
    clock: wp.array2d[float],
    sheet: wp.array1d[int],
    uv: wp.array1d[wp.vec2],
    derivative: wp.array1d[wp.vec4],
    # out:
    light: wp.array1d[wp.vec3],
    coarser: wp.array1d[int],
    change: wp.array1d[float],
):
    i = wp.tid()
    surface = sheet[i]
    total = wp.vec3()
    most = int(-1)
    lag = float(0.0)
    if surface >= 0 and surface < pages.sheets.shape[0]:
        if _finite(uv[i], derivative[i]):
            for g in range(pages.sheets.shape[1]):
                s = pages.sheets[surface, g]
                weight = pages.weights[g]
                if s >= 0 and wp.length_sq(weight) > 0.0:
                    level = _level_of(pages, s, derivative[i])
                    fine = int(level)
                    share = level - float(fine)
                    colour = _read(pages, texture, s, fine, uv[i])
                    if share > 0.0:
                        colour = (1.0 - share) * colour + share * _read(pages, texture, s, fine + 1, uv[i])
                    total += wp.cw_mul(weight, colour)
                    entry = pages.table[_page_at(pages, s, fine, uv[i])]
                    shown = _page_at(pages, s, entry % 16, uv[i])
                    most = wp.max(most, entry % 16 - fine)
                    lag = wp.max(
                        lag, _between(pages, shown, _change_at(pages, shown, clock, g), slots.mark[entry // 16])
                    )
    light[i] = total
    coarser[i] = most
    change[i] = lag


class Look:
    """A launch, prepared once, that copies a frame's times and numbers to the device; it resets the frame's counters.

    Args:
        work: The data of the frame, whose arrays every launch writes.
    """

    def __init__(self, work: Work) -> None:
        count = max(work.clock.size, work.switches.size, work.counters.shape[0], work.chosen.shape[0])
        self._times, self._switches = np.zeros((2 * GROUPS, CLOCK), np.float32), np.zeros((GROUPS, 4), np.int32)
        # The launch's arguments use these arrays' memory: building them from numbers takes longer than the launch.
        first = [Times.from_buffer(self._times), Switches.from_buffer(self._switches), 0]
        self._launch = wp.launch(_look, count, [*first, work], device=work.clock.device, record_cmd=True)

    def __call__(self, times: np.ndarray, switches: np.ndarray, frame: int) -> None:
        """Launches the kernel on the current stream.

        Args:
            times: [2 G, CLOCK], the rows of `Work.clock`.
            switches: Integers [G, 4], the rows of `Work.switches`.
            frame: Number of the frame, higher than in the frame before.
        """
        self._times[: len(times)], self._switches[: len(switches)] = times, switches
        self._launch.set_param_at_index(0, Times.from_buffer(self._times))
        self._launch.set_param_at_index(1, Switches.from_buffer(self._switches))
        self._launch.set_param_at_index(2, frame)
        self._launch.launch()


def mark(sheet, uv, derivative, at: tuple[int, int], stride: int, pages: Pages) -> None:
    """Counts the pixels that need each page.

    Args:
        sheet: int [H, W], number of the surface at each pixel; no surface has a negative number.
        uv: vec2 [H, W], texture coordinates; pixels with NaN or infinity do not count.
        derivative: vec4 [H, W], du/dx, du/dy, dv/dx, dv/dy per pixel.
        at: Row and column of the first pixel that is read, below `stride`.
        stride: Every pixel at this distance along both axes is read.
        pages: `need` is changed.
    """
    dim = tuple(-(-size // stride) for size in sheet.shape)
    inputs = [sheet, uv, derivative, *at, stride, pages]
    wp.launch(_mark, dim, inputs=inputs, device=sheet.device)


def select(pages: Pages, slots: Slots, tolerance: float, work: Work, jobs: Jobs) -> None:
    """Chooses the pages that are decoded in this frame, and writes them to `jobs`.

    Args:
        pages, slots, work: The state, which is changed.
        tolerance: Relative change of light above which a page is stale; it is decoded again before, see `REFRESH`.
        jobs: As many as `work.chosen`, written.
    """
    device, count = work.clock.device, work.chosen.shape[0]
    wp.launch(_score, pages.slot.shape, inputs=[pages, slots, tolerance, work], device=device)
    wp.launch(_rank, MOST, inputs=[work], device=device)
    size = max(1, min(GROUP, slots.owner.shape[0] // count))
    wp.launch(_allocate, count, inputs=[pages, slots, size, tolerance, work, jobs], device=device)


def refer(pages: Pages, slots: Slots) -> None:
    """Writes the page table from the slots of the pages; the pages of whole sheets must have a slot."""
    wp.launch(_refer, pages.slot.shape, inputs=[pages, slots], device=pages.slot.device)


def sample(texture, pages: Pages, slots: Slots, clock, points: tuple[Any, Any, Any], light, coarser, change) -> None:
    """Reads light at n points as a shader does: trilinearly through the page table.

    Args:
        texture: uint32 [C, side + 2 border, side + 2 border], the physical texture, RGB9E5.
        pages, slots: The state.
        clock: `Work.clock`.
        points: Surfaces, int [n]; texture coordinates, vec2 [n]; and derivatives, vec4 [n]; as for `mark`.
        light: vec3 [n], written: the weighted sum of the groups; 0 for points on no surface, and for coordinates that
            are not finite.
        coarser: int [n], written: levels by which the finer page that is read is coarser than needed; -1 for no page.
            Of several groups the most.
        change: float [n], written: relative change of the page's light since the time for which it was decoded.
    """
    inputs = [texture, pages, slots, clock, *points]
    wp.launch(_sample, light.shape, inputs=inputs, outputs=[light, coarser, change], device=light.device)
