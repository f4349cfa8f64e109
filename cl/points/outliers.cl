/* Distances of points to their neighbours, for outliers and for the spacing of a cloud.
 *
 * Reference: R. B. Rusu, Z. C. Marton, N. Blodow, M. Dolha, M. Beetz, "Towards 3D point cloud based object maps for
 * household environments", 2008, section 4: outliers by the mean distance to the neighbours.
 *
 * Passes
 *   1. measure_distances    for each part of the points, after list_neighbours */

#include "points/near_rows.h"

/* Parameters  x y z      in   (points) mm, sorted by cell
 *             order      in   (points) number of each point in the cloud
 *             neighbours in   (place_count, k) places of the neighbours, ascending by distance
 *             means      out  (points) mm, by the points' numbers: mean distance to the k - 1 other neighbours
 *             nearest    out  (points) mm, by the points' numbers: distance to the nearest other point
 *             k, first_place, place_count
 * Launch      global = ceil(place_count / LANES), rounded up by the host, any local
 * Assumes     nothing
 * Guarantees  both are written for every point of the part; 0 for k = 1 */
__kernel void measure_distances(
    __global const float *restrict x, __global const float *restrict y, __global const float *restrict z,
    __global const uint *restrict order, __global const int *restrict neighbours, __global float *restrict means,
    __global float *restrict nearest, const int k, const uint first_place, const uint place_count)
{
    const uint row = get_global_id(0) * LANES;
    if (row >= place_count)
        return;
    near_rows rows;
    take_rows(&rows, x, y, z, first_place, place_count, row, k);
    floats sum = 0.0f, second = 0.0f;
    for (int t = 1; t < k; ++t) {
        floats dx, dy, dz;
        neighbour_of_rows(x, y, z, neighbours, rows, t, &dx, &dy, &dz);
        const floats distance = sqrt(dx * dx + dy * dy + dz * dz);
        sum += distance;
        second = t == 1 ? distance : second;
    }
    scatter_rows(sum / (float)max(k - 1, 1), means, 1, order, first_place, row, place_count);
    scatter_rows(second, nearest, 1, order, first_place, row, place_count);
}
