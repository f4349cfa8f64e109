/* Start of the rays of a tile of pixels: the first place that may be visible, found once for all rays of the tile.
 *
 * The ray in the middle of the tile leaps, and the empty space around it must include the other rays. */
#include "rays/leap.h"
#include "rays/ray_packet.h"
#include "rays/stack.h"
#include "rays/view.h"

/* Parameters  leaps    in   (bk, bj, bi) Chebyshev distance in bricks to the nearest visible one, 0 where this one is
 *             view     in   see rays/view.h; its box is as much larger as rays may be away from the middle one
 *             entries  out  (tile rows, tile columns) t in mm before which nothing on the rays of the tile is visible,
 *                           MAXFLOAT where nothing is
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
    float x_of[LANES], y_of[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const uint tile = min(first_tile + (uint)lane, tiles - 1);
        x_of[lane] = (float)(tile % columns * TILE) + 0.5f * (float)(TILE - 1);
        y_of[lane] = (float)(tile / columns * TILE) + 0.5f * (float)(TILE - 1);
    }
    ray_packet middle;
    start_packet(view, load_lanes(x_of), load_lanes(y_of), 0, perspective, &middle);
    ray_lanes course;
    lay_course(&middle, middle.t_in, (floats)(ray_step), slope, &course);
    const floats end = choose(middle.t_out > middle.t_in, (middle.t_out - middle.t_in) / ray_step, (floats)(0.0f));
    floats n = 0.0f;
    for (;;) {
        const floats free = count_free_steps(&map, &stack, &course, n, first_k, margin);
        const ints leaping = (free > 0.0f) & (n < end);
        if (!ANY_LANE(leaping))
            break;
        n = choose(leaping, n + free, n);
    }
    /* A leap ends on the far side of a face: the step before it may have been short of it. */
    float entry_of[LANES];
    const floats before = greater(n - 1.0f, (floats)(0.0f));
    store_lanes(choose(n < end, middle.t_in + before * ray_step, (floats)(MAXFLOAT)), entry_of);
    for (int lane = 0; lane < LANES; ++lane)
        if (first_tile + (uint)lane < tiles)
            entries[first_tile + lane] = entry_of[lane];
}
