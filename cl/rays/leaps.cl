/* Visible bricks of a transfer function: ranges of bricks of cells, and the distance to the next visible brick.
 *
 * Passes
 *   1. measure_cells     once for a volume: lowest and highest value that a sample in a brick can have
 *   2. mark_bricks       once for a transfer function
 *   3. spread_in_rows    along i, and
 *   4. spread_along      along j and along k: a separable Chebyshev distance transform
 *   5. look_ahead        once for a picture: the free distance in the direction of its rays */
#include "include/volume.h"
#include "rays/leap.h"
#include "rays/look_ahead.h"

#define ROWS_AT_ONCE 4

#define VOXEL4 CLRECON_VECTOR(VOXEL, 4)

typedef VOXEL4 some_voxels __attribute__((aligned(sizeof(VOXEL))));
typedef uchar16 some_bytes __attribute__((aligned(1)));
#define BYTES(from) (*(__global const some_bytes *)(from))

/* Some drivers call a function for each min(), max(), any() and vload16(). */
#define LESSER(a, b) ((a) < (b) ? (a) : (b))
#define GREATER(a, b) ((a) > (b) ? (a) : (b))

/* Parameters  voxels  in   (nk, nj, ni)
 *             ranges  out  (bk, bj, bi, 2) lowest and highest of the voxels around the cells of a brick
 *             ni nj nk, bi bj bk   voxels, bricks: ceil(cells / BRICK_CELLS), along k cells / cells_k, at least 1
 * Launch      global = bi * bj * bk rounded up by the host, any local
 * Assumes     no voxel is NaN; at least two voxels along each axis
 * Guarantees  every range is written */
__kernel void measure_cells(
    __global const VOXEL *restrict voxels, __global VOXEL *restrict ranges, const int ni, const int nj, const int nk,
    const uint bi, const uint bj, const uint bk, const int cells_k)
{
    const size_t brick = get_global_id(0);
    if (brick >= (size_t)bi * bj * bk)
        return;
    const int i = BRICK_CELLS * (int)(brick % bi), j = BRICK_CELLS * (int)(brick / bi % bj);
    const int k = cells_k * (int)(brick / bi / bj);
    const int i_last = min(i + BRICK_CELLS, ni - 1);
    const int j_last = min(j + BRICK_CELLS, nj - 1), k_last = min(k + cells_k, nk - 1);
    VOXEL lowest = voxels[voxel_index(i, j, k, ni, nj)], highest = lowest;
    if (ni >= BRICK_CELLS) {
        /* Four voxels and the one after them; at the end of a row its last four. */
        const int from = min(i, ni - BRICK_CELLS);
        VOXEL4 low = (VOXEL4)(lowest), high = low;
        for (int at_k = k; at_k <= k_last; ++at_k)
            for (int at_j = j; at_j <= j_last; ++at_j) {
                __global const VOXEL *row = voxels + voxel_index(0, at_j, at_k, ni, nj);
                const VOXEL4 values = *(__global const some_voxels *)(row + from);
                low = LESSER(low, values);
                high = GREATER(high, values);
                lowest = LESSER(lowest, row[i_last]);
                highest = GREATER(highest, row[i_last]);
            }
        lowest = min(lowest, min(min(low.x, low.y), min(low.z, low.w)));
        highest = max(highest, max(max(high.x, high.y), max(high.z, high.w)));
    } else {
        for (int at_k = k; at_k <= k_last; ++at_k)
            for (int at_j = j; at_j <= j_last; ++at_j)
                for (int at_i = i; at_i <= i_last; ++at_i) {
                    const VOXEL value = voxels[voxel_index(at_i, at_j, at_k, ni, nj)];
                    lowest = LESSER(lowest, value);
                    highest = GREATER(highest, value);
                }
    }
    ranges[2 * brick] = lowest;
    ranges[2 * brick + 1] = highest;
}

/* Parameters  ranges     in   (bricks, 2)
 *             shown      in   (bins + 1) number of visible bins before each
 *             distances  out  (bricks) 0 where a brick may show something, FARTHEST elsewhere
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
    const int first = (int)LESSER(GREATER(low, 0.0f), last), end = (int)LESSER(GREATER(high, 0.0f), last) + 1;
    distances[brick] = shown[end] > shown[first] ? 0 : FARTHEST;
}

/* Take one step along four rows, which begin at `rows`: distances at brick i from those at the brick before. */
static inline int4 step_in_rows(
    __global const uchar *from, __global uchar *to, const ulong4 rows, const int i, const int4 before)
{
    const int4 own = (int4)(from[rows.x + i], from[rows.y + i], from[rows.z + i], from[rows.w + i]);
    const int4 distance = LESSER(before + 1, own);
    to[rows.x + i] = (uchar)distance.x;
    to[rows.y + i] = (uchar)distance.y;
    to[rows.z + i] = (uchar)distance.z;
    to[rows.w + i] = (uchar)distance.w;
    return distance;
}

/* Parameters  distances  in   (rows, bi) 0 or FARTHEST
 *             spread     out  (rows, bi) distance along the row
 *             rows
 * Launch      global = rows / ROWS_AT_ONCE rounded up by the host, any local
 * Guarantees  every distance is written, none above FARTHEST */
__kernel void spread_in_rows(
    __global const uchar *restrict distances, __global uchar *restrict spread, const int bi, const uint rows)
{
    const uint first = (uint)get_global_id(0) * ROWS_AT_ONCE;
    if (first >= rows)
        return;
    /* Each step waits for the one before it: other rows have some meanwhile.  The last item may take its last row
     * twice. */
    const uint last = rows - 1;
    const ulong4 begin = (ulong4)(first, LESSER(first + 1, last), LESSER(first + 2, last), LESSER(first + 3, last))
        * (ulong)bi;
    int4 distance = FARTHEST;
    for (int i = 0; i < bi; ++i)
        distance = step_in_rows(distances, spread, begin, i, distance);
    for (int i = bi - 1; i >= 0; --i)
        distance = step_in_rows(spread, spread, begin, i, distance);
}

/* Parameters  distances  in   (outer, count, stride) distances so far
 *             spread     out  the same with what lies along the middle axis
 *             chunks of 16 bricks that cover `stride`;  items: outer * count * chunks
 * Launch      global = items rounded up by the host, any local
 * Guarantees  spread = min along the axis of max(distance along it, distances) */
__kernel void spread_along(
    __global const uchar *restrict distances, __global uchar *restrict spread, const int count, const int stride,
    const int chunks, const uint items)
{
    const uint item = get_global_id(0);
    if (item >= items)
        return;
    const int line = (int)(item / (uint)chunks % (uint)count);
    const size_t row = (size_t)(item / (uint)chunks) * stride;
    const int first = (int)(item % (uint)chunks) * 16;
    if (stride >= 16) {
        /* The last chunk takes the last 16: some of them twice. */
        const size_t here = row + min(first, stride - 16);
        uchar16 best = BYTES(distances + here);
        for (int way = 1; way < FARTHEST; ++way) {
            const ulong2 further_off = as_ulong2(best > (uchar16)((uchar)way));
            if ((further_off.x | further_off.y) == 0)
                break;
            uchar16 near = (uchar16)((uchar)FARTHEST);
            if (way <= line)
                near = BYTES(distances + here - (size_t)way * stride);
            if (line + way < count) {
                const uchar16 further = BYTES(distances + here + (size_t)way * stride);
                near = LESSER(near, further);
            }
            near = GREATER(near, (uchar16)((uchar)way));
            best = LESSER(best, near);
        }
        *(__global some_bytes *)(spread + here) = best;
        return;
    }
    for (int at = 0; at < stride; ++at) {
        const size_t here = row + at;
        int best = distances[here];
        for (int way = 1; way < best; ++way) {
            if (way <= line)
                best = min(best, max(way, (int)distances[here - (size_t)way * stride]));
            if (line + way < count)
                best = min(best, max(way, (int)distances[here + (size_t)way * stride]));
        }
        spread[here] = (uchar)best;
    }
}

/* Parameters  distances  in   (bk, bj, bi) as spread_along() left them
 *             ways       out  (bk, bj, bi) see rays/look_ahead.h: the same in the low four bits; in the high ones for
 *                             how many bricks ahead, the own one counted, nothing shows in its row and in those beside it
 *                             that rays through it drift to.  Beyond the last brick nothing does
 *             main_axis ahead eye aside   see main_way
 * Launch      global = rows of bricks along the main axis rounded up by the host, any local
 * Guarantees  every way is written */
__kernel void look_ahead(
    __global const uchar *restrict distances, __global uchar *restrict ways, const int bi, const int bj, const int bk,
    const int main_axis, const int ahead, const float4 eye, const float aside)
{
    const main_way way = { main_axis, ahead, eye, aside };
    /* Axes: the main one, and u and v across it. */
    const int count = main_axis == 0 ? bi : main_axis == 1 ? bj : bk;
    const int count_u = main_axis == 0 ? bj : bi, count_v = main_axis == 2 ? bj : bk;
    const int stride = main_axis == 0 ? 1 : main_axis == 1 ? bi : bi * bj;
    const int stride_u = main_axis == 0 ? bi : 1, stride_v = main_axis == 2 ? bi : bi * bj;
    const uint row = get_global_id(0);
    if (row >= (uint)count_u * (uint)count_v)
        return;
    const int u = (int)(row % (uint)count_u), v = (int)(row / (uint)count_u);
    const int beside_u = find_beside(&way, u, main_axis == 0 ? eye.y : eye.x, count_u);
    const int beside_v = find_beside(&way, v, main_axis == 2 ? eye.y : eye.z, count_v);
    const int here = u * stride_u + v * stride_v, to_u = (beside_u - u) * stride_u, to_v = (beside_v - v) * stride_v;
    int free = FARTHEST;
    for (int n = 0; n < count; ++n) {
        const int brick = ahead > 0 ? count - 1 - n : n;
        __global const uchar *own = distances + (size_t)brick * stride + here;
        const int is_free = own[0] > 0 && own[to_u] > 0 && own[to_v] > 0 && own[to_u + to_v] > 0;
        free = is_free ? LESSER(free + 1, FARTHEST) : 0;
        ways[(size_t)brick * stride + here] = (uchar)(free << 4 | own[0]);
    }
}
