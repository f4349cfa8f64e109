/* How many voxels of a bit mask neighbouring slices have in common: what tells a foreign slice from its neighbours.
 *
 * A row (j, k) of the mask is `words` words of 32 voxels.
 *
 *      slice k       ..####....##..      6 voxels
 *      slice k + 1   ...####...##..      6 voxels      5 of them in both:      Dice 2 * 5 / (6 + 6) = 0.83
 *      slice k + 2   ....####...#..      5 voxels      3 in the first as well: Dice 2 * 3 / (6 + 5) = 0.55
 *
 * Reference: Dice 1945, "Measures of the amount of ecologic association between species". */

/* Parameters  mask     in   (nk, nj, words)
 *             counts   out  (3, nk nj) voxels of a row; those that the same row of the next slice has too; those that
 *                           the row of the slice after the next has; 0 where there is no such slice
 *             nj, nk   rows a slice, and slices;  words a row
 * Launch      global = nk nj rounded up by the host, any local
 * Guarantees  every count is written */
__kernel void count_overlaps(
    __global const uint *restrict mask, __global uint *restrict counts, const uint nj, const uint nk, const uint words)
{
    const uint row = get_global_id(0), rows = nj * nk;
    if (row >= rows)
        return;
    const size_t at = (size_t)row * words, slice = (size_t)nj * words;
    const int has_next = row + nj < rows, has_second = row + 2 * nj < rows;
    uint own = 0, next = 0, second = 0;
    for (uint w = 0; w < words; ++w) {
        const uint bits = mask[at + w];
        own += popcount(bits);
        if (has_next && bits != 0)
            next += popcount(bits & mask[at + slice + w]);
        if (has_second && bits != 0)
            second += popcount(bits & mask[at + 2 * slice + w]);
    }
    counts[row] = own;
    counts[rows + row] = next;
    counts[2 * rows + row] = second;
}
