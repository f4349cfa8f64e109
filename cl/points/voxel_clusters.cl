/* DBSCAN of the set voxels of a bit mask: core voxels, clusters of neighbouring core voxels, labels of all set voxels.
 *
 * Reference: Ester, Kriegel, Sander and Xu 1996, "A density-based algorithm for discovering clusters"; neighbours on a
 * lattice are the members of a stencil, and voxels are counted 32 at a time.
 *
 * Rows are numbered (j, k) -> k nj + j.  A row is `words` words of 32 voxels; behind its last voxel are as many words of
 * zeros as the stencil reaches along i, and they stand before the next row too.  A stencil is a list of rows (dj, dk,
 * lowest di, highest di), nearest first; `tables` says which part of the list is that of slice k.
 *
 * Passes
 *   1. the mask comes from cl/masks/classify.cl, that of a list of voxels from band_mask.cl
 *   2. find_cores    each word and its neighbours in 8 planes of bits: 32 counters of 8 bits side by side
 *   3. runs of core voxels along i, the nodes of the clusters, are listed and joined: cl/masks/runs.cl
 *   4. label_points  core voxels by their run, other voxels by the runs near them
 *
 * Counters, for min_samples = 6, of a word of 4 voxels.  They begin at 8 - 6 = 2, and one that overflows is a core
 * voxel, whatever its bits are afterwards:
 *
 *                    begin      + 1 1 0 1   + 1 1 0 1   + ... 6 words in all
 *      plane 7 (4)   0 0 0 0      0 0 0 0     1 1 0 1
 *      plane 6 (2)   1 1 1 1      1 1 1 1     0 0 1 0
 *      plane 5 (1)   0 0 0 0      1 1 0 1     0 0 0 0
 *
 * Two runs [a, b] and [c, d] in rows that a stencil row joins are neighbours when c <= b + highest and d >= a + lowest.
 * Widened runs overlap, so a run may be a neighbour of several runs before it and after it:
 *
 *      own row      ..###..##......    lowest -1, highest 1
 *      widened      .#########.....    columns 1 to 5 and 5 to 8: both meet column 5
 *      other row    .....#.........    is a neighbour of both: a sweep must not drop it after the first
 *
 * Races.  Each item writes words of its own alone: a block, a row. */
#include "points/bit_counters.h"
#include "points/core_runs.h"

/* Parameters  mask     in   (rows, words)
 *             row_extents  in   (rows)
 *             stencil  in   (m) rows of the stencils
 *             tables   in   (nk) begin and end of the stencil of each slice
 *             cores    out  (rows, words) set voxels with at least min_samples set voxels in their stencil
 *             nj, nk   rows a slice, and slices;  words a row
 *             item_words   words of a row for each item
 *             planes   ceil(log2(min_samples)), 1 to 8
 *             start    2^planes - min_samples
 * Launch      global = nk nj ceil(words / item_words) rounded up by the host, any local
 * Assumes     nk nj words < 2^31; the rows of a stencil end within the zeros behind a row
 * Guarantees  every word is written */
__kernel void find_cores(
    __global const uint *restrict mask, __global const ushort2 *restrict row_extents,
    __global const int4 *restrict stencil, __global const int2 *restrict tables, __global uint *restrict cores,
    const int nj, const int nk, const int words, const int item_words, const int planes, const uint start)
{
    const uint item = get_global_id(0);
    const int items_a_row = (words + item_words - 1) / item_words;
    const int row = (int)(item / items_a_row);
    if (row >= nj * nk)
        return;
    const int first = (int)(item % items_a_row) * item_words, last = min(first + item_words, words);
    const int begin = clamp((int)row_extents[row].x, first, last), end = clamp((int)row_extents[row].y, begin, last);
    __global uint *own_cores = cores + row * words;
    for (int w = first; w < begin; ++w)
        own_cores[w] = 0;
    for (int w = end; w < last; ++w)
        own_cores[w] = 0;
    if (begin == end)
        return;
    const int total = nj * nk * words, j = row % nj, k = row / nj;
    const int2 table = tables[k];
    for (int w = begin; w < end; w += LANES) {
        const word_lanes own = load_words(mask, row * words + w, total);
        word_lanes core = (word_lanes)(0);
        if (ANY_BIT(own)) {
            bit_counters counters;
            counters.p7 = (word_lanes)(FIRST_BIT(1));
            counters.p6 = (word_lanes)(FIRST_BIT(2));
            counters.p5 = (word_lanes)(FIRST_BIT(3));
            counters.p4 = (word_lanes)(FIRST_BIT(4));
            counters.p3 = (word_lanes)(FIRST_BIT(5));
            counters.p2 = (word_lanes)(FIRST_BIT(6));
            counters.p1 = (word_lanes)(FIRST_BIT(7));
            counters.p0 = (word_lanes)(FIRST_BIT(8));
            for (int which = table.x; which < table.y && ANY_BIT(own & ~core); ++which) {
                const int4 near = stencil[which];
                if (j + near.x < 0 || j + near.x >= nj || k + near.y < 0 || k + near.y >= nk)
                    continue;
                const int other = (row + near.y * nj + near.x) * words + w;
                for (int di = near.z; di <= near.w; ++di)
                    core |= add_bits(&counters, load_shifted(mask, other, di, total), planes);
            }
            core &= own;
        }
        store_words(core, own_cores + w, end - w);
    }
}

/* Parameters  mask, cores  in   (rows, words)
 *             row_extents  in   (rows)
 *             runs         in   (count)
 *             row_counts   in   (2, rows + 1) first run of each row, and `count`; `count` and the points of all rows
 *                               before
 *             numbers      in   (count) cluster of each run
 *             stencil      in   (m) rows of the stencils
 *             tables       in   (nk)
 *             labels       out  (points) cluster of each point, the lowest near a border point; -1 for noise
 *             nj, nk       rows a slice, and slices;  words a row
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every label is written */
__kernel void label_points(
    __global const uint *restrict mask, __global const uint *restrict cores,
    __global const ushort2 *restrict row_extents, __global const ushort2 *restrict runs,
    __global const uint *restrict row_counts, __global const int *restrict numbers, __global const int4 *restrict stencil,
    __global const int2 *restrict tables, __global int *restrict labels, const int nj, const int nk, const int words)
{
    const int row = get_global_id(0);
    if (row >= nj * nk)
        return;
    const ushort2 extent = row_extents[row];
    if (extent.x == extent.y)
        return;
    const int own_at = row * words;
    __global int *own = labels + (row_counts[nj * nk + 1 + row] - row_counts[nj * nk]);
    const uint end_run = row_counts[row + 1];
    uint run = row_counts[row], point = 0, open = 0;
    for (int w = extent.x; w < extent.y; ++w) {
        const uint bits = mask[own_at + w], border = bits & ~cores[own_at + w];
        for (; run < end_run && runs[run].x < 32 * (w + 1); ++run) {
            const uint before = popcount(bits & ((1u << (runs[run].x & 31)) - 1));
            fill_labels(own + point + before, runs[run].y - runs[run].x + 1, numbers[run]);
        }
        for (uint rest = border; rest != 0; rest &= rest - 1)
            own[point + popcount(bits & ((rest & -rest) - 1))] = -1;
        open |= border;
        point += popcount(bits);
    }
    if (open == 0)
        return;
    const int j = row % nj, k = row / nj;
    const int2 table = tables[k];
    for (int which = table.x; which < table.y; ++which) {
        const int4 near = stencil[which];
        if (j + near.x < 0 || j + near.x >= nj || k + near.y < 0 || k + near.y >= nk)
            continue;
        const int other = row + near.y * nj + near.x;
        const uint first = row_counts[other], end = row_counts[other + 1];
        if (first != end)
            label_borders(mask, cores, runs, numbers, own, near, own_at, other * words, first, end, extent,
                nj * nk * words);
    }
}

/* Parameters  mask, cores  in   (rows, words)
 *             row_extents  in   (rows)
 *             row_counts   in   (2, rows + 1), as label_points
 *             flags        out  (points) 1 for core points, else 0
 *             rows, words
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every flag is written */
__kernel void flag_cores(
    __global const uint *restrict mask, __global const uint *restrict cores,
    __global const ushort2 *restrict row_extents, __global const uint *restrict row_counts,
    __global uchar *restrict flags, const uint rows, const int words)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    const ushort2 extent = row_extents[row];
    const size_t at = (size_t)row * words;
    uint point = row_counts[rows + 1 + row] - row_counts[rows];
    for (int w = extent.x; w < extent.y; ++w) {
        const uint core = cores[at + w];
        for (uint rest = mask[at + w]; rest != 0; rest &= rest - 1)
            flags[point++] = (uchar)((core & rest & -rest) != 0);
    }
}
