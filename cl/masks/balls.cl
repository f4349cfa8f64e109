/* Dilation and erosion of a bit mask by a ball in mm, or by any other stencil, a piece of a row at a time.
 *
 * References: our own; that balls are rows of voxels, and wider rows hold the narrower ones, is old (van Herk 1992 and
 * others decompose structuring elements so).
 *
 * A ball is a list of rows (dj, dk, centre, half), the widest first: the voxels from centre - half to centre + half of
 * the row.  `tables` says which part of the list is that of slice k.  What is gathered from the widest rows is widened by
 * a voxel on both sides whenever the next row is narrower by one, so that each row is read once and its bits go as far as
 * its half:
 *
 *      rows of half 2   ....#.......      read
 *      widened          ...###......
 *      rows of half 1   ...###..#...      read and joined
 *      widened          ..#####.###.      one by 2 voxels, the other by 1
 *      rows of half 0   joined, and done
 *
 * Erosion is the same of the complement, and the complement of that (`flip`).  What lies beyond the volume is not set, or
 * set, as `beyond` says of the bits that are spread.  Most rows of a mask are empty: what an empty row erodes to, and what
 * empty rows alone dilate to, is known from the extents of the rows. */
#include "masks/row_pieces.h"

/* True if no row that the ball of row (j, k) may look at has a bit set: extents of rows without any are 0. */
static inline int is_empty_near(
    __global const uint *row_extents, const int j, const int k, const int reach_j, const int reach_k, const int nj,
    const int nk)
{
    const int first = max(j - reach_j, 0), end = min(j + reach_j, nj - 1) + 1, last_k = min(k + reach_k, nk - 1);
    uint any_bits = 0;
    for (int near_k = max(k - reach_k, 0); near_k <= last_k; ++near_k) {
        __global const uint *extents = row_extents + (size_t)near_k * nj;
        for (int near_j = first; near_j < end; ++near_j)
            any_bits |= extents[near_j];
        if (any_bits != 0)
            return 0;
    }
    return 1;
}

/* Parameters  mask     in   (nk, nj, words)
 *             row_extents  in   (nk, nj) of the mask: 0 for rows without a bit set
 *             stencil  in   (m) rows of balls: dj, dk, centre, half
 *             tables   in   (nk) begin and end of the ball of each slice
 *             spread   out  (nk, nj, words)
 *             reach_j, reach_k   largest |dj| and |dk| of the balls
 *             ni, nj, nk   voxels;  words a row
 *             pieces   of a row, `piece` words each, and `halo` words before and behind them
 *             shifted  0: all centres are 0; else 1, and there is a halo: bits that are shifted out of the row count there
 *             flip     ~0: the complement is spread, and the complement of that written; else 0
 *             beyond   ~0: what is spread lies everywhere beyond the volume; else 0
 * Launch      global = nk nj pieces rounded up by the host, any local
 * Assumes     piece + 2 halo <= PIECE_WORDS; without a halo piece >= words, with one of a word halves <= 32;
 *             nk nj words < 2^31
 * Guarantees  every word is written; bits beyond the rows are 0 */
__kernel void spread_ball(
    __global const uint *restrict mask, __global const uint *restrict row_extents,
    __global const int4 *restrict stencil, __global const int2 *restrict tables,
    __global uint *restrict spread, const int reach_j, const int reach_k, const int ni, const int nj, const int nk,
    const int words, const int pieces,
    const int piece, const int halo, const int shifted, const uint flip, const uint beyond)
{
    const uint item = get_global_id(0);
    const int row = (int)(item / pieces), total = nj * nk * words;
    if (row >= nj * nk)
        return;
    const int first = (int)(item % pieces) * piece - halo;
    const int j = row % nj, k = row / nj;
    __global uint *to = spread + row * words;
    const int begin = first + halo, end = min(begin + piece, words);
    if (flip ? row_extents[row] == 0
             : beyond == 0 && is_empty_near(row_extents, j, k, reach_j, reach_k, nj, nk)) {
        for (int w = begin; w < end; ++w)
            to[w] = 0;
        return;
    }
    const int2 table = tables[k];
    const row_piece own = bits_of_piece(first, ni);
    row_piece met = {(words_of_piece)(0u)};
    int half_width = stencil[table.x].w;
    for (int which = table.x; which < table.y; ++which) {
        const int near_j = j + stencil[which].x, near_k = k + stencil[which].y;
        const int centre = stencil[which].z, near_width = stencil[which].w;
        for (; half_width > near_width; --half_width)
            met = widen(shifted ? met : within_row(met, own, beyond), beyond);
        if (near_j < 0 || near_j >= nj || near_k < 0 || near_k >= nk) {
            join_word(&met, beyond);
            continue;
        }
        const int at = (near_k * nj + near_j) * words + first;
        if (shifted)
            join_shifted(&met, mask, at, first, centre, ni, total, flip, beyond);
        else
            join_piece(&met, mask, at, total, flip);
    }
    for (; half_width > 0; --half_width)
        met = widen(shifted ? met : within_row(met, own, beyond), beyond);
    store_piece(met, own, to, first, begin, end, flip);
}
