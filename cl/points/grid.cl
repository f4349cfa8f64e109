/* A grid over free points: which of its cells have points, and the points sorted by cell.  See points/grid.h.
 *
 * Reference: Teschner et al. 2003, "Optimized spatial hashing for collision detection of deformable objects", for the
 * idea; here cells are numbered without collisions, by a bit mask and the number of bits before each word.
 *
 * Passes
 *   1. clear_cells, mark_cells    the bit of each cell with points
 *   2. count_marked               bits of each word (then the exclusive scan of scan.cl: ranks)
 *   3. number_points              number of the cell of each point, its key (then the sort of radix_sort.cl)
 *   4. gather_points              coordinates in the sorted order, and the first point of each cell
 *
 * Races.  mark_cells sets bits by atomic_or(), and the outcome does not depend on the order.  In all other passes each
 * item writes words of its own; the start of a cell is written by the item of its first point. */
#include "points/grid.h"

#ifndef LANES
#define LANES 1
#endif

/* Neighbouring points of an item of mark_cells on a CPU: those of one word of the mask need one atomic. */
#define MARKED_TOGETHER 16
#if LANES == 8
#define MARKED_BY_ITEM MARKED_TOGETHER
#else
#define MARKED_BY_ITEM 1
#endif

/* Parameters  mask   out  (total,) zeros
 *             total  words
 * Launch      global = total rounded up by the host, any local */
__kernel void clear_cells(__global uint *restrict mask, const uint total)
{
    const uint word = get_global_id(0);
    if (word < total)
        mask[word] = 0;
}

/* Parameters  points  in      (n, 3) mm relative to the grid's base
 *             mask    in/out  (nz, ny, words), cleared; then the bits of cells with points
 *             origin  corner of cell (0, 0, 0) relative to the base, 1 / edge
 *             n       points;  nx ny nz: cells;  words: of a row
 * Launch      global = n / MARKED_BY_ITEM rounded up by the host, any local
 * Assumes     no point lies before the origin */
__kernel void mark_cells(
    __global const float *restrict points, __global uint *mask, const float4 origin, const uint n, const int nx,
    const int ny, const int nz, const int words)
{
    const uint first = (uint)get_global_id(0) * MARKED_BY_ITEM;
    if (first >= n)
        return;
    const uint end = first + min((uint)MARKED_BY_ITEM, n - first);
    uint word = 0xffffffffu, bits = 0;
    for (uint point = first; point < end; ++point) {
        const float3 place = vload3(point, points);
        const int4 cell = grid_cell(place.x, place.y, place.z, origin, nx, ny, nz);
        const uint own = grid_row(cell.y, cell.z, ny, words) + ((uint)cell.x >> 5);
        if (own != word && bits != 0) {
            atomic_or(mask + word, bits);
            bits = 0;
        }
        word = own;
        bits |= 1u << (cell.x & 31);
    }
    atomic_or(mask + word, bits);
}

/* Parameters  mask    in   (total,)
 *             counts  out  (total,) set bits of each word
 *             total   words
 * Launch      as clear_cells */
__kernel void count_marked(__global const uint *restrict mask, __global uint *restrict counts, const uint total)
{
    const uint word = get_global_id(0);
    if (word < total)
        counts[word] = popcount(mask[word]);
}

/* Parameters  points  in   (n, 3)
 *             mask    in   (nz, ny, words)
 *             ranks   in   (nz, ny, words) exclusive scan of the bits
 *             keys    out  (n,) number of the cell of each point
 *             origin n nx ny nz words    as in mark_cells
 * Launch      global = n rounded up by the host, any local */
__kernel void number_points(
    __global const float *restrict points, __global const uint *restrict mask, __global const uint *restrict ranks,
    __global uint *restrict keys, const float4 origin, const uint n, const int nx, const int ny, const int nz,
    const int words)
{
    const uint point = get_global_id(0);
    if (point >= n)
        return;
    const float3 place = vload3(point, points);
    const int4 cell = grid_cell(place.x, place.y, place.z, origin, nx, ny, nz);
    keys[point] = grid_cells_before(mask, ranks, grid_row(cell.y, cell.z, ny, words), cell.x);
}

/* Parameters  points  in   (n, 3)
 *             keys    in   (n,) ascending numbers of cells; each from 0 to cells - 1 is there
 *             order   in   (n,) number of the point at each place of the sorted order
 *             x y z   out  (n,) coordinates in the sorted order
 *             starts  out  (cells + 1,) first sorted point of each cell, then n
 *             n       points;  cells: with points
 * Launch      as number_points
 * Guarantees  every start is written */
__kernel void gather_points(
    __global const float *restrict points, __global const uint *restrict keys, __global const uint *restrict order,
    __global float *restrict x, __global float *restrict y, __global float *restrict z, __global uint *restrict starts,
    const uint n, const uint cells)
{
    const uint place = get_global_id(0);
    if (place >= n)
        return;
    const float3 point = vload3(order[place], points);
    x[place] = point.x;
    y[place] = point.y;
    z[place] = point.z;
    const uint cell = keys[place];
    if (place == 0 || keys[place - 1] != cell)
        starts[cell] = place;
    if (place == n - 1)
        starts[cells] = n;
}
