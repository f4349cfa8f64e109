/* The grid over free points, as the kernels of other files read it: cubic cells, a bit for each, points sorted by cell.
 *
 *      a row of cells          . 2 .  1 3 . . 1        points in each cell of a row (fixed y, z); a word has 32 cells
 *      mask                    0 1 0  1 1 0 0 1        bit x & 31 of word x >> 5 of the row: the cell has points
 *      ranks                   7                       for each word: cells with points before it, in the whole grid
 *      number of a cell          7    8 9     10       ranks[word] + popcount(bits below): cells with points, in order
 *      starts                 30 32 33 36 37           first sorted point of each numbered cell, then the end
 *
 * Cells x - r to x + r of a row are one window of the mask, hence one range of numbers, hence one range of points:
 *
 *      const uint row = grid_row(y, z, ny, words);
 *      const uint2 cells = grid_window(mask, ranks, row, max(x - r, 0), min(x + r, nx - 1));
 *      for (uint point = starts[cells.x]; point < starts[cells.y]; ++point)
 *
 * (for cells.x == cells.y the loop is empty).  Rounding: a point may lie outside of its cell by GRID_ROUNDING times its
 * distance from the grid's origin.  Pointers of these functions are not `restrict`: Oclgrind 21.10 does not know what the
 * compiler makes of that. */
#ifndef CLRECON_POINTS_GRID_H
#define CLRECON_POINTS_GRID_H

#define GRID_ROUNDING 0.0000002f /* more than three roundings of float32 */

/* Cell of a point.  `origin` has the corner of cell (0, 0, 0) and in w 1 / edge. */
static inline int4 grid_cell(
    const float x, const float y, const float z, const float4 origin, const int nx, const int ny, const int nz)
{
    return (int4)(
        min((int)((x - origin.x) * origin.w), nx - 1), min((int)((y - origin.y) * origin.w), ny - 1),
        min((int)((z - origin.z) * origin.w), nz - 1), 0);
}

/* First word of the row of cells (., y, z); `words` of 32 cells make a row. */
static inline uint grid_row(const int y, const int z, const int ny, const int words)
{
    return ((uint)z * (uint)ny + (uint)y) * (uint)words;
}

/* Number of cells with points before cell x of a row. */
static inline uint grid_cells_before(
    __global const uint *mask, __global const uint *ranks, const uint row, const int x)
{
    const uint word = row + ((uint)x >> 5);
    return ranks[word] + popcount(mask[word] & ((1u << (x & 31)) - 1));
}

/* Number of cells with points up to cell x of a row, x included. */
static inline uint grid_cells_through(
    __global const uint *mask, __global const uint *ranks, const uint row, const int x)
{
    const uint word = row + ((uint)x >> 5);
    return ranks[word] + popcount(mask[word] & (0xffffffffu >> (31 - (x & 31))));
}

/* Numbers of the cells with points among cells `low` to `high` of a row, both inside of it: the first, and the one after
 * the last. */
static inline uint2 grid_window(
    __global const uint *mask, __global const uint *ranks, const uint row, const int low,
    const int high)
{
    return (uint2)(grid_cells_before(mask, ranks, row, low), grid_cells_through(mask, ranks, row, high));
}

#endif
