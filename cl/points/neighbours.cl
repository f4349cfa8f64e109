/* The k nearest points of every point, exactly, by a grid of cells.
 *
 * The points within 27 cells around a cell are enough for nearly every point of it, if cells are as large as the host
 * makes them (clrecon/operators/points/neighbours.py): about 90 candidates for 16 neighbours.  Where the kth is farther
 * away than the faces of that block, the block grows.  Neighbours are ordered by a key of 64 bits,
 *
 *      bits of the distance, float32 | number of the point in the cloud
 *
 * of which no two are equal, so that every device and every order of work has the same result.  On CPUs (LANES 8) a
 * work-item takes 16 cells, and copies the candidates of a cell once for all points of it (points/nearest_listed.h).
 * On GPUs (LANES 1) a work-item takes one point and finds the next four neighbours in each pass over the candidates
 * (points/nearest_passes.h): there is no array with an index that is known only at run time.
 *
 * Reference: J. L. Bentley, D. F. Stanat, E. H. Williams, "The complexity of finding fixed-radius near neighbors",
 * 1977, for the cells; the grid is that of clrecon/operators/points/grid.py.
 *
 * Passes
 *   1. list_neighbours    once for each part of the cells */

#include "include/lanes.h"
#include "points/near_cells.h"

#define BATCH_CELLS 16

/* What a launch works on: cells, and the points in them. */
typedef struct {
    uint first_cell, cell_count, first_place, place_count;
} launch_part;

#if LANES == 8
#include "points/nearest_listed.h"

/* Write the first k sorted candidates as row `row` of the results. */
static inline void write_sorted(
    const candidates *c, const size_t row, const int k, const int by_place, __global int *restrict neighbours,
    __global float *restrict distances)
{
    __global int *own = neighbours + row * (size_t)k;
    if (by_place) {
        for (int t = 0; t < k; ++t)
            own[t] = c->sorted_place[t];
        return;
    }
    __global float *own_distances = distances + row * (size_t)k;
    for (int t = 0; t < k; ++t) {
        own[t] = (int)c->sorted[t];
        own_distances[t] = distance_of(c->sorted[t]);
    }
}

/* Find the neighbours of the points of one cell. */
static inline void list_cell(
    candidates *c, const cloud_grid *g, const uint number, const int3 cell, const int k, const float3 origin,
    const float edge, const float margin, float *bound, const int by_place, const uint first_place,
    __global int *restrict neighbours, __global float *restrict distances)
{
    const uint end = g->starts[number + 1];
    int is_copied = 0, has_room = 1;
    for (uint place = g->starts[number]; place < end; ++place) {
        const float3 point = (float3)(g->x[place], g->y[place], g->z[place]);
        float farthest = INFINITY;
        if (!is_copied && has_room)
            is_copied = has_room = copy_block(c, g, cell);
        if (has_room) {
            find_squares(c, point);
            farthest = sort_nearest(c, k, edge, bound);
        }
        if (!(farthest < reach_of_block(g, point, cell, 1, origin, edge, margin))) {
            sort_far(c, g, point, cell, k, origin, edge, margin, farthest);
            is_copied = 0;
        }
        write_sorted(c, by_place ? place - first_place : g->order[place], k, by_place, neighbours, distances);
    }
}

/* Find the neighbours of the points of BATCH_CELLS cells. */
static inline void list_item(
    const cloud_grid *g, const size_t item, const int k, const float4 origin, const float margin, const int by_place,
    const launch_part part, __global int *neighbours, __global float *distances)
{
    if (item >= (part.cell_count + BATCH_CELLS - 1) / BATCH_CELLS)
        return;
    candidates c;
    const uint first = part.first_cell + (uint)item * BATCH_CELLS;
    const uint end = min(first + BATCH_CELLS, part.first_cell + part.cell_count);
    uint word = word_of_cell(g, first);
    uint bits = g->mask[word];
    for (uint before = g->ranks[word]; before < first; ++before)
        bits &= bits - 1u;
    float bound = origin.w * origin.w;
    for (uint number = first; number < end; ++number) {
        while (bits == 0u)
            bits = g->mask[++word];
        const int3 cell = place_of_bit(g, word, popcount((bits & -bits) - 1u));
        bits &= bits - 1u;
        list_cell(
            &c, g, number, cell, k, origin.xyz, origin.w, margin, &bound, by_place, part.first_place, neighbours,
            distances);
    }
}
#else
#include "points/nearest_passes.h"

/* Find the neighbours of one point. */
static inline void list_item(
    const cloud_grid *g, const size_t item, const int k, const float4 origin, const float margin, const int by_place,
    const launch_part part, __global int *neighbours, __global float *distances)
{
    if (item < part.place_count)
        list_point(
            g, part.first_place + (uint)item, k, origin.xyz, origin.w, margin, by_place, part.first_place, neighbours,
            distances);
}
#endif

/* Parameters  mask      in   (nz, ny, words) occupied cells, a bit each
 *             ranks     in   (nz, ny, words) number of occupied cells before each word
 *             starts    in   (cells + 1) first point of each occupied cell
 *             order     in   (points) number of each point in the cloud
 *             x y z     in   (points) mm, sorted by cell
 *             neighbours out (points, k) by_place: places of the neighbours among the sorted points, the row of point
 *                            p is p - first_place; else their numbers in the cloud, the row is the point's number
 *             distances out  (points, k) mm; by_place: not written
 *             nx ny nz, words, cells, points
 *             origin    mm: corner of cell (0, 0, 0); w is the edge of a cell
 *             margin    mm: more than the rounding of a place's cell
 *             k         1 to MOST_NEIGHBOURS, at most points
 *             first_cell, cell_count, first_place, place_count   of this launch: cells, and the points in them
 * Launch      global = place_count with LANES 1, else ceil(cell_count / BATCH_CELLS), rounded up by the host, any local
 * Assumes     coordinates are finite
 * Guarantees  rows are ascending by (distance, number); the same bits on every device */
__kernel void list_neighbours(
    __global const uint *restrict mask, __global const uint *restrict ranks, __global const uint *restrict starts,
    __global const uint *restrict order, __global const float *restrict x, __global const float *restrict y,
    __global const float *restrict z, __global int *restrict neighbours, __global float *restrict distances,
    const int nx, const int ny, const int nz, const uint words, const uint cells, const uint points,
    const float4 origin, const float margin, const int k, const int by_place, const uint first_cell,
    const uint cell_count, const uint first_place, const uint place_count)
{
    const cloud_grid g = {mask, ranks, starts, order, x, y, z, nx, ny, nz, words, cells, points};
    const launch_part part = {first_cell, cell_count, first_place, place_count};
    list_item(&g, get_global_id(0), k, origin, margin, by_place, part, neighbours, distances);
}
