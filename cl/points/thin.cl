/* One point for each cell of a grid: the one nearest to the mean of the cell's points.
 *
 * Of n points p the one with the least |n p - sum|^2 is nearest to the mean: no quotient is needed, which devices round
 * differently.  Coordinates are relative to the cell's first point. */
#include "points/grid.h"

/* Parameters  x y z   in   (n,) sorted coordinates
 *             starts  in   (cells + 1,)
 *             order   in   (n,) number of the point at each place, ascending within a cell
 *             chosen  out  (cells,) number of the point nearest to the mean, the lowest of several
 *             cells   with points
 * Launch      global = cells rounded up by the host, any local
 * Guarantees  every element is written */
__kernel void choose_points(
    __global const float *restrict x, __global const float *restrict y, __global const float *restrict z,
    __global const uint *restrict starts, __global const uint *restrict order, __global uint *restrict chosen,
    const uint cells)
{
    const uint cell = get_global_id(0);
    if (cell >= cells)
        return;
    const uint begin = starts[cell], end = starts[cell + 1];
    const float first_x = x[begin], first_y = y[begin], first_z = z[begin], count = (float)(end - begin);
    float sum_x = 0.0f, sum_y = 0.0f, sum_z = 0.0f;
    for (uint at = begin; at < end; ++at) {
        sum_x += x[at] - first_x;
        sum_y += y[at] - first_y;
        sum_z += z[at] - first_z;
    }
    uint nearest = begin;
    float least = INFINITY;
    for (uint at = begin; at < end; ++at) {
        const float dx = count * (x[at] - first_x) - sum_x, dy = count * (y[at] - first_y) - sum_y,
                    dz = count * (z[at] - first_z) - sum_z;
        const float square = dx * dx + dy * dy + dz * dz;
        nearest = square < least ? at : nearest;
        least = square < least ? square : least;
    }
    chosen[cell] = order[nearest];
}
