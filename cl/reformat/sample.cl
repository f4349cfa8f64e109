/* Slices through a volume: oblique planes and curved reformations, with thickness.
 *
 * A row of the picture is a straight line with a slab direction of its own (clrecon/rendering/views/reformation.py), so that one
 * kernel makes planes, stretched and straightened reformations (Kanitsar et al. 2002, "CPR - Curved Planar
 * Reformation").  Places are in fixed point, see reformat/trilinear_sample.h.
 *
 *      m = intervals        .   .   .   .   .   .       sample m of pixel x of a row lies at
 *                           .   .   .   .   .   .         place + x * step + (m - intervals / 2) * depth
 *      m = intervals / 2    o---o---o---o---o---o  ->   with the nine numbers of the row: place, step and depth
 *                           .   .   .   .   .   .
 *      m = 0                .   .   .   .   .   .
 *                         x 0   1   2   3   4   5
 *
 * Passes
 *   1. reformat_rows    once for each part of the volume that the device holds, for some rows at a time */
#include "reformat/trilinear_sample.h"

#ifndef UNEVEN
#define UNEVEN 0
#endif

#define COMBINE_MEAN 0
#define COMBINE_MAX 1
#define COMBINE_MIN 2

/* Find the slice at or below a height and the share of the way to the one above, and make i and j indices of it.
 * Returns whether the height lies in the stack. */
#if UNEVEN
static inline int find_slice(
    __global const long *slices, const int nk, const long height, long *i, long *j, int *k, float *share)
{
    int low = 0, high = nk - 1; /* the layer: slices[low] <= height < slices[low + 1], or one at an end */
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (slices[3 * middle + 2] <= height)
            low = middle;
        else
            high = middle;
    }
    __global const long *below = slices + 3 * low;
    const float gap = (float)(below[5] - below[2]), part = (float)(height - below[2]) / gap;
    if (!(part >= -0.5f - 1e-6f && part <= 1.5f + 1e-6f)) /* only in the first and the last layer */
        return 0;
    *i -= below[0] + (long)(part * (float)(below[3] - below[0]));
    *j -= below[1] + (long)(part * (float)(below[4] - below[1]));
    *k = part < 1.0f ? low : low + 1;
    *share = part < 1.0f ? fmax(part, 0.0f) : 0.0f;
    return 1;
}
#else
static inline int find_slice(
    __global const long *slices, const int nk, const long height, long *i, long *j, int *k, float *share)
{
    const long place = clamp_place(height, nk);
    *k = (int)(place >> 32);
    *share = (float)(uint)place * (1.0f / 4294967296.0f);
    return is_within(height, nk);
}
#endif

/* Parameters  voxels    in   the slices first_k and following of a volume of (nk, nj, ni)
 *             rows      in   (h, 9) 2^-32 units: the place of each row's first pixel on the sheet, the steps from pixel
 *                            to pixel, and from sample to sample along the slab.  Places are index coordinates (i, j, k);
 *                            of uneven stacks (u, v, height): in-plane coordinates from a common origin, mm upwards
 *             slices    in   (nk, 3) uneven stacks: place of voxel (0, 0, k), 2^-32 units; others: not read
 *             values    inout  (h, w) weighted sum, highest or lowest of the samples so far; NaN before the first of
 *                            highest and lowest
 *             weights   inout  (h, w) sum of the weights of the samples so far
 *             first_row, row_count   rows of this launch
 *             width     pixels a row
 *             ni nj nk, first_k
 *             own_first, own_end   samples whose lower slice is one of these are taken
 *             intervals even; samples m = 0 .. intervals lie m - intervals / 2 steps along the slab, the two ends count
 *                            half.  0: one sample on the sheet
 *             combine   COMBINE_MEAN, COMBINE_MAX or COMBINE_MIN
 *             fresh     1: values and weights hold nothing yet
 * Launch      global = row_count * width rounded up by the host, any local
 * Assumes     slices own_first to min(own_end, nk - 1) are there; all places lie within +-2^30 units of 2^32
 * Guarantees  every value and weight of these rows is written */
__kernel void reformat_rows(
    __global const VOXEL *restrict voxels, __global const long *restrict rows, __global const long *restrict slices,
    __global float *restrict values, __global float *restrict weights,
    const uint first_row, const uint row_count, const uint width,
    const int ni, const int nj, const int nk, const int first_k, const int own_first, const int own_end,
    const int intervals, const int combine, const int fresh)
{
    const size_t item = get_global_id(0);
    if (item >= (size_t)row_count * width)
        return;
    const uint x = (uint)(item % width);
    const size_t row = first_row + item / width, pixel = row * width + x;
    __global const long *geometry = rows + 9 * row;
    const size_t slice_voxels = (size_t)ni * (size_t)nj;
    const int middle_sample = intervals / 2;
    float value = fresh ? (combine == COMBINE_MEAN ? 0.0f : NAN) : values[pixel];
    float weight = fresh ? 0.0f : weights[pixel];
    for (int m = 0; m <= intervals; ++m) {
        long i = geometry[0] + (long)x * geometry[3] + (long)(m - middle_sample) * geometry[6];
        long j = geometry[1] + (long)x * geometry[4] + (long)(m - middle_sample) * geometry[7];
        const long height = geometry[2] + (long)x * geometry[5] + (long)(m - middle_sample) * geometry[8];
        int k;
        float fk;
        if (!find_slice(slices, nk, height, &i, &j, &k, &fk) || !is_within(i, ni) || !is_within(j, nj) || k < own_first
            || k >= own_end)
            continue;
        __global const VOXEL *lower = voxels + slice_voxels * (size_t)(k - first_k);
        __global const VOXEL *upper = fk > 0.0f ? lower + slice_voxels : lower;
        const float sample = sample_trilinear(lower, upper, clamp_place(i, ni), clamp_place(j, nj), fk, ni);
        const float share = intervals > 0 && (m == 0 || m == intervals) ? 0.5f : 1.0f;
        weight += share;
        value = combine == COMBINE_MEAN ? value + share * sample
            : combine == COMBINE_MAX ? fmax(value, sample) : fmin(value, sample);
    }
    values[pixel] = value;
    weights[pixel] = weight;
}
