/* Bit masks of the same volume: joined, inverted, counted, and the voxels outside of one given another value.
 *
 * A row (j, k) is `words` words of 32 voxels: bit b of word w is voxel i = 32 w + b.  Bits beyond the row are 0.
 *
 * Passes (one of them)
 *   combine_masks   and, or, exclusive or, and not
 *   invert_mask     the voxels that are not set
 *   count_row_bits  set voxels of each row
 *   replace_outside   voxels */
#include "include/volume.h"

#define OPERATION_AND 0
#define OPERATION_OR 1
#define OPERATION_XOR 2
#define OPERATION_AND_NOT 3

/* Parameters  a, b       in   (n) words of two masks
 *             combined   out  (n)
 *             n          words
 *             operation  OPERATION_AND, ...
 * Launch      global = n rounded up by the host, any local
 * Guarantees  every word is written; bits beyond the rows stay 0 */
__kernel void combine_masks(
    __global const uint *restrict a, __global const uint *restrict b, __global uint *restrict combined, const uint n,
    const int operation)
{
    const uint word = get_global_id(0);
    if (word >= n)
        return;
    const uint one = a[word], other = b[word];
    const uint bits = operation == OPERATION_AND ? one & other
        : operation == OPERATION_OR              ? one | other
        : operation == OPERATION_XOR             ? one ^ other
                                                 : one & ~other;
    combined[word] = bits;
}

/* Parameters  mask      in   (rows, words)
 *             inverted  out  (rows, words) the voxels of the row that `mask` has not
 *             n         rows words;  ni  voxels a row;  words  words a row
 * Launch      global = n rounded up by the host, any local
 * Guarantees  every word is written; bits beyond the rows are 0 */
__kernel void invert_mask(
    __global const uint *restrict mask, __global uint *restrict inverted, const uint n, const int ni, const int words)
{
    const uint word = get_global_id(0);
    if (word >= n)
        return;
    const int left = ni - 32 * (int)(word % words);
    const uint within = left >= 32 ? ~0u : (1u << left) - 1;
    inverted[word] = ~mask[word] & within;
}

/* Parameters  mask     in   (rows, words)
 *             counts   out  (rows) set voxels
 *             rows, words
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every count is written */
__kernel void count_row_bits(
    __global const uint *restrict mask, __global uint *restrict counts, const uint rows, const int words)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    __global const uint *own = mask + (size_t)row * words;
    uint count = 0;
    for (int w = 0; w < words; ++w)
        count += popcount(own[w]);
    counts[row] = count;
}

/* Parameters  voxels   in   (rows, ni)
 *             mask     in   (rows, words)
 *             replaced out  (rows, ni) the value of the voxel where it is set, else `outside`
 *             outside  value
 *             rows, words;  ni  voxels a row
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every voxel is written */
__kernel void replace_outside(
    __global const VOXEL *restrict voxels, __global const uint *restrict mask, __global VOXEL *restrict replaced,
    const VOXEL outside, const uint rows, const int words, const int ni)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    const size_t first = (size_t)row * ni;
    for (int w = 0; w < words; ++w) {
        const uint bits = mask[(size_t)row * words + w];
        const int begin = 32 * w, end = min(begin + 32, ni);
        for (int i = begin; i < end; ++i) {
            const VOXEL own = voxels[first + i];
            replaced[first + i] = bits >> (i - begin) & 1 ? own : outside;
        }
    }
}
