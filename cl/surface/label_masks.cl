/* The occupancy of a label: its mask smoothed by two rounds of [1 2 1] / 4 along each axis, exact in whole numbers.
 *
 * References: our own; smoothing binary samples before contouring is old (Gibson 1998 names what is wrong with it alone:
 * thin parts vanish; here the mask keeps deciding what is inside, see surface/mask_border.h).
 *
 * One axis:  weights  1  4  6  4  1   of samples i - 2 .. i + 2; beyond the map its outermost samples go on
 *
 * Passes
 *   1. smooth_rows      along i: 0 to 16 a sample
 *   2. smooth_across    along j and k: 0 to 4096, stored times FINENESS
 *   3. classify_mask    one bit a sample: carries the label
 *      (counting and writing: cl/surface/marching_cubes.cl with -D MASKS)
 *   4. sum_volumes      what the triangles enclose, for the choice of the level */
#include "include/label_type.h"
#include "include/volume.h"
#include "surface/label_masks.h"
#include "include/mask_rows.h"

#if REACH != 2
#error "the rows below have five samples"
#endif

#define STRIP 16 /* samples of a row that are smoothed at once, or not at all */
#define WHOLE 16 /* the sum along a row where all samples count */

/* 16 samples from `at` on: 255 where they carry `label`, or any label where that is 0; else 0. */
static inline uchar16 find_label(__global const LABEL *at, const LABEL label)
{
    const short16 found = convert_short16(vload16(0, at) == (LABEL)label);
    return as_uchar16(convert_char16(label != 0 ? found : ~found));
}

/* Note that sums of samples first .. last of a row are not all 0, or not all WHOLE, in its flags: see smooth_rows. */
static inline void note_strips(__global uint2 *flags, int first, int last, int occupied, int vacant)
{
    for (int strip = first / STRIP; strip <= last / STRIP; ++strip)
        flags[strip / 32] |= (uint2)((uint)occupied << (strip & 31), (uint)vacant << (strip & 31));
}

/* Parameters  map       in   slices of (nk, nj, ni) from first_slice on
 *             rows      out  as `map`: sums along i
 *             strips    out  (slices of the map, nj, flag_words) bit n of the one: of samples STRIP n .. STRIP n + 15 of
 *                            the row some may have sums above 0; of the other: some may have sums below WHOLE
 *             label     number of the label; 0: all labels
 *             ni nj     of the whole map
 *             begin_i end_i begin_j end_j   the samples that are wanted: others are not written
 *             begin_slice slices            the same of slices, counted from first_slice
 * Launch      global = slices * (end_j - begin_j) rounded up by the host, any local: one item a row
 * Guarantees  every wanted sum is written; samples up to 15 before or behind them in the row may be too, right as well */
__kernel void smooth_rows(
    __global const LABEL *restrict map, __global ushort *restrict rows, __global uint2 *restrict strips,
    const uint label, const int ni, const int nj, const int begin_i, const int end_i, const int begin_j, const int end_j,
    const int begin_slice, const uint slices)
{
    const uint item = get_global_id(0), height = end_j - begin_j;
    if (item >= height * slices)
        return;
    const size_t row = voxel_index(0, begin_j + (int)(item % height), begin_slice + (int)(item / height), ni, nj);
    __global const LABEL *in = map + row;
    __global ushort *out = rows + row;
    const int flag_words = (ni + 32 * STRIP - 1) / (32 * STRIP);
    __global uint2 *flags = strips + row / ni * flag_words;
    for (int w = 0; w < flag_words; ++w)
        flags[w] = (uint2)(0, 0);
#define AT(i) ((ushort)(label != 0 ? in[clamp(i, 0, ni - 1)] == label : in[clamp(i, 0, ni - 1)] != 0))
    int i = begin_i;
    while (i < end_i) {
        if (i >= REACH && i + 16 + REACH <= ni) {
            const uchar16 sum = (find_label(in + i - 2, (LABEL)label) & (uchar)1)
                + (find_label(in + i - 1, (LABEL)label) & (uchar)4) + (find_label(in + i, (LABEL)label) & (uchar)6)
                + (find_label(in + i + 1, (LABEL)label) & (uchar)4) + (find_label(in + i + 2, (LABEL)label) & (uchar)1);
            const ulong2 sums = as_ulong2(sum), missing = as_ulong2(sum ^ (uchar)WHOLE);
            note_strips(flags, i, i + 15, (sums.x | sums.y) != 0, (missing.x | missing.y) != 0);
            vstore16(convert_ushort16(sum), 0, out + i); /* once here: the next pass reads each 25 times */
            i += 16;
        } else {
            out[i] = (ushort)(AT(i - 2) + AT(i + 2) + 4 * (AT(i - 1) + AT(i + 1)) + 6 * AT(i));
            note_strips(flags, i, i, out[i] != 0, out[i] != WHOLE);
            ++i;
        }
    }
#undef AT
}

/* The 5 x 5 rows around a row of samples: where those of its slice begin, and its slice k of `nk`, of which the buffer
 * has those from `first` on. */
typedef struct {
    size_t along_j[2 * REACH + 1], slice;
    int k, nk, first;
} rows_around;

/* Place in the buffer of row (d, n) of them. */
static inline size_t row_around(const rows_around *around, const int d, const int n)
{
    return (size_t)(clamp(around->k + d - REACH, 0, around->nk - 1) - around->first) * around->slice + around->along_j[n];
}

/* Occupancies of the 16 samples of a strip, from the sums of 5 x 5 rows. */
static inline void smooth_strip(__global const ushort *rows, const rows_around *around, __global short *out)
{
    ushort16 sum = 0;
    for (int d = 0; d <= 2 * REACH; ++d) {
#define ROW(n) vload16(0, rows + row_around(around, d, n))
        const ushort16 plane = ROW(0) + ROW(4) + (ushort)4 * (ROW(1) + ROW(3)) + (ushort)6 * ROW(2);
#undef ROW
        sum += (ushort)weigh(d - REACH) * plane;
    }
    vstore16(as_short16(sum * (ushort)FINENESS), 0, out);
}

/* The same of the last samples of a row, from `first` on. */
static inline void smooth_rest(
    __global const ushort *rows, const rows_around *around, __global short *out, int first, int ni)
{
    for (int i = first; i < ni; ++i) {
        int sum = 0;
        for (int d = 0; d <= 2 * REACH; ++d)
            for (int n = 0; n <= 2 * REACH; ++n)
                sum += weigh(d - REACH) * weigh(n - REACH) * rows[row_around(around, d, n) + i];
        out[i] = (short)(FINENESS * sum);
    }
}

/* Parameters  rows        in   (row_slices, nj, ni) of smooth_rows, from slice first_row_slice of the map on
 *             strips      in   those of smooth_rows, with as many slices
 *             occupancy   out  as `rows`
 *             ni nj nk    of the whole map
 *             begin_i end_i begin_j end_j   the samples that are wanted: others are not written
 *             first_row_slice   slice of the map that both begin with
 *             first_slice slices   those that are wanted
 * Launch      global = slices * (end_j - begin_j) rounded up by the host, any local: one item a row
 * Assumes     `rows` has the wanted samples and those REACH around them, as far as the map goes
 * Guarantees  every wanted occupancy above 0 and below FULL is written; those of other samples may be, and samples up to
 *             15 before or behind them in the row, with any value: vertices depend on none of them */
__kernel void smooth_across(
    __global const ushort *restrict rows, __global const uint2 *restrict strips, __global short *restrict occupancy,
    const int ni, const int nj, const int nk, const int begin_i, const int end_i, const int begin_j, const int end_j,
    const int first_row_slice, const int first_slice, const uint slices)
{
    const uint item = get_global_id(0), height = end_j - begin_j;
    if (item >= height * slices)
        return;
    const int j = begin_j + (int)(item % height), k = first_slice + (int)(item / height);
    __global short *out = occupancy + voxel_index(0, j, k - first_row_slice, ni, nj);
    rows_around around;
    for (int n = 0; n <= 2 * REACH; ++n)
        around.along_j[n] = voxel_index(0, clamp(j + n - REACH, 0, nj - 1), 0, ni, nj);
    around.slice = voxel_index(0, 0, 1, ni, nj);
    around.k = k;
    around.nk = nk;
    around.first = first_row_slice;
    const int flag_words = (ni + 32 * STRIP - 1) / (32 * STRIP);
    for (int w = begin_i / (32 * STRIP); 32 * STRIP * w < end_i; ++w) {
        uint2 flags = 0; /* where all sums are 0, or all are WHOLE, no border is near */
        for (int d = 0; d <= 2 * REACH; ++d)
            for (int n = 0; n <= 2 * REACH; ++n)
                flags |= strips[row_around(&around, d, n) / ni * flag_words + w];
        for (uint busy = flags.x & flags.y; busy != 0; busy &= busy - 1) {
            const int first = STRIP * (32 * w + (int)lowest_bit(busy));
            if (first + STRIP <= ni)
                smooth_strip(rows + first, &around, out + first);
            else
                smooth_rest(rows, &around, out, first, ni);
        }
    }
}

/* The word of 32 samples that starts at voxel `first` of a row; `first` may lie before it, samples may lie beyond. */
static inline uint classify_label_word(__global const LABEL *row, int first, int ni, LABEL label)
{
    if (first >= 0 && first + 32 <= ni)
        return pack_lanes(convert_short16(vload16(0, row + first) == label))
            | pack_lanes(convert_short16(vload16(0, row + first + 16) == label)) << 16;
    uint bits = 0;
    for (int b = max(0, -first); b < min(32, ni - first); ++b)
        bits |= (uint)(row[first + b] == label) << b;
    return bits;
}

/* Parameters  map         in   slices of (nk, nj, ni) from first_slice on
 *             mask        out  (gk, gj, words) bit set where the sample carries `label`
 *             row_extents out  (gk, gj) first word of the row with a bit set, and the one after the last; 0, 0 in rows
 *                              without any
 *             label       number of the label
 *             begin_j end_j   rows that may hold it
 *             ni nj nk, border    of the whole map
 *             first_slice         slice of the map that `map` begins with
 *             first_sample_slice  slice of the sample grid that the mask begins with
 *             gk                  slices of the mask
 *             words               words a row, ceil((ni + 2 border) / 32)
 * Launch      global = gk * gj rounded up by the host, any local: one item a row, as classify_samples
 * Assumes     the slices of the mask that lie in the map are among those of `map`
 * Guarantees  every word of the mask and every extent is written; bits beyond the row are 0 */
__kernel void classify_mask(
    __global const LABEL *restrict map, __global uint *restrict mask, __global ushort2 *restrict row_extents,
    const uint label, const int begin_j, const int end_j,
    const int ni, const int nj, const int nk, const int border, const int first_slice, const int first_sample_slice,
    const uint gk, const int words)
{
    const uint gj = nj + 2 * border;
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    __global uint *row_mask = mask + (size_t)row * words;
    const int j = (int)(row % gj) - border, k = (int)(row / gj) + first_sample_slice - border;
    const int in_box = j >= begin_j && j < end_j && k >= 0 && k < nk;
    __global const LABEL *samples = map + (in_box ? voxel_index(0, j, k - first_slice, ni, nj) : 0);
    int begin = words, end = 0;
    for (int w = 0; w < words; ++w) {
        const uint bits = in_box ? classify_label_word(samples, 32 * w - border, ni, (LABEL)label) : 0;
        row_mask[w] = bits;
        begin = min(begin, bits != 0 ? w : words);
        end = bits != 0 ? w + 1 : end;
    }
    row_extents[row] = (ushort2)((ushort)min(begin, end), (ushort)end);
}

/* Parameters  positions   in   (vertices, 3) mm
 *             triangles   in   (triangle_count, 3)
 *             sums        out  (ceil(triangle_count / triangles_per_sum),) six times the volume between so many
 *                              triangles and `centre`, mm3
 *             centre      mm, near the triangles: products of small numbers keep their digits
 *             triangle_count
 * Launch      global = sums rounded up by the host, any local
 * Guarantees  every sum is written once: the same on every run */
__kernel void sum_volumes(
    __global const float *restrict positions, __global const uint *restrict triangles, __global float *restrict sums,
    const float4 centre, const uint triangle_count, const uint triangles_per_sum)
{
    const uint item = get_global_id(0);
    const ulong begin = (ulong)item * triangles_per_sum;
    if (begin >= triangle_count)
        return;
    const uint end = (uint)min(begin + triangles_per_sum, (ulong)triangle_count);
    float sum = 0.0f;
    for (uint n = (uint)begin; n < end; ++n) {
        const uint3 corners = vload3(n, triangles);
        const float3 a = vload3(corners.x, positions), b = vload3(corners.y, positions), c = vload3(corners.z, positions);
        sum += dot3(a - centre.xyz, cross3(b - a, c - a));
    }
    sums[item] = sum;
}
