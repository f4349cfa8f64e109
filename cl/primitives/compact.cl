/* Stream compaction of a bit mask: the positions of its set bits, in ascending order.
 *
 * Reference: Billeter, Olsson, Assarsson 2009, "Efficient stream compaction on wide SIMD many-core
 * architectures" (count, scan, write); here on packed bits, so that counting is popcount.
 *
 *      mask       word 0: 0x80000005      word 1: 0x00000002      bit b of word w is position 32 w + b
 *      counts     3                       1                       with COMPACT_WORDS = 1
 *      offsets    0                       3
 *      positions  0, 2, 31                33
 *
 * Passes
 *   1. count_set_bits   the number of set bits of each chunk of COMPACT_WORDS words
 *      (exclusive scan of these counts: scan.cl)
 *   2. list_set_bits    each chunk writes its positions from its offset */
#ifndef COMPACT_WORDS
#define COMPACT_WORDS 8
#endif

/* Parameters  mask    in   (words,) bit b of word w is position 32 w + b
 *             counts  out  (chunks,)
 *             words   number of words
 * Launch      global = chunks = ceil(words / COMPACT_WORDS) rounded up by the host, any local
 * Guarantees  every count is written */
__kernel void count_set_bits(
    __global const uint *restrict mask, __global uint *restrict counts, const uint words)
{
    const uint chunk = get_global_id(0);
    const uint begin = chunk * COMPACT_WORDS;
    if (begin >= words)
        return;
    const uint end = min(begin + COMPACT_WORDS, words);
    uint count = 0;
    for (uint word = begin; word < end; ++word)
        count += popcount(mask[word]);
    counts[chunk] = count;
}

/* Parameters  mask       in   (words,)
 *             offsets    in   (chunks,) exclusive scan of the counts
 *             positions  out  (total,) positions of the set bits, ascending
 *             words      number of words
 * Launch      as count_set_bits
 * Assumes     positions fit 32 bits
 * Guarantees  every position is written once; the order does not depend on the device */
__kernel void list_set_bits(
    __global const uint *restrict mask, __global const uint *restrict offsets, __global uint *restrict positions,
    const uint words)
{
    const uint chunk = get_global_id(0);
    const uint begin = chunk * COMPACT_WORDS;
    if (begin >= words)
        return;
    const uint end = min(begin + COMPACT_WORDS, words);
    uint place = offsets[chunk];
    for (uint word = begin; word < end; ++word) {
        for (uint bits = mask[word]; bits != 0; bits &= bits - 1)
            positions[place++] = 32 * word + popcount((bits & -bits) - 1);
    }
}
