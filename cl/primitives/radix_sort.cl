/* Stable sort of 32-bit keys with a 32-bit value each: least significant digit first.
 *
 * Reference: Zagha and Blelloch 1991, "Radix sort for vector multiprocessors": each worker counts the digits of its own
 * chunk, and the offsets of a digit are in the order of the chunks, which keeps the sort stable.
 *
 * Keys of one digit of 2 bits, two chunks of four elements:
 *
 *      keys                2 0 3 0 | 1 2 0 3          values 0 1 2 3 | 4 5 6 7: the numbers of the elements
 *      counts of digit 0   2       | 1                counts[digit][chunk], so that one scan gives all offsets
 *                      1   0       | 1
 *                      2   1       | 1
 *                      3   1       | 1
 *      offsets             0 2, 3 3, 4 5, 6 7
 *      sorted values       1 3 | 6 || 4 || 0 | 5 || 2 | 7
 *
 * Passes, for each digit from the lowest
 *   1. count_digits        digits of each chunk (then the exclusive scan of scan.cl)
 *   2. scatter_by_digit    each element to its place
 *
 * A chunk is the work of one work-group.  With LANES 8, on a CPU, its first item does all of it in turn.  With LANES 1
 * the items of a group take a row of RADIX_GROUP elements at a time: the rank of an element is the number of equal
 * digits before it in the row. */
#ifndef LANES
#define LANES 1
#endif
#ifndef RADIX_GROUP
#define RADIX_GROUP 64
#endif
#define RADIX_BITS 11
#define RADIX_BINS 2048 /* 2^RADIX_BITS: 8 KB of local memory */
#define NO_DIGIT 0xffffffffu

/* Elements of a chunk, and their digits: `bins` of `shift` on. */
typedef struct {
    uint number, begin, end, shift, bins, chunks;
} key_chunk;

static inline key_chunk find_chunk(
    const uint n, const uint shift, const uint bins, const uint per_chunk, const uint chunks)
{
    const uint number = get_group_id(0), begin = number * per_chunk;
    const key_chunk chunk = {number, begin, begin + min(per_chunk, n - begin), shift, bins, chunks};
    return chunk;
}

static inline uint digit_of(const uint key, const key_chunk chunk) { return key >> chunk.shift & (chunk.bins - 1); }

static inline size_t count_place(const uint digit, const key_chunk chunk)
{
    return (size_t)digit * chunk.chunks + chunk.number;
}

#if LANES == 8
static inline void count_chunk(
    __global const uint *keys, __global uint *counts, const key_chunk chunk, __local uint *histogram)
{
    if (get_local_id(0) != 0)
        return;
    for (uint digit = 0; digit < chunk.bins; ++digit)
        histogram[digit] = 0;
    for (uint index = chunk.begin; index < chunk.end; ++index)
        ++histogram[digit_of(keys[index], chunk)];
    for (uint digit = 0; digit < chunk.bins; ++digit)
        counts[count_place(digit, chunk)] = histogram[digit];
}

static inline void scatter_chunk(
    __global const uint *keys, __global const uint *values, __global const uint *offsets, __global uint *sorted_keys,
    __global uint *sorted_values, const key_chunk chunk, const uint numbered, __local uint *next, __local uint *digits)
{
    if (get_local_id(0) != 0)
        return;
    for (uint digit = 0; digit < chunk.bins; ++digit)
        next[digit] = offsets[count_place(digit, chunk)];
    for (uint index = chunk.begin; index < chunk.end; ++index) {
        const uint key = keys[index];
        const uint place = next[digit_of(key, chunk)]++;
        sorted_keys[place] = key;
        sorted_values[place] = numbered ? index : values[index];
    }
}
#else
static inline void count_chunk(
    __global const uint *keys, __global uint *counts, const key_chunk chunk, __local uint *histogram)
{
    const uint item = get_local_id(0);
    for (uint digit = item; digit < chunk.bins; digit += RADIX_GROUP)
        histogram[digit] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint index = chunk.begin + item; index < chunk.end; index += RADIX_GROUP)
        atomic_inc(histogram + digit_of(keys[index], chunk));
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint digit = item; digit < chunk.bins; digit += RADIX_GROUP)
        counts[count_place(digit, chunk)] = histogram[digit];
}

static inline void scatter_chunk(
    __global const uint *keys, __global const uint *values, __global const uint *offsets, __global uint *sorted_keys,
    __global uint *sorted_values, const key_chunk chunk, const uint numbered, __local uint *next, __local uint *digits)
{
    const uint item = get_local_id(0);
    for (uint digit = item; digit < chunk.bins; digit += RADIX_GROUP)
        next[digit] = offsets[count_place(digit, chunk)];
    for (uint row = chunk.begin; row < chunk.end; row += RADIX_GROUP) {
        const uint index = row + item;
        const int inside = index < chunk.end;
        const uint key = inside ? keys[index] : 0;
        const uint digit = inside ? digit_of(key, chunk) : NO_DIGIT;
        digits[item] = digit;
        barrier(CLK_LOCAL_MEM_FENCE);
        uint rank = 0, after = 0;
#pragma unroll 16 /* AMD's compiler takes 99 registers for all 64 at once, 25 for these */
        for (uint other = 0; other < RADIX_GROUP; ++other) {
            const uint same = digits[other] == digit;
            rank += same & (other < item);
            after += same & (other > item);
        }
        const uint place = inside ? next[digit] + rank : 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (inside && after == 0)
            next[digit] = place + 1;
        if (inside) {
            sorted_keys[place] = key;
            sorted_values[place] = numbered ? index : values[index];
        }
    }
}
#endif

/* Parameters  keys    in   (n,)
 *             counts  out  (bins, chunks) number of keys with each digit in each chunk
 *             n       elements;  shift: lowest bit of the digit;  bins: 2^bits of it, at most RADIX_BINS
 *             per_chunk    elements of a chunk;  chunks = ceil(n / per_chunk)
 * Launch      global = chunks * RADIX_GROUP, local = RADIX_GROUP
 * Guarantees  every count is written */
__kernel __attribute__((reqd_work_group_size(RADIX_GROUP, 1, 1)))
void count_digits(
    __global const uint *restrict keys, __global uint *restrict counts, const uint n, const uint shift,
    const uint bins, const uint per_chunk, const uint chunks)
{
    __local uint histogram[RADIX_BINS];
    count_chunk(keys, counts, find_chunk(n, shift, bins, per_chunk, chunks), histogram);
}

/* Parameters  keys           in   (n,)
 *             values         in   (n,); not read where `numbered` is 1
 *             offsets        in   (bins, chunks) exclusive scan of the counts
 *             sorted_keys    out  (n,) by the digit, elements with equal digits in the order of the input
 *             sorted_values  out  (n,) the value of each of them
 *             numbered       1: the value of an element is its number
 *             n shift bins per_chunk chunks    as in count_digits
 * Launch      as count_digits
 * Guarantees  every element is written once */
__kernel __attribute__((reqd_work_group_size(RADIX_GROUP, 1, 1)))
void scatter_by_digit(
    __global const uint *restrict keys, __global const uint *restrict values, __global const uint *restrict offsets,
    __global uint *restrict sorted_keys, __global uint *restrict sorted_values, const uint n, const uint shift,
    const uint bins, const uint per_chunk, const uint chunks, const uint numbered)
{
    __local uint next[RADIX_BINS], digits[RADIX_GROUP]; /* places of the next elements; digits of a row */
    const key_chunk chunk = find_chunk(n, shift, bins, per_chunk, chunks);
    scatter_chunk(keys, values, offsets, sorted_keys, sorted_values, chunk, numbered, next, digits);
}
