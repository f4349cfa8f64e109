/* Lowest and highest value of every brick of 8 x 8 x 8 voxels, which let later passes skip bricks.
 *
 * Reference: Wilhelms and Van Gelder 1992, "Octrees for faster isosurface generation"; here one level of bricks.
 *
 * Passes
 *   1. measure_bricks    once for a volume
 *   2. compare_bricks    once for an iso value: which words of samples are all inside, all outside, mixed */
#include "include/bricks.h"
#include "include/volume.h"

/* Parameters  voxels   in   (nk, nj, ni)
 *             ranges   out  (bk, bj, bi, 2) lowest and highest value of each brick
 *             ni nj nk, bi bj bk   voxels, bricks: ceil(n / BRICK)
 * Launch      global = bi * bj * bk rounded up by the host, any local
 * Assumes     no voxel is NaN
 * Guarantees  every range is written */
__kernel void measure_bricks(
    __global const VOXEL *restrict voxels, __global VOXEL *restrict ranges,
    const int ni, const int nj, const int nk, const uint bi, const uint bj, const uint bk)
{
    const size_t brick = get_global_id(0);
    if (brick >= (size_t)bi * bj * bk)
        return;
    const int i = BRICK * (int)(brick % bi), j = BRICK * (int)(brick / bi % bj), k = BRICK * (int)(brick / bi / bj);
    const int j_end = min(j + BRICK, nj), k_end = min(k + BRICK, nk);
    __global VOXEL *range = ranges + 2 * brick;
    if (ni < BRICK) {
        VOXEL low = voxels[voxel_index(i, j, k, ni, nj)], high = low;
        for (int at_k = k; at_k < k_end; ++at_k)
            for (int at_j = j; at_j < j_end; ++at_j)
                for (int at_i = 0; at_i < ni; ++at_i) {
                    const VOXEL value = voxels[voxel_index(at_i, at_j, at_k, ni, nj)];
                    low = min(low, value);
                    high = max(high, value);
                }
        range[0] = low;
        range[1] = high;
        return;
    }
    /* The last brick of a row takes the row's last voxels: some of them twice. */
    const size_t first = voxel_index(min(i, ni - BRICK), j, k, ni, nj);
    VOXEL8 low = vload8(0, voxels + first), high = low;
    for (int at_k = k; at_k < k_end; ++at_k)
        for (int at_j = j; at_j < j_end; ++at_j) {
            const VOXEL8 values = vload8(0, voxels + voxel_index(min(i, ni - BRICK), at_j, at_k, ni, nj));
            low = min(low, values);
            high = max(high, values);
        }
    range[0] = min(min(min(low.s0, low.s1), min(low.s2, low.s3)), min(min(low.s4, low.s5), min(low.s6, low.s7)));
    range[1]
        = max(max(max(high.s0, high.s1), max(high.s2, high.s3)), max(max(high.s4, high.s5), max(high.s6, high.s7)));
}

/* Parameters  ranges   in   (bk, bj, bi, 2)
 *             states   out  (bk, bj, words) of each word of 32 samples, for all rows of these bricks: BRICK_OUTSIDE,
 *                           BRICK_INSIDE or BRICK_MIXED.  Samples beyond the volume do not count
 *             extents  out  (bk, bj) first word that is not all outside, and the one after the last; 0, 0 where there is
 *                           none
 *             level    lowest inside value
 *             ni       voxels a row;  border: word w begins at voxel 32 w - border;  words: words a row
 *             rows     bj * bk
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every state and extent is written */
__kernel void compare_bricks(
    __global const VOXEL *restrict ranges, __global uchar *restrict states, __global ushort2 *restrict extents,
    const VOXEL level, const int ni, const int border, const uint words, const uint rows)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    const int bi = (ni + BRICK - 1) / BRICK;
    __global const VOXEL *row_ranges = ranges + 2 * (size_t)row * bi;
    uint begin = words, end = 0;
    for (uint w = 0; w < words; ++w) {
        const int first = 32 * (int)w - border;
        const int last_brick = (min(first + 32, ni) - 1) / BRICK;
        int all_inside = 1, all_outside = 1;
        for (int b = max(first, 0) / BRICK; first < ni && b <= last_brick; ++b) {
            all_inside &= row_ranges[2 * b] >= level;
            all_outside &= !(row_ranges[2 * b + 1] >= level);
        }
        states[(size_t)row * words + w] = all_outside ? BRICK_OUTSIDE : all_inside ? BRICK_INSIDE : BRICK_MIXED;
        begin = min(begin, all_outside ? words : w);
        end = all_outside ? end : w + 1;
    }
    extents[row] = (ushort2)((ushort)min(begin, end), (ushort)end);
}
