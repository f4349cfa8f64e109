/* Where a transfer function shows anything: ranges of bricks of cells, and the distance to the next that shows.
 *
 * Passes
 *   1. measure_cells     once a volume: lowest and highest value that a sample in a brick can have
 *   2. mark_bricks       once a transfer function
 *   3. spread_distances  three times, along i, j, k: a separable Chebyshev distance transform */
#include "include/leap.h"
#include "include/volume.h"

/* Parameters  voxels  in   (nk, nj, ni)
 *             ranges  out  (bk, bj, bi, 2) lowest and highest of the 9 x 9 x 9 voxels around the cells of a brick
 *             ni nj nk, bi bj bk   voxels, bricks: ceil(cells / BRICK_CELLS), at least 1
 * Launch      global = bi * bj * bk rounded up by the host, any local
 * Assumes     no voxel is NaN; at least two voxels along each axis
 * Guarantees  every range is written */
__kernel void measure_cells(
    __global const VOXEL *restrict voxels, __global VOXEL *restrict ranges, const int ni, const int nj, const int nk,
    const uint bi, const uint bj, const uint bk)
{
    const size_t brick = get_global_id(0);
    if (brick >= (size_t)bi * bj * bk)
        return;
    const int i = BRICK_CELLS * (int)(brick % bi), j = BRICK_CELLS * (int)(brick / bi % bj);
    const int k = BRICK_CELLS * (int)(brick / bi / bj);
    const int i_last = min(i + BRICK_CELLS, ni - 1);
    const int j_last = min(j + BRICK_CELLS, nj - 1), k_last = min(k + BRICK_CELLS, nk - 1);
    VOXEL lowest = voxels[voxel_index(i, j, k, ni, nj)], highest = lowest;
    if (ni >= 8) {
        /* Eight voxels and the one after them; at the end of a row the last eight. */
        const int from = min(i, ni - 8);
        VOXEL8 low = (VOXEL8)(lowest), high = low;
        for (int at_k = k; at_k <= k_last; ++at_k)
            for (int at_j = j; at_j <= j_last; ++at_j) {
                __global const VOXEL *row = voxels + voxel_index(0, at_j, at_k, ni, nj);
                const VOXEL8 values = vload8(0, row + from);
                low = min(low, values);
                high = max(high, values);
                lowest = min(lowest, row[i_last]);
                highest = max(highest, row[i_last]);
            }
        lowest = min(lowest, min(min(min(low.s0, low.s1), min(low.s2, low.s3)),
                                 min(min(low.s4, low.s5), min(low.s6, low.s7))));
        highest = max(highest, max(max(max(high.s0, high.s1), max(high.s2, high.s3)),
                                   max(max(high.s4, high.s5), max(high.s6, high.s7))));
    } else {
        for (int at_k = k; at_k <= k_last; ++at_k)
            for (int at_j = j; at_j <= j_last; ++at_j)
                for (int at_i = i; at_i <= i_last; ++at_i) {
                    const VOXEL value = voxels[voxel_index(at_i, at_j, at_k, ni, nj)];
                    lowest = min(lowest, value);
                    highest = max(highest, value);
                }
    }
    ranges[2 * brick] = lowest;
    ranges[2 * brick + 1] = highest;
}

/* Parameters  ranges     in   (bricks, 2)
 *             shown      in   (bins + 1) how many bins before each show anything
 *             distances  out  (bricks) 0 where a brick may show something, 255 elsewhere
 *             bins_low bins_scale bins   node of a value v: (v - bins_low) * bins_scale + 0.5, clamped to 0..bins - 1
 * Launch      global = bricks rounded up by the host, any local
 * Guarantees  every distance is written; rounding never hides a bin */
__kernel void mark_bricks(
    __global const VOXEL *restrict ranges, __global const int *restrict shown, __global uchar *restrict distances,
    const float bins_low, const float bins_scale, const int bins, const uint bricks)
{
    const uint brick = get_global_id(0);
    if (brick >= bricks)
        return;
    const float last = (float)(bins - 1);
    const float low = ((float)ranges[2 * (size_t)brick] - bins_low) * bins_scale + 0.49f;
    const float high = ((float)ranges[2 * (size_t)brick + 1] - bins_low) * bins_scale + 0.51f;
    const int first = (int)clamp(low, 0.0f, last), end = (int)clamp(high, 0.0f, last) + 1;
    distances[brick] = shown[end] > shown[first] ? 0 : 255;
}

/* Parameters  from   in   (bricks) distances so far
 *             to     out  (bricks) the same with what lies along the line through each brick
 *             count  bricks a line;  stride: from one to the next;  bricks: all
 * Launch      global = bricks rounded up by the host, any local
 * Guarantees  to = min over the line of max(distance along it, from) */
__kernel void spread_distances(
    __global const uchar *restrict from, __global uchar *restrict to, const int count, const int stride,
    const uint bricks)
{
    const uint brick = get_global_id(0);
    if (brick >= bricks)
        return;
    const int here = (int)(brick / (uint)stride % (uint)count);
    int best = from[brick];
    for (int way = 1; way < best && (way <= here || here + way < count); ++way) {
        if (way <= here)
            best = min(best, max(way, (int)from[brick - way * stride]));
        if (here + way < count)
            best = min(best, max(way, (int)from[brick + way * stride]));
    }
    to[brick] = (uchar)best;
}
