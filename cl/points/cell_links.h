/* Cells of a grid whose points are all neighbours of each other, and their links: which points and cells are neighbours.
 *
 * The cells around one, with an edge of at most eps / sqrt(3): neighbours lie up to two cells away along each axis.  A
 * row along x is one window of the mask, so 25 windows hold all candidates; 13 of them hold each pair of cells once.
 *
 *    22  18  11  17  21   rows (y, z) around the own one, 0, in the order in which they are looked at: nearest
 *    14   6   2   5  13   first, since most points are core points after two or three rows
 *    10   3   0   1   9
 *    16   8   4   7  15   z
 *    24  20  12  19  23   |_ y */
#ifndef CLRECON_POINTS_CELL_LINKS_H
#define CLRECON_POINTS_CELL_LINKS_H

#include "points/grid.h"
#include "points/pair_distance.h"

#define NO_CELL 0xffffffffu
#define SEVERAL_ROOTS 0xfffffffeu

#define REACH 2 /* cells */
#define ROWS 25
#define FORWARD_ROWS 13 /* the own row among them, of which only the cells after the own one count */
#define NEAR_ROWS 3
#define BOXED 8 /* points in each of two cells from which on their box is looked at first */

__constant char row_y[ROWS] = {
    0, 1, 0, -1, 0, 1, -1, 1, -1, 2, -2, 0, 0, 2, -2, 2, -2, 1, -1, 1, -1, 2, -2, 2, -2 };
__constant char row_z[ROWS] = {
    0, 0, 1, 0, -1, 1, 1, -1, -1, 0, 0, 2, -2, 1, 1, -1, -1, 2, 2, -2, -2, 2, 2, -2, -2 };
__constant char forward_y[FORWARD_ROWS] = { 0, 1, 0, 1, -1, 2, 0, 2, -2, 1, -1, 2, -2 };
__constant char forward_z[FORWARD_ROWS] = { 0, 0, 1, 1, 1, 0, 2, 1, 1, 2, 2, 2, 2 };

/* The points and their grid; see points/grid.h. */
typedef struct {
    __global const float *x, *y, *z;
    __global const uint *starts, *mask, *ranks;
    float4 origin, bounds;
    int nx, ny, nz, words;
} point_grid;

#define GRID_PARAMETERS \
    __global const float *restrict x, __global const float *restrict y, __global const float *restrict z, \
        __global const uint *restrict starts, __global const uint *restrict mask, __global const uint *restrict ranks, \
        const float4 origin, const float4 bounds, const int nx, const int ny, const int nz, const int words, \
        const uint cells

static inline int4 cell_of(const point_grid *grid, const uint point)
{
    return grid_cell(
        grid->x[point], grid->y[point], grid->z[point], grid->origin, grid->nx, grid->ny, grid->nz);
}

static inline int is_row(const point_grid *grid, const int y, const int z)
{
    return (y >= 0) & (y < grid->ny) & (z >= 0) & (z < grid->nz);
}

/* Cells with points of the row (., y, z), which is one of the grid, from `low` to x + REACH. */
static inline uint2 window_of(const point_grid *grid, const int low, const int x, const int y, const int z)
{
    const uint row = grid_row(y, z, grid->ny, grid->words);
    return grid_window(grid->mask, grid->ranks, row, low, min(x + REACH, grid->nx - 1));
}

/* Whether a row is too far from a point for neighbours; t: place of the point in its cell, 0 to 1 along y and z. */
static inline int is_too_far(const float2 t, const int dy, const int dz, const float reach_squared)
{
    const float gap_y = dy > 0 ? (float)dy - t.x : dy < 0 ? t.x - (float)(dy + 1) : 0.0f;
    const float gap_z = dz > 0 ? (float)dz - t.y : dz < 0 ? t.y - (float)(dz + 1) : 0.0f;
    return gap_y * gap_y + gap_z * gap_z > reach_squared;
}

static inline float2 place_in_cell(const point_grid *grid, const float3 point, const int4 cell)
{
    return (float2)((point.y - grid->origin.y) * grid->origin.w - (float)cell.y,
        (point.z - grid->origin.z) * grid->origin.w - (float)cell.z);
}

/* Neighbours of a point among points begin to end; counted until there are `enough`. */
static inline uint count_near(
    const point_grid *grid, const float3 point, const uint begin, const uint end, const uint enough)
{
    uint count = 0;
    for (uint at = begin; at < end && count < enough; at += LANES) {
        const ints near
            = are_near(point, load_lanes(grid->x + at), load_lanes(grid->y + at), load_lanes(grid->z + at), grid->bounds);
        count += count_lanes(near & lanes_before(at, end));
    }
    return count;
}

/* Whether a point has a neighbour among the core points from begin to end. */
static inline int has_near_core(
    const point_grid *grid, __global const float *core_x, const float3 point, const uint begin, const uint end)
{
    for (uint at = begin; at < end; at += LANES) {
        const ints near
            = are_near(point, load_lanes(core_x + at), load_lanes(grid->y + at), load_lanes(grid->z + at), grid->bounds);
        if (ANY_LANE(near & lanes_before(at, end)))
            return 1;
    }
    return 0;
}

/* Whether a core point of cell a and one of cell b are neighbours. */
static inline int are_linked(const point_grid *grid, __global const float *core_x, const uint a, const uint b)
{
    const uint begin = grid->starts[a], end = grid->starts[a + 1];
    const uint others = grid->starts[b], others_end = grid->starts[b + 1];
    const int boxed = end - begin >= BOXED && others_end - others >= BOXED;
    float3 low = (float3)(MAXFLOAT), high = -low;
    if (boxed) {
        for (uint at = others; at < others_end; ++at) {
            if (isnan(core_x[at]))
                continue;
            const float3 point = (float3)(core_x[at], grid->y[at], grid->z[at]);
            low = point < low ? point : low;
            high = point > high ? point : high;
        }
    }
    for (uint at = begin; at < end; ++at) {
        if (isnan(core_x[at]))
            continue;
        const float3 point = (float3)(core_x[at], grid->y[at], grid->z[at]);
        if (boxed) {
            const float3 gap = fmax(fmax(low - point, point - high), (float3)(0.0f));
            if (gap.x * gap.x + gap.y * gap.y + gap.z * gap.z > grid->bounds.y)
                continue;
        }
        if (has_near_core(grid, core_x, point, others, others_end))
            return 1;
    }
    return 0;
}

#endif
