/* Where the rays of a tile of pixels can first meet something that shows: found once for all of them.
 *
 * The ray in the middle of the tile leaps, and the empty space around it must reach as far as the others are away. */
#include "include/leap.h"
#include "include/stack.h"
#include "include/view.h"

/* Parameters  leaps    in   (bk, bj, bi) Chebyshev distance in bricks to what shows, 0: shows
 *             view     in   see include/view.h; its box is as much larger as rays may be away from the middle one
 *             entries  out  (tile rows, tile columns) t in mm before which no ray of the tile meets anything,
 *                           MAXFLOAT: none does
 *             bi bj bk bricks, cells_k of each along k;  first_k: slice that they begin with
 *             margin   bricks that rays of a tile may be away from the middle one
 *             width height     of the picture
 * Launch      global = tiles / LANES rounded up by the host, any local
 * Guarantees  every entry is written */
__kernel void enter_tiles(
    __global const uchar *restrict leaps, __global const float4 *restrict view, __global float *restrict entries,
    const float4 slope, const int bi, const int bj, const int bk, const int cells_k, const int first_k,
    const int margin,
    const uint width, const uint height, const int perspective STACK_PARAMETERS)
{
    const uint first_tile = (uint)get_global_id(0) * LANES;
    const uint columns = (width + TILE - 1) / TILE, tiles = columns * ((height + TILE - 1) / TILE);
    const leap_map map = { leaps, bi, bj, bk, cells_k };
    const slice_stack stack = STACK_TABLE;
    const float ray_step = view[VIEW_NEAR].y;
    float lane_of[6][LANES], t_of[LANES], ends[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const uint tile = min(first_tile + (uint)lane, tiles - 1);
        const float2 middle = (float2)((float)(tile % columns * TILE), (float)(tile / columns * TILE))
            + 0.5f * (float)(TILE - 1);
        ray way;
        start_ray(view, middle, 0, perspective, &way);
        const float4 start = way.origin + way.t_in * way.step;
        lane_of[0][lane] = start.x;
        lane_of[1][lane] = start.y;
        lane_of[2][lane] = start.z;
        lane_of[3][lane] = ray_step * way.step.x;
        lane_of[4][lane] = ray_step * way.step.y;
        lane_of[5][lane] = ray_step * way.step.z;
        t_of[lane] = way.t_in;
        ends[lane] = way.t_out > way.t_in ? (way.t_out - way.t_in) / ray_step : 0.0f;
    }
    ray_lanes course;
    course.start_i = load_lanes(lane_of[0]);
    course.start_j = load_lanes(lane_of[1]);
    course.start_k = load_lanes(lane_of[2]);
    course.stride_i = load_lanes(lane_of[3]);
    course.stride_j = load_lanes(lane_of[4]);
    course.stride_k = load_lanes(lane_of[5]);
    find_pace(&course, slope);
    const floats end = load_lanes(ends);
    floats n = 0.0f;
    for (;;) {
        const floats free = count_free_steps(&map, &stack, &course, n, first_k, margin);
        const ints leaping = (free > 0.0f) & (n < end);
        if (!ANY_LANE(leaping))
            break;
        n = choose(leaping, n + free, n);
    }
    store_lanes(n, lane_of[0]);
    for (int lane = 0; lane < LANES; ++lane)
        if (first_tile + (uint)lane < tiles)
            /* A leap ends on the far side of a face: the step before it may have been short of it. */
            entries[first_tile + lane] = lane_of[0][lane] < ends[lane]
                ? t_of[lane] + max(lane_of[0][lane] - 1.0f, 0.0f) * ray_step : MAXFLOAT;
}
