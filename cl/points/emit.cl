/* Points of the voxels in a mask: their places in mm, their values and their numbers, in the order k, j, i.
 *
 * Reference: the affine cloud of a CT series, one product a voxel, here of the voxels that are kept alone.
 *
 * Passes (the mask itself is that of cl/masks/classify.cl, without a border)
 *   1. restrict_mask   only voxels of a label, or of any, stay in the mask
 *   2. find_shell      for shells: only voxels with one of six neighbours outside stay, in a mask of its own
 *   3. count_points    bits of each row (then the exclusive scan of scan.cl: number of the row's first point)
 *   4. emit_points     the points
 *
 *      mask of a row     0 1 1 0 0 1 ...      offset of the row 40
 *      points            40 41     42         place = origin of slice k + j * row step + i * column step
 *
 * A place is the sum of two floats until it is written: a product of a step's first 12 bits with an index below 4096 is
 * exact, and what a sum loses is added to the rest (Knuth 1969, two-sum).  So it is rounded once. */
#include "include/label_type.h"
#include "include/volume.h"


#define ROWS_AHEAD 2 /* rows between the one whose points are written and the one whose voxels are asked for */

/* Parameters  mask         in/out  (slices, nj, words)
 *             row_extents  in      (slices, nj) first word of the row with a bit set, and the one after the last
 *             labels       in      (slices, nj, ni)
 *             label        number that stays; 0: every number but 0
 *             ni nj words rows     rows = slices * nj
 * Launch      global = rows rounded up by the host, any local: one item a row
 * Guarantees  words beyond the extent stay as they are: 0 */
__kernel void restrict_mask(
    __global uint *restrict mask, __global const ushort2 *restrict row_extents, __global const LABEL *restrict labels,
    const uint label, const int ni, const int words, const uint rows)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    const ushort2 extent = row_extents[row];
    __global const LABEL *row_labels = labels + (size_t)row * ni;
    for (int w = extent.x; w < extent.y; ++w) {
        const size_t at = (size_t)row * words + w;
        uint kept = 0;
        for (uint bits = mask[at]; bits != 0; bits &= bits - 1) {
            const uint found = row_labels[32 * w + popcount((bits & -bits) - 1)];
            kept |= (label != 0 ? found == label : found != 0) ? bits & -bits : 0;
        }
        mask[at] = kept;
    }
}

/* Parameters  mask         in   (slices, nj, words)
 *             row_extents  in   (slices, nj)
 *             shell        out  (slices, nj, words) voxels of the mask with one of six neighbours outside
 *             nj words slices   of the mask: beyond it everything is outside
 * Launch      global = slices * nj rounded up by the host, any local: one item a row
 * Guarantees  every word of the shell within the row's extent is written, no other */
__kernel void find_shell(
    __global const uint *restrict mask, __global const ushort2 *restrict row_extents, __global uint *restrict shell,
    const int nj, const int words, const int slices)
{
    const uint row = get_global_id(0);
    if (row >= (uint)nj * slices)
        return;
    const int j = (int)(row % nj), k = (int)(row / nj);
    const ushort2 extent = row_extents[row];
    __global const uint *own = mask + (size_t)row * words;
    const long slice_words = (long)nj * words;
    for (int w = extent.x; w < extent.y; ++w) {
        const uint bits = own[w];
        const uint before = bits << 1 | (w > 0 ? own[w - 1] >> 31 : 0);
        const uint after = bits >> 1 | (w + 1 < words ? own[w + 1] << 31 : 0);
        const uint rows_around = (j > 0 ? own[w - words] : 0) & (j + 1 < nj ? own[w + words] : 0);
        const uint slices_around = (k > 0 ? own[w - slice_words] : 0) & (k + 1 < slices ? own[w + slice_words] : 0);
        shell[(size_t)row * words + w] = bits & ~(before & after & rows_around & slices_around);
    }
}

/* Parameters  mask         in   (first_row + rows, words)
 *             row_extents  in   (first_row + rows,)
 *             counts       out  (rows,) bits of each row
 *             first_row    first row of the mask that is counted
 *             words rows
 * Launch      global = rows rounded up by the host, any local: one item a row */
__kernel void count_points(
    __global const uint *restrict mask, __global const ushort2 *restrict row_extents, __global uint *restrict counts,
    const uint first_row, const int words, const uint rows)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    const ushort2 extent = row_extents[first_row + row];
    __global const uint *row_mask = mask + ((size_t)first_row + row) * words;
    uint count = 0;
    for (int w = extent.x; w < extent.y; ++w)
        count += popcount(row_mask[w]);
    counts[row] = count;
}

/* A place in mm: x, y, z of the nearest floats, and what they leave over. */
typedef struct {
    float4 sum, rest;
} exact_place;

/* Moves a place by n steps; `head` has 12 bits, `rest` what the step has beyond them. */
static inline exact_place move_by(exact_place place, int n, float4 head, float4 rest)
{
    const float4 way = (float)n * head;
    const float4 sum = place.sum + way;
    const float4 added = sum - place.sum;
    const float4 lost = (place.sum - (sum - added)) + (way - added);
    const exact_place moved = {sum, place.rest + (lost + (float)n * rest)};
    return moved;
}

/* What the points of a row have in common, and where they go. */
typedef struct {
    exact_place start; /* place of the row's first voxel */
    float4 head, rest; /* column step */
    __global const VOXEL *voxels; /* of the row */
    uint number; /* of its first voxel */
    __global float *positions, *hu;
    __global uint *numbers;
} point_row;

static inline void emit_point(const point_row *row, int i, size_t at)
{
    const exact_place place = move_by(row->start, i, row->head, row->rest);
    vstore3((place.sum + place.rest).xyz, at, row->positions);
    row->numbers[at] = row->number + (uint)i;
    row->hu[at] = (float)row->voxels[i];
}

/* Asks for the voxels of a row's points before they are needed: a word of a mask has about one line of a cache.  Only the
 * bits tell which lines these are, so a processor does not ask for them by itself. */
static inline void ask_for_voxels(
    __global const uint *mask, ushort2 extent, __global const VOXEL *voxels)
{
#ifdef HAS_BUILTIN_PREFETCH
    for (int w = extent.x; w < extent.y; ++w)
        if (mask[w] != 0)
            __builtin_prefetch((const void *)(size_t)(voxels + 32 * w));
#endif
}

/* Parameters  mask         in   (first_row + rows, words)
 *             row_extents  in   (first_row + rows,)
 *             offsets      in   (rows,) number of the row's first point
 *             voxels       in   (first_row + rows, ni)
 *             origins      in   (slices, 2) place of voxel (0, 0, k), mm: nearest floats and the rest
 *             steps        in   (4) column step, row step: first 12 bits and the rest of each, mm
 *             positions    out  (points, 3) mm
 *             hu           out  (points,) values of the voxels
 *             numbers      out  (points,) number of the voxel, i + ni (j + nj k), from that of the first row on
 *             first_number number of the first row's first voxel
 *             first_row    row of mask, extents and voxels that this slice begins with
 *             ni nj words rows
 *             words_per_item   words of an item: all of a row on CPUs, one on GPUs
 * Launch      global = rows * ceil(words / words_per_item) rounded up by the host, any local
 * Guarantees  the points in the order k, j, i; each is the place in exact arithmetic rounded to float32, but for 1e-6 of
 *             a step of float32 */
__kernel void emit_points(
    __global const uint *restrict mask, __global const ushort2 *restrict row_extents,
    __global const uint *restrict offsets, __global const VOXEL *restrict voxels, __global const float4 *restrict origins,
    __global const float4 *restrict steps, __global float *restrict positions, __global float *restrict hu,
    __global uint *restrict numbers, const uint first_number, const uint first_row, const int ni, const int nj, const int words,
    const int words_per_item, const uint rows)
{
    const uint items_a_row = (uint)(words + words_per_item - 1) / (uint)words_per_item;
    const uint item = get_global_id(0), row = item / items_a_row;
    if (row >= rows)
        return;
    const ushort2 extent = row_extents[first_row + row];
    const int first = (int)(item % items_a_row) * words_per_item;
    const int begin = max(first, (int)extent.x), end = min(first + words_per_item, (int)extent.y);
    __global const uint *row_mask = mask + ((size_t)first_row + row) * words;
    size_t at = offsets[row];
    for (int w = extent.x; w < begin; ++w)
        at += popcount(row_mask[w]);
    const int j = (int)(row % nj), k = (int)(row / nj);
    const exact_place slice = {origins[2 * k], origins[2 * k + 1]};
    if (row + ROWS_AHEAD < rows)
        ask_for_voxels(row_mask + (size_t)ROWS_AHEAD * words, row_extents[first_row + row + ROWS_AHEAD],
            voxels + ((size_t)first_row + row + ROWS_AHEAD) * ni);
    const point_row points = {move_by(slice, j, steps[2], steps[3]), steps[0], steps[1],
        voxels + ((size_t)first_row + row) * ni, first_number + row * ni, positions, hu, numbers};
    for (int w = begin; w < end; ++w)
        for (uint bits = row_mask[w]; bits != 0; bits &= bits - 1)
            emit_point(&points, 32 * w + (int)popcount((bits & -bits) - 1), at++);
}
