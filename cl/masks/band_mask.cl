/* The bit mask of a list of voxels; that of a band of HU comes from cl/masks/classify.cl.
 *
 * A row (j, k) is `words` words of 32 voxels, of which the last may be zeros alone: bit b of word w is voxel
 * i = 32 w + b.
 *
 * Passes
 *   1. clear_words
 *   2. set_bits, or of voxels by number set_numbered_bits: items may write the same word: atomic_or(), whose order does
 *      not matter
 *   3. find_extents   the part of each row that has bits */

/* Parameters  mask   out  (n,) zeros
 *             n      words
 * Launch      global = n rounded up by the host, any local
 * Guarantees  every word is written */
__kernel void clear_words(__global uint *restrict mask, const uint n)
{
    const uint word = get_global_id(0);
    if (word < n)
        mask[word] = 0;
}

/* Parameters  ijk    in      (n, 3) voxels of the volume
 *             mask   in/out  (nk nj words) the bits of these voxels are set
 *             n      voxels;  nj rows a slice;  words  words a row
 * Launch      global = n rounded up by the host, any local
 * Guarantees  the same mask in any order: bits are only set */
__kernel void set_bits(
    __global const int *restrict ijk, __global uint *mask, const uint n, const int nj, const int words)
{
    const uint point = get_global_id(0);
    if (point >= n)
        return;
    const int3 voxel = vload3(point, ijk);
    atomic_or(mask + (voxel.z * nj + voxel.y) * words + (voxel.x >> 5), 1u << (voxel.x & 31));
}

/* Parameters  numbers  in      (n,) voxels as i + ni (j + nj k)
 *             mask     in/out  (nk nj words) the bits of these voxels are set
 *             n        voxels;  ni  voxels a row;  words  words a row
 * Launch      global = n rounded up by the host, any local
 * Guarantees  the same mask in any order: bits are only set */
__kernel void set_numbered_bits(
    __global const uint *restrict numbers, __global uint *mask, const uint n, const uint ni, const int words)
{
    const uint point = get_global_id(0);
    if (point >= n)
        return;
    const uint number = numbers[point], row = number / ni, i = number - row * ni;
    atomic_or(mask + (size_t)row * words + (i >> 5), 1u << (i & 31));
}

/* Parameters  mask         in   (rows, words)
 *             row_extents  out  (rows) first word of the row with a bit set, and the one after the last; 0, 0 without
 *             rows, words
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every extent is written */
__kernel void find_extents(
    __global const uint *restrict mask, __global ushort2 *restrict row_extents, const uint rows, const int words)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    __global const uint *own = mask + (size_t)row * words;
    int begin = words, end = 0;
    for (int w = 0; w < words; ++w) {
        begin = min(begin, own[w] != 0 ? w : words);
        end = own[w] != 0 ? w + 1 : end;
    }
    row_extents[row] = (ushort2)((ushort)min(begin, end), (ushort)end);
}
