/* Openness: the share of light from all around that reaches a place, from a grid of cells of a volume, see
 * rays/openness.cl.
 *
 * -D OPENNESS   there is a grid; without, everything is in the open */
#ifndef CLRECON_OPENNESS_H
#define CLRECON_OPENNESS_H

#include "include/lanes.h"
#include "rays/field.h"

#ifdef OPENNESS
/* A grid of (open_k, open_j, open_i) cells: place (i, j, k) of the volume lies at place * scale + shift, and value v of
 * the grid lets v * scale.w + shift.w of the light through. */
typedef struct {
    field cells;
    float4 scale, shift;
} open_grid;

#define OPENNESS_PARAMETERS \
    , __global const VOXEL *restrict openness, const int open_i, const int open_j, const int open_k, \
        const float4 open_scale, const float4 open_shift
#define OPENNESS_GRID \
    { \
        { openness, open_i, open_j, 0, open_k, \
            (float4)((float)(open_i - 1), (float)(open_j - 1), (float)(open_k - 1), 0.0f) }, \
        open_scale, open_shift \
    }

/* Light that reaches LANES places near each other, index coordinates of the volume. */
static inline floats find_openness(const open_grid *grid, const floats i, const floats j, const floats k)
{
    const floats value = sample_lanes(&grid->cells, i * grid->scale.x + grid->shift.x,
        j * grid->scale.y + grid->shift.y, k * grid->scale.z + grid->shift.z, 0);
    return value * grid->scale.w + grid->shift.w;
}

static inline float read_openness(const open_grid *grid, const float4 place)
{
    const field *cells = &grid->cells;
    const float4 at = clamp(place * grid->scale + grid->shift, (float4)(0.0f), cells->last);
    const int i = min((int)at.x, cells->ni - 2), j = min((int)at.y, cells->nj - 2), k = min((int)at.z, cells->end_k - 2);
    const float part_i = at.x - (float)i, part_j = at.y - (float)j, part_k = at.z - (float)k;
    __global const VOXEL *corner = cells->voxels + voxel_index(i, j, k, cells->ni, cells->nj);
    const int row = cells->ni, slice = cells->ni * cells->nj;
#define EDGE(to) ((float)corner[to] + part_i * ((float)corner[(to) + 1] - (float)corner[to]))
    const float front = EDGE(0) + part_j * (EDGE(row) - EDGE(0));
    const float back = EDGE(slice) + part_j * (EDGE(slice + row) - EDGE(slice));
#undef EDGE
    return (front + part_k * (back - front)) * grid->scale.w + grid->shift.w;
}
#else
typedef struct {
    int unused;
} open_grid;

#define OPENNESS_PARAMETERS
#define OPENNESS_GRID { 0 }

static inline floats find_openness(const open_grid *grid, const floats i, const floats j, const floats k)
{
    return 1.0f;
}

static inline float read_openness(const open_grid *grid, const float4 place) { return 1.0f; }
#endif

#endif
