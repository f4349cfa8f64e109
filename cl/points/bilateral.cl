/* Bilateral filter of points along their normals.
 *
 * A point moves along its normal to the weighted mean of its neighbours' heights h_j = <p - p_j, n>,
 *
 *      beta = sum_j Wc(|p - p_j|) Ws(|h_j|) h_j / sum_j Wc Ws,      p' = p - beta n,
 *
 * with Gaussians Wc of sigma_c, the distance to the kth neighbour, and Ws of sigma_s, a factor times the standard
 * deviation of the heights.  The sign of n cancels.  Where sigma_s is below 1e-6 mm the point stays.
 *
 * Reference: S. Fleishman, I. Drori, D. Cohen-Or, "Bilateral mesh denoising", 2003, for a point and its neighbours; the
 * paper of the grid and its eq. 3 to 5 are named in clrecon/proof/points/neighbours.py.
 *
 * Passes
 *   1. filter_points    for each part of the points, after list_neighbours and fit_planes
 *   2. filter_cells     where points that are no features take the mean over their whole cell */

#include "points/near_cells.h"
#include "points/near_rows.h"

#define LEAST_RANGE 1e-6f

/* Numbers that filter_points leaves for each point: normal, sigma_c, sigma_s, variation. */
#define PLANE_NUMBERS 6

/* Heights and squares of distances are needed twice: CPUs keep them, GPUs find them again, which takes no memory. */
#if LANES == 8
#define KEPT_NEIGHBOURS MOST_NEIGHBOURS
static inline void keep_height(floats *heights, floats *squares, const int t, const floats height, const floats square)
{
    heights[t] = height;
    squares[t] = square;
}

static inline void height_again(
    __global const float *x, __global const float *y, __global const float *z, __global const int *neighbours,
    const near_rows rows, const int t, const floats nx, const floats ny, const floats nz, const floats *heights,
    const floats *squares, floats *height, floats *square)
{
    *height = heights[t];
    *square = squares[t];
}
#else
#define KEPT_NEIGHBOURS 1
static inline void keep_height(floats *heights, floats *squares, const int t, const floats height, const floats square)
{
}

static inline void height_again(
    __global const float *x, __global const float *y, __global const float *z, __global const int *neighbours,
    const near_rows rows, const int t, const floats nx, const floats ny, const floats nz, const floats *heights,
    const floats *squares, floats *height, floats *square)
{
    height_of_row(x, y, z, neighbours, rows, t, nx, ny, nz, height, square);
}
#endif

/* Parameters  x y z      in   (points) mm, sorted by cell
 *             order      in   (points) number of each point in the cloud
 *             neighbours in   (place_count, k) places of the neighbours, ascending by distance
 *             normals    in   (3, place_count) unit vectors, or zero: the point stays
 *             variations in   (place_count) of fit_planes
 *             moves      out  (points, 3) mm, by the points' numbers: - beta n
 *             planes     out  keep_planes: (points, PLANE_NUMBERS) by the points' numbers; else not written
 *             range_factor   sigma_s over the standard deviation of the heights
 *             keep_planes, k, first_place, place_count
 * Launch      global = ceil(place_count / LANES), rounded up by the host, any local
 * Assumes     k at most MOST_NEIGHBOURS
 * Guarantees  every point of the part is written */
__kernel void filter_points(
    __global const float *restrict x, __global const float *restrict y, __global const float *restrict z,
    __global const uint *restrict order, __global const int *restrict neighbours,
    __global const float *restrict normals, __global const float *restrict variations, __global float *restrict moves,
    __global float *restrict planes, const float range_factor, const int keep_planes, const int k,
    const uint first_place, const uint place_count)
{
    const uint row = get_global_id(0) * LANES;
    if (row >= place_count)
        return;
    near_rows rows;
    take_rows(&rows, x, y, z, first_place, place_count, row, k);
    const ints own = own_rows(row, place_count);
    const floats nx = (floats)(GATHER(float, normals, own));
    const floats ny = (floats)(GATHER(float, normals + place_count, own));
    const floats nz = (floats)(GATHER(float, normals + 2 * (size_t)place_count, own));
    floats heights[KEPT_NEIGHBOURS], squares[KEPT_NEIGHBOURS];
    floats sum = 0.0f, sum_of_squares = 0.0f, farthest = 0.0f;
    for (int t = 0; t < k; ++t) {
        floats height, square;
        height_of_row(x, y, z, neighbours, rows, t, nx, ny, nz, &height, &square);
        keep_height(heights, squares, t, height, square);
        sum += height;
        sum_of_squares += height * height;
        farthest = square;
    }
    const float share = 1.0f / (float)k;
    const floats mean = sum * share;
    const floats spread = sqrt(greater(sum_of_squares * share - mean * mean, (floats)(0.0f)));
    const floats sigma_c = sqrt(farthest), sigma_s = range_factor * spread;
    const ints moving = (sigma_s >= LEAST_RANGE) & (farthest > 0.0f);
    const floats far = choose(moving, -0.5f / farthest, (floats)(0.0f));
    const floats high = choose(moving, -0.5f / (sigma_s * sigma_s), (floats)(0.0f));
    floats above = 0.0f, below = 1.0f; /* the first neighbour is at the point itself: height 0, weight 1 */
    for (int t = 1; t < k; ++t) {
        floats height, square;
        height_again(x, y, z, neighbours, rows, t, nx, ny, nz, heights, squares, &height, &square);
        const floats weight = exp(square * far + height * height * high);
        above += weight * height;
        below += weight;
    }
    const floats move = choose(moving, -above / below, (floats)(0.0f));
    scatter_rows(move * nx, moves, 3, order, first_place, row, place_count);
    scatter_rows(move * ny, moves + 1, 3, order, first_place, row, place_count);
    scatter_rows(move * nz, moves + 2, 3, order, first_place, row, place_count);
    if (keep_planes) {
        const floats variation = (floats)(GATHER(float, variations, own));
        scatter_rows(nx, planes, PLANE_NUMBERS, order, first_place, row, place_count);
        scatter_rows(ny, planes + 1, PLANE_NUMBERS, order, first_place, row, place_count);
        scatter_rows(nz, planes + 2, PLANE_NUMBERS, order, first_place, row, place_count);
        scatter_rows(sigma_c, planes + 3, PLANE_NUMBERS, order, first_place, row, place_count);
        scatter_rows(sigma_s, planes + 4, PLANE_NUMBERS, order, first_place, row, place_count);
        scatter_rows(variation, planes + 5, PLANE_NUMBERS, order, first_place, row, place_count);
    }
}

/* Parameters  x y z      in   (points) mm, sorted by the cells of which the means are taken
 *             order      in   (points) number of each point in the cloud
 *             starts     in   (cells + 1) first point of each occupied cell
 *             planes     in   (points, PLANE_NUMBERS) of filter_points
 *             features   in   (points) by number; 1: the point keeps the move that it has
 *             moves      inout (points, 3) mm, by number
 *             cells, points
 * Launch      global = points rounded up by the host, any local
 * Assumes     nothing
 * Guarantees  the move of every point that is no feature is written */
__kernel void filter_cells(
    __global const float *restrict x, __global const float *restrict y, __global const float *restrict z,
    __global const uint *restrict order, __global const uint *restrict starts, __global const float *restrict planes,
    __global const uchar *restrict features, __global float *restrict moves, const uint cells, const uint points)
{
    const size_t place = get_global_id(0);
    if (place >= points)
        return;
    const size_t number = order[place];
    if (features[number])
        return;
    __global const float *plane = planes + PLANE_NUMBERS * number;
    const float nx = plane[0], ny = plane[1], nz = plane[2], sigma_c = plane[3], sigma_s = plane[4];
    float move = 0.0f;
    if (sigma_s >= LEAST_RANGE && sigma_c > 0.0f) {
        const float far = -0.5f / (sigma_c * sigma_c), high = -0.5f / (sigma_s * sigma_s);
        const uint cell = cell_of_place(starts, cells, (uint)place);
        float above = 0.0f, below = 0.0f;
        for (uint other = starts[cell]; other < starts[cell + 1]; ++other) {
            const float dx = x[other] - x[place], dy = y[other] - y[place], dz = z[other] - z[place];
            const float height = -(dx * nx + dy * ny + dz * nz);
            const float weight = exp((dx * dx + dy * dy + dz * dz) * far + height * height * high);
            above += weight * height;
            below += weight;
        }
        move = -above / below;
    }
    vstore3((float3)(move * nx, move * ny, move * nz), number, moves);
}
