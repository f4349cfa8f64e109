/* Samples inside of labels: the label map tells to which label a sample belongs, HU tell whether it is dense.
 *
 * The rules are our own; clrecon/proof/surface/labels.py states them.
 *
 * Passes
 *   1. own_samples      for each sample the label that it is inside of, or 0
 *      (for solid labels, the host fills their cavities before the next pass)
 *   2. classify_label   for each label one bit per sample, packed as in cl/masks/classify.cl */
#include "include/label_owner.h"
#include "include/volume.h"

/* Parameters  voxels        in   (nk, nj, ni)
 *             labels        in   (nk, nj, ni) label of each sample, 0 is none
 *             near          in   (offsets,) int4: steps along i, j, k and the number of the shell, nearest first;
 *                                offsets of one shell are equally long
 *             inside        out  (nk, nj, ni)
 *             level         lowest value that is dense
 *             ni nj nk, offsets
 * Launch      global = nk * nj * ni rounded up by the host, any local
 * Guarantees  every sample is written: 0 where it is not dense; its label; else the label of the nearest sample that has
 *             one, the lowest of equally near ones; 0 where there is none */
__kernel void own_samples(
    __global const VOXEL *restrict voxels, __global const LABEL *restrict labels, __global const int4 *restrict near,
    __global LABEL *restrict inside, const VOXEL level, const int ni, const int nj, const int nk, const int offsets)
{
    const size_t at = get_global_id(0);
    const size_t row_length = ni, plane = row_length * (size_t)nj;
    if (at >= plane * (size_t)nk)
        return;
    if (!(voxels[at] >= level)) {
        inside[at] = 0;
        return;
    }
    const int k = (int)(at / plane), j = (int)(at % plane / row_length), i = (int)(at % row_length);
    inside[at] = (LABEL)find_owner(labels, near, offsets, i, j, k, ni, nj, nk);
}

/* Parameters  inside      in   slices of (nk, nj, ni) from first_slice on: the label that each sample is inside of
 *             mask        out  (gk, gj, words) bit set where it is `label`
 *             row_extents out  (gk, gj) first word of the row with a bit set, and the one after the last; 0, 0 in rows
 *                              without any
 *             half_way_count  out  0, for emit_vertices to count in
 *             label       number of the label
 *             ni nj nk, border    of the whole volume
 *             first_slice         slice of the volume that `inside` begins with
 *             first_sample_slice  slice of the sample grid that the mask begins with
 *             gk                  slices of the mask
 *             words               words a row, ceil((ni + 2 border) / 32)
 * Launch      global = gk * gj rounded up by the host, any local: one item a row, as classify_samples
 * Assumes     the slices of the mask that lie in the volume are among those of `inside`
 * Guarantees  every word of the mask and every extent is written; bits beyond the row are 0 */
__kernel void classify_label(
    __global const LABEL *restrict inside, __global uint *restrict mask, __global ushort2 *restrict row_extents,
    __global uint *restrict half_way_count, const uint label,
    const int ni, const int nj, const int nk, const int border, const int first_slice, const int first_sample_slice,
    const uint gk, const int words)
{
    const uint gj = nj + 2 * border;
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    if (row == 0)
        *half_way_count = 0;
    __global uint *row_mask = mask + (size_t)row * words;
    const int j = (int)(row % gj) - border, k = (int)(row / gj) + first_sample_slice - border;
    const int in_volume = j >= 0 && j < nj && k >= 0 && k < nk;
    __global const LABEL *samples = inside + (in_volume ? voxel_index(0, j, k - first_slice, ni, nj) : 0);
    int begin = words, end = 0;
    for (int w = 0; w < words; ++w) {
        const int first = 32 * w - border;
        uint bits = 0;
        for (int b = max(0, -first); in_volume && b < min(32, ni - first); ++b)
            bits |= (uint)(samples[first + b] == label) << b;
        row_mask[w] = bits;
        begin = min(begin, bits != 0 ? w : words);
        end = bits != 0 ? w + 1 : end;
    }
    row_extents[row] = (ushort2)((ushort)min(begin, end), (ushort)end);
}
