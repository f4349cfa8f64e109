/* Occupied cells around a point of the grid of points/grid.h: which points they hold, and how far they reach. */
#ifndef CLRECON_NEAR_CELLS_H
#define CLRECON_NEAR_CELLS_H

#include "points/grid.h"

typedef struct {
    __global const uint *mask;
    __global const uint *ranks;
    __global const uint *starts;
    __global const uint *order;
    __global const float *x;
    __global const float *y;
    __global const float *z;
    int nx, ny, nz;
    uint words;
    uint cells;
    uint points;
} cloud_grid;

/* First and one beyond the last point of the cells from to end - 1 of a row. */
static inline uint2 points_of_window(const cloud_grid *g, const uint row, const int from, const int end)
{
    const uint2 cells = grid_window(g->mask, g->ranks, row * g->words, from, end - 1);
    return (uint2)(g->starts[cells.x], g->starts[cells.y]);
}

/* True where the rows from to end - 1 hold no point at all. */
static inline int rows_are_empty(const cloud_grid *g, const uint from, const uint end)
{
    const uint beyond = end * g->words - 1u;
    return g->ranks[from * g->words] == g->ranks[beyond] && g->mask[beyond] == 0u;
}

/* Word of an occupied cell: the last one with no more cells before it. */
static inline uint word_of_cell(const cloud_grid *g, const uint cell)
{
    uint low = 0, high = (uint)g->nz * (uint)g->ny * g->words;
    while (high - low > 1u) {
        const uint middle = low + (high - low) / 2u;
        if (g->ranks[middle] <= cell)
            low = middle;
        else
            high = middle;
    }
    return low;
}

/* Occupied cell of a point: the last one that begins no later. */
static inline uint cell_of_place(__global const uint *starts, const uint cells, const uint place)
{
    uint low = 0, high = cells;
    while (high - low > 1u) {
        const uint middle = low + (high - low) / 2u;
        if (starts[middle] <= place)
            low = middle;
        else
            high = middle;
    }
    return low;
}

/* Indices of the cell at bit `bit` of a word. */
static inline int3 place_of_bit(const cloud_grid *g, const uint word, const uint bit)
{
    const uint row = word / g->words;
    return (int3)((int)(32u * (word - row * g->words) + bit), (int)(row % (uint)g->ny), (int)(row / (uint)g->ny));
}

/* The n-th set bit of a word, from 0. */
static inline uint nth_bit(uint bits, uint n)
{
    for (; n > 0u; --n)
        bits &= bits - 1u;
    return popcount((bits & -bits) - 1u);
}

/* Distance in mm within which all points lie in the cells at most r steps away; `margin` is the rounding of places. */
static inline float reach_of_block(
    const cloud_grid *g, const float3 point, const int3 cell, const int r, const float3 origin, const float edge,
    const float margin)
{
    const int3 low = cell - r, high = cell + r + 1;
    const float3 below = point - (origin + convert_float3(low) * edge);
    const float3 above = origin + convert_float3(high) * edge - point;
    float reach = INFINITY;
    reach = low.x > 0 ? min(reach, below.x) : reach;
    reach = low.y > 0 ? min(reach, below.y) : reach;
    reach = low.z > 0 ? min(reach, below.z) : reach;
    reach = high.x < g->nx ? min(reach, above.x) : reach;
    reach = high.y < g->ny ? min(reach, above.y) : reach;
    reach = high.z < g->nz ? min(reach, above.z) : reach;
    return reach - margin;
}

/* Square of the distance of a point from the row (y, z) of cells, less than or equal to that of any point in it. */
static inline float far_from_row(
    const float3 point, const int y, const int z, const float3 origin, const float edge, const float margin)
{
    const float low_y = origin.y + (float)y * edge, low_z = origin.z + (float)z * edge;
    const float dy = max(max(low_y - point.y, point.y - (low_y + edge)) - margin, 0.0f);
    const float dz = max(max(low_z - point.z, point.z - (low_z + edge)) - margin, 0.0f);
    return dy * dy + dz * dz;
}

#endif
