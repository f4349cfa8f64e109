/* Exclusive prefix sum of 32-bit counts, by reduce-then-scan.
 *
 * Reference: Blelloch 1990, "Prefix sums and their applications"; the three launches are the classic
 * reduce-then-scan order, which needs no forward progress between work-groups and so runs on any device.
 *
 * With SCAN_GROUP = 2 and SCAN_PER_ITEM = 2, so blocks of 4:
 *
 *      counts           3  1 | 0  2 || 5  0 | 1  1 || 2          | elements of an item    || of a block, a work-group
 *      block_sums             6     ||      7      || 2          1. sum_blocks
 *      block_offsets          0     ||      6      || 13         2. scan_block_sums, total = 15
 *      offsets          0  3 | 4  4 || 6 11 |11 12 || 13         3. scan_blocks
 *
 * Passes
 *   1. sum_blocks          the sum of each block of SCAN_BLOCK elements
 *   2. scan_block_sums     one work-group: exclusive scan of the block sums in 64 bits, and the total
 *   3. scan_blocks         each block again, from its offset
 *
 * Every work-group has SCAN_GROUP items; an item sums SCAN_PER_ITEM neighbouring elements, then the partial
 * sums of the group are scanned by its first item.  A tree with barriers in a loop would save at most 256 steps
 * and is what CPU drivers compile worst. */
#ifndef SCAN_GROUP
#define SCAN_GROUP 64
#endif
#ifndef SCAN_PER_ITEM
#define SCAN_PER_ITEM 16
#endif
#define SCAN_BLOCK (SCAN_GROUP * SCAN_PER_ITEM)

/* Parameters  counts      in   (n,) counts
 *             block_sums  out  (blocks,) sum of each block
 *             n           elements
 * Launch      global = blocks * SCAN_GROUP with blocks = ceil(n / SCAN_BLOCK), local = SCAN_GROUP
 * Assumes     the sum of one block fits 32 bits
 * Guarantees  every block sum is written */
__kernel __attribute__((reqd_work_group_size(SCAN_GROUP, 1, 1)))
void sum_blocks(__global const uint *restrict counts, __global uint *restrict block_sums, const uint n)
{
    __local uint partial[SCAN_GROUP];
    const uint item = get_local_id(0);
    const uint begin = get_group_id(0) * SCAN_BLOCK + item * SCAN_PER_ITEM;
    const uint end = min(begin + SCAN_PER_ITEM, n);
    uint sum = 0;
    for (uint index = begin; index < end; ++index)
        sum += counts[index];
    partial[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
        uint block = 0;
        for (uint other = 0; other < SCAN_GROUP; ++other)
            block += partial[other];
        block_sums[get_group_id(0)] = block;
    }
}

/* Parameters  block_sums     in   (blocks,)
 *             block_offsets  out  (blocks,) sum of all blocks before, modulo 2^32
 *             total          out  (1,) sum of everything, 64 bits
 *             blocks         number of blocks
 * Launch      one work-group of SCAN_GROUP items
 * Guarantees  `total` is exact, so the host can refuse what does not fit 32 bits */
__kernel __attribute__((reqd_work_group_size(SCAN_GROUP, 1, 1)))
void scan_block_sums(
    __global const uint *restrict block_sums, __global uint *restrict block_offsets, __global ulong *restrict total,
    const uint blocks)
{
    __local ulong partial[SCAN_GROUP];
    const uint item = get_local_id(0);
    const uint per_item = (blocks + SCAN_GROUP - 1) / SCAN_GROUP;
    const uint begin = min(item * per_item, blocks);
    const uint end = min(begin + per_item, blocks);
    ulong sum = 0;
    for (uint block = begin; block < end; ++block)
        sum += block_sums[block];
    partial[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
        ulong before = 0;
        for (uint other = 0; other < SCAN_GROUP; ++other) {
            const ulong own = partial[other];
            partial[other] = before;
            before += own;
        }
        total[0] = before;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    uint offset = (uint)partial[item];
    for (uint block = begin; block < end; ++block) {
        block_offsets[block] = offset;
        offset += block_sums[block];
    }
}

/* Parameters  counts         in   (n,)
 *             block_offsets  in   (blocks,)
 *             offsets        out  (n,) sum of all counts before each element, modulo 2^32; may be `counts` itself
 *             n              elements
 * Launch      as sum_blocks
 * Guarantees  every offset is written */
__kernel __attribute__((reqd_work_group_size(SCAN_GROUP, 1, 1)))
void scan_blocks(
    __global const uint *counts, __global const uint *restrict block_offsets, __global uint *offsets, const uint n)
{
    __local uint partial[SCAN_GROUP];
    const uint item = get_local_id(0);
    const uint begin = get_group_id(0) * SCAN_BLOCK + item * SCAN_PER_ITEM;
    const uint end = min(begin + SCAN_PER_ITEM, n);
    uint sum = 0;
    for (uint index = begin; index < end; ++index)
        sum += counts[index];
    partial[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
        uint before = block_offsets[get_group_id(0)];
        for (uint other = 0; other < SCAN_GROUP; ++other) {
            const uint own = partial[other];
            partial[other] = before;
            before += own;
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    uint offset = partial[item];
    for (uint index = begin; index < end; ++index) {
        const uint count = counts[index];
        offsets[index] = offset;
        offset += count;
    }
}
