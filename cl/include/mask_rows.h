/* Rows of the inside mask, and the edges and cells that the iso surface crosses, 32 samples at a time.
 *
 * The sample grid is the volume itself (border = 0) or the volume with one layer of outside around it
 * (border = 1), of gi x gj x gk samples.  A row (j, k) is `words` 32-bit words: bit b of word w says whether
 * sample i = 32 w + b is inside.  Bits beyond the row are 0.
 *
 *      row (j, k)    word 0         word 1                 word words - 1
 *      bit           31 ....... 0   31 ....... 0     ...   31 ......... 0
 *      sample i      31 ....... 0   63 ...... 32
 *
 *      window of w   63 ............. 32   31 .............. 0
 *                    bits of word w + 1    bits of word w
 *
 * Beside the mask a row has its extent, the first word with a bit set and the one after the last; a flag word has bit
 * w % 32 of entry w / 32 set where word w has work; and the list of active words says row << row_shift | w.
 *
 * A window is a word with its successor above it, in 64 bits: tests of samples 0..32 of the word need no special case
 * at the word's end. */
#ifndef CLRECON_MASK_ROWS_H
#define CLRECON_MASK_ROWS_H

/* Bits of 16 comparison results (-1 or 0 each): bit n is lane n. */
static inline uint pack_lanes(short16 lanes)
{
    const ushort16 bits = as_ushort16(lanes)
        & (ushort16)(1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768);
    const ushort8 by8 = bits.lo | bits.hi;
    const ushort4 by4 = by8.lo | by8.hi;
    const ushort2 by2 = by4.lo | by4.hi;
    return by2.x | by2.y;
}

/* Row number of (j, k). */
static inline uint row_index(uint j, uint k, uint gj)
{
    return k * gj + j;
}

/* Word w of a row and, above it, the next one (0 at the end of the row). */
static inline ulong load_window(__global const uint *mask, uint row, uint w, uint words)
{
    const size_t at = (size_t)row * words + w;
    const ulong low = mask[at];
    const ulong high = w + 1 < words ? mask[at + 1] : 0;
    return low | high << 32;
}

/* The lowest n bits of a window. */
static inline ulong low_bits(uint n)
{
    return n < 64 ? ((ulong)1 << n) - 1 : ~(ulong)0;
}

/* Bits of the samples that have a neighbour at i + 1, in the window of word w. */
static inline ulong samples_with_next(uint w, uint gi)
{
    return low_bits(gi - 1 - min(32 * w, gi - 1));
}

/* Crossed edges owned by the samples of a window: towards i + 1, j + 1 and k + 1.  Valid for bits 0..32. */
typedef struct {
    ulong x, y, z;
} crossed_edges;

static inline void find_crossed_edges(
    crossed_edges *edges, __global const uint *mask, uint j, uint k, uint w, uint gi, uint gj, uint gk, uint words)
{
    const uint row = row_index(j, k, gj);
    const ulong own = load_window(mask, row, w, words);
    edges->x = (own ^ own >> 1) & samples_with_next(w, gi);
    edges->y = j + 1 < gj ? own ^ load_window(mask, row + 1, w, words) : 0;
    edges->z = k + 1 < gk ? own ^ load_window(mask, row + gj, w, words) : 0;
}

/* The four rows of windows around a row of cells: bit b of them are the corners of cell b at x = 0,
 * bit b + 1 those at x = 1. */
typedef struct {
    ulong y0z0, y1z0, y0z1, y1z1;
} cell_rows;

static inline void load_cell_rows(
    cell_rows *rows, __global const uint *mask, uint j, uint k, uint w, uint gj, uint words)
{
    const uint row = row_index(j, k, gj);
    rows->y0z0 = load_window(mask, row, w, words);
    rows->y1z0 = load_window(mask, row + 1, w, words);
    rows->y0z1 = load_window(mask, row + gj, w, words);
    rows->y1z1 = load_window(mask, row + gj + 1, w, words);
}

/* Cells of the word (bits 0..31) whose corners are neither all inside nor all outside. */
static inline uint find_active_cells(cell_rows rows, uint w, uint gi)
{
    const ulong any = rows.y0z0 | rows.y1z0 | rows.y0z1 | rows.y1z1;
    const ulong all = rows.y0z0 & rows.y1z0 & rows.y0z1 & rows.y1z1;
    return (uint)((any | any >> 1) & ~(all & all >> 1) & samples_with_next(w, gi));
}

/* Case of cell b: bit c is corner c, whose (x, y, z) are the bits 0, 1, 2 of c. */
static inline uint cell_case(cell_rows rows, uint b)
{
    return (uint)((rows.y0z0 >> b & 3) | (rows.y1z0 >> b & 3) << 2 | (rows.y0z1 >> b & 3) << 4
        | (rows.y1z1 >> b & 3) << 6);
}

/* Number of the lowest set bit. */
static inline uint lowest_bit(uint bits)
{
    return popcount((bits & -bits) - 1);
}

#endif
