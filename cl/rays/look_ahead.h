/* Leaps along rows of empty bricks, in the direction of most of a picture's rays.
 *
 * Near visible bricks the cubes of rays/leap.h are small, but many bricks ahead may be empty.  Rays drift to the side
 * on their way, so the rows beside a brick's own must be empty too, on the side of the drift.
 *
 *      main axis -->                                  an entry of the map of ways, bit by bit
 *      beside     .  .  .  .  #   # shows something   7 ............. 4   3 ............. 0
 *      own row    o  .  .  .  .  #                    AHEAD_OF()          DISTANCE_OF(), see rays/leap.h
 *                 4  3  2  1  0  0   AHEAD_OF() of the own row: bricks that are free, the own one counted */
#ifndef CLRECON_LOOK_AHEAD_H
#define CLRECON_LOOK_AHEAD_H

#include "rays/leap.h"

/* The main axis of a picture and its direction along it, 1 or -1.  `eye` is the camera's place in bricks, or with w = 0
 * the direction of all rays.  Rows drift aside from it that are more than `aside` off it. */
typedef struct {
    int axis, ahead;
    float4 eye;
    float aside;
} main_way;

/* Bits of a brick's entry in a map of ways: distance to what shows, and bricks that are free ahead of it. */
#define DISTANCE_OF(way) ((way) & FARTHEST)
#define AHEAD_OF(way) ((way) >> 4)

static inline floats offset_from_eye(const ints brick, const float eye, const float is_place)
{
    return is_place > 0.0f ? to_floats(brick) + 0.5f - eye : (floats)(eye);
}

/* Bricks aside, the own one counted, that are free with it on the side that rays go to. */
static inline ints reach_aside(const main_way *way, const ints brick, const float eye, const floats stride)
{
    const floats offset = offset_from_eye(brick, eye, way->eye.w);
    return choose((fabs(offset) > way->aside) & (offset * stride > 0.0f), (ints)(2), (ints)(1));
}

/* Samples of each ray to the end of the rows of bricks that are free ahead of it, a fraction; 0 where there are none.
 * `free`: AHEAD_OF() its brick. */
static inline floats count_ahead(
    const leap_map *map, const main_way *way, const ray_lanes *rays, const brick_lanes *b, const ints free)
{
#ifdef UNEVEN
    return 0.0f; /* rays are no lines among the bricks */
#else
    const ints reach_i = way->axis == 0 ? free : reach_aside(way, b->brick_i, way->eye.x, rays->stride_i);
    const ints reach_j = way->axis == 1 ? free : reach_aside(way, b->brick_j, way->eye.y, rays->stride_j);
    const ints reach_k = way->axis == 2 ? free : reach_aside(way, b->brick_k, way->eye.z, rays->stride_k);
    const floats steps = count_to_box(map, rays, b, reach_i, reach_j, reach_k);
    const floats stride = way->axis == 0 ? rays->stride_i : way->axis == 1 ? rays->stride_j : rays->stride_k;
    return choose((free > 0) & (stride * (float)way->ahead > 0.0f), steps, (floats)(0.0f));
#endif
}

/* The brick beside one that rays through it drift to, along one axis of `count` bricks; the same where they do not.
 * All bricks of a row along the main axis drift to the same side, so that what is free beside one of them goes on
 * beside the next. */
static inline int find_beside(const main_way *way, const int brick, const float eye, const int count)
{
    const float offset = way->eye.w > 0.0f ? (float)brick + 0.5f - eye : eye;
    if (!(fabs(offset) > way->aside))
        return brick;
    return offset > 0.0f ? (brick + 1 < count ? brick + 1 : brick) : (brick > 0 ? brick - 1 : brick);
}

#endif
