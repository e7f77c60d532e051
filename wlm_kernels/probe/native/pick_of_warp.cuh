// The choice of every n-th probe of a block by a warp. Each lane brings two of the 64 ranges of probes near the block, in
// order: their first indices a and b, and their lengths. Returns the index of the lane's probe, the number of chosen probes,
// at most `most`, and the number of all.

const int lane = threadIdx.x % 32, own = a[1] + b[1];
int before = own;
for (int step = 1; step < 32; step *= 2) {
    const int lower = __shfl_up_sync(~0u, before, step);
    if (lane >= step) before += lower;
}
const int total = __shfl_sync(~0u, before, 31), count = min(total, most);
before -= own;
const int at = lane < count ? static_cast<int>(static_cast<long long>(lane) * total / count) : 0;
// The last lane before whose ranges are at most `at` probes.
int holder = 0;
for (int step = 16; step > 0; step /= 2)
    if (__shfl_sync(~0u, before, holder + step) <= at) holder += step;
const int place = at - __shfl_sync(~0u, before, holder), length = __shfl_sync(~0u, a[1], holder);
const int first = __shfl_sync(~0u, a[0], holder), second = __shfl_sync(~0u, b[0], holder);
return wp::vec_t<3, int>(place < length ? first + place : second + place - length, count, total);
