/* Which groups of 16 voxels a filter can bring to the other side of a level, or take part in deciding where it lies.
 *
 * A weighted mean lies between its values: a voxel whose whole window is on one side of the level stays there.  So the
 * groups whose windows are mixed are all that a filter has to make.  A word holds one bit for each of 32 groups of a
 * row: "some" where a voxel of the box around the group is inside (value >= level), "every" where every one is.
 *
 *     group           g - 1              g               g + 1
 *     voxels          ..............xx|xxxxxxxxxxxxxxxx|xx..............      reach = 2 along i
 *                                   `--- some, every of group g ---'
 *     rows            some |= those of rows j - reach_j .. j + reach_j, every &=, and then the same along k
 *     mixed           some & ~every
 *
 * Boxes are not smaller than the window; they overlap from voxel to voxel, so one of them is mixed exactly if all of
 * them together are.
 *
 * Passes
 *   1. classify_groups      along i
 *   2. spread_groups        along j
 *   3. mark_mixed_groups    along k; cl/primitives/compact.cl lists the bits */
#include "include/volume.h"

#define GROUP 16 /* voxels of a group, as in filters/bilateral.cl */

/* Bits of up to 16 voxels that are inside. */
static inline uint inside_bits(__global const VOXEL *voxels, const int count, const VOXEL level)
{
    uint bits = 0;
    for (int n = 0; n < count; ++n)
        bits |= (uint)(voxels[n] >= level) << n;
    return bits;
}

/* Parameters  voxels  in   (rows, ni)
 *             some    out  (rows, words)
 *             every   out  (rows, words) bits beyond the row are 0 in both
 *             level   lowest value inside
 *             ni      voxels a row;  rows;  words a row, ceil(groups / 32)
 *             reach   voxels beyond a group that its box holds, at most GROUP
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every word is written; beyond the row nothing is mixed */
__kernel void classify_groups(
    __global const VOXEL *restrict voxels, __global uint *restrict some, __global uint *restrict every,
    const VOXEL level, const int ni, const uint rows, const int words, const int reach)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    __global const VOXEL *line = voxels + (size_t)row * ni;
    const int groups = (ni + GROUP - 1) / GROUP;
    const uint near = (1u << reach) - 1; /* the lowest `reach` voxels of the next group */
    const uint far = near << (GROUP - reach); /* the highest ones of the last one */
    uint before_in = 0, before_out = 0, own = inside_bits(line, min(GROUP, ni), level);
    uint some_bits = 0, all_bits = 0;
    for (int g = 0; g < groups; ++g) {
        const int first = GROUP * g, count = min(GROUP, ni - first), next_count = clamp(ni - first - GROUP, 0, GROUP);
        const uint next = inside_bits(line + first + count, next_count, level);
        const uint here = (1u << count) - 1, there = (1u << next_count) - 1;
        const uint is_in = before_in | own | (next & near);
        const uint is_out = before_out | (here & ~own) | (there & ~next & near);
        some_bits |= (uint)(is_in != 0) << (g % 32);
        all_bits |= (uint)(is_out == 0) << (g % 32);
        if (g % 32 == 31 || g == groups - 1) {
            some[(size_t)row * words + g / 32] = some_bits;
            every[(size_t)row * words + g / 32] = all_bits;
            some_bits = all_bits = 0;
        }
        before_in = own & far;
        before_out = here & ~own & far;
        own = next;
    }
}

/* Parameters  some, every   in   (slices, nj, words)
 *             some_near, all_near   out  the same of the rows within reach
 *             count       words;  words a row;  nj rows a slice
 *             reach       rows
 * Launch      global = count rounded up by the host, any local
 * Guarantees  every word is written */
__kernel void spread_groups(
    __global const uint *restrict some, __global const uint *restrict every, __global uint *restrict some_near,
    __global uint *restrict all_near, const uint count, const int words, const int nj, const int reach)
{
    const uint word = get_global_id(0);
    if (word >= count)
        return;
    const int j = word / words % nj;
    const uint first = word - (uint)(min(reach, j) * words);
    const int near_rows = min(reach, j) + 1 + min(reach, nj - 1 - j);
    uint some_bits = 0, all_bits = ~0u;
    for (int n = 0; n < near_rows; ++n) {
        some_bits |= some[first + (uint)(n * words)];
        all_bits &= every[first + (uint)(n * words)];
    }
    some_near[word] = some_bits;
    all_near[word] = all_bits;
}

/* Parameters  some_near, all_near   in   (slices, slice_words)
 *             mask         out  (core slices, slice_words) bit set where the box of the group is mixed
 *             count        words of the mask
 *             slice_words  words a slice
 *             slices       that are there;  core_first  the first of them that the mask has
 *             reach        slices
 * Launch      global = count rounded up by the host, any local
 * Guarantees  every word is written; bits beyond the row are 0 */
__kernel void mark_mixed_groups(
    __global const uint *restrict some_near, __global const uint *restrict all_near, __global uint *restrict mask,
    const uint count, const uint slice_words, const int slices, const int core_first, const int reach)
{
    const uint word = get_global_id(0);
    if (word >= count)
        return;
    const int k = core_first + (int)(word / slice_words);
    const uint in_slice = word % slice_words;
    uint some_bits = 0, all_bits = ~0u;
    for (int near_k = max(0, k - reach); near_k <= min(slices - 1, k + reach); ++near_k) {
        const size_t at = (size_t)near_k * slice_words + in_slice;
        some_bits |= some_near[at];
        all_bits &= all_near[at];
    }
    mask[word] = some_bits & ~all_bits;
}
