/* LANES points at once with their neighbours, which list_neighbours wrote as places in the sorted order:
 *
 *      lane             0      1      2   ...                     step t takes the t-th neighbour of every lane
 *      neighbours    row k, row k + k, row k + 2 k ...  + t
 *
 * All sums run over the neighbours in their order, so that one lane gives what eight give. */
#ifndef CLRECON_NEAR_ROWS_H
#define CLRECON_NEAR_ROWS_H

#include "include/lanes.h"

#define MOST_NEIGHBOURS 128

typedef struct {
    ints first; /* entry of the first neighbour of each lane */
    floats px, py, pz;
} near_rows;

#if LANES == 8
#define LANE_STEPS ((ints)(0, 1, 2, 3, 4, 5, 6, 7))
#else
#define LANE_STEPS 0
#endif

/* Rows `row` and following, one a lane; lanes beyond the last row repeat it. */
static inline ints own_rows(const uint row, const uint rows)
{
    return lesser_int((ints)((int)row) + LANE_STEPS, (ints)((int)rows - 1));
}

/* Take the points of rows `row` and following.  The struct is not returned: of that Oclgrind's compiler makes an
 * intrinsic that it does not know. */
static inline void take_rows(
    near_rows *rows, __global const float *x, __global const float *y, __global const float *z, const uint first_place,
    const uint place_count, const uint row, const int k)
{
    const ints own = own_rows(row, place_count);
    const ints place = own + (ints)((int)first_place);
    rows->first = own * (ints)(k);
    rows->px = (floats)(GATHER(float, x, place));
    rows->py = (floats)(GATHER(float, y, place));
    rows->pz = (floats)(GATHER(float, z, place));
}

/* Differences of the t-th neighbour of each lane from its point. */
static inline void neighbour_of_rows(
    __global const float *x, __global const float *y, __global const float *z, __global const int *neighbours,
    const near_rows rows, const int t, floats *dx, floats *dy, floats *dz)
{
    const ints entry = rows.first + (ints)(t);
    const ints near = (ints)(GATHER(int, neighbours, entry));
    *dx = (floats)(GATHER(float, x, near)) - rows.px;
    *dy = (floats)(GATHER(float, y, near)) - rows.py;
    *dz = (floats)(GATHER(float, z, near)) - rows.pz;
}

/* Height of the points over their t-th neighbours along their normals, and the squares of the distances. */
static inline void height_of_row(
    __global const float *x, __global const float *y, __global const float *z, __global const int *neighbours,
    const near_rows rows, const int t, const floats nx, const floats ny, const floats nz, floats *height,
    floats *square)
{
    floats dx, dy, dz;
    neighbour_of_rows(x, y, z, neighbours, rows, t, &dx, &dy, &dz);
    *height = -(dx * nx + dy * ny + dz * nz);
    *square = dx * dx + dy * dy + dz * dz;
}

/* Store one number for each row; lanes beyond the last row store nothing. */
static inline void store_rows(const floats values, __global float *to, const uint row, const uint rows)
{
#if LANES == 8
    if (row + 8u > rows) {
        float lane_of[8];
        vstore8(values, 0, lane_of);
        for (uint lane = 0; lane < rows - row; ++lane)
            to[row + lane] = lane_of[lane];
        return;
    }
#endif
    store_lanes(values, to + row);
}

/* Store one number for each row at the entry that `order` has for it, of entries of `size` numbers. */
static inline void scatter_rows(
    const floats values, __global float *to, const size_t size, __global const uint *order,
    const uint first_place, const uint row, const uint rows)
{
    float lane_of[LANES];
    store_lanes(values, lane_of);
    for (uint lane = 0; lane < min((uint)LANES, rows - row); ++lane)
        to[(size_t)order[first_place + row + lane] * size] = lane_of[lane];
}

#endif
