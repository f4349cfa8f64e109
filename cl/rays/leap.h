/* Leaps of rays over empty space, by a map of the distance to the nearest visible brick.
 *
 * Distances of bricks to the nearest that shows something (0), in one plane of the map:
 *
 *      +---------+
 *      | 3  3  3 | 3  3  3
 *      | 3 [2] 2 | 2  2  2       A ray in brick [2] leaps to the face of the box around: of all bricks less than 2 off,
 *      | 3  2  1 | 1  1  2       from brick - 1 to brick + 1 along each axis.  None of them shows anything.
 *      +---------+
 *        3  2  1   0  1  2
 *        3  2  1   1  1  2 */
#ifndef CLRECON_LEAP_H
#define CLRECON_LEAP_H

#include "include/lanes.h"
#include "rays/stack.h"

#define BRICK_CELLS 4 /* of a brick along i and j; it reads a voxel more */
#define BRICKS_PER_CELL (1.0f / BRICK_CELLS)
#define FARTHEST 15 /* bricks that a leap goes at most: more take longer to prepare than they save; four bits hold it */

typedef struct {
    __global const uchar *distances; /* (bk, bj, bi) in bricks, 0 where something shows */
    int bi, bj, bk;
    int cells_k; /* of a brick along k: fewer where slices lie far apart */
} leap_map;

/* LANES rays: field coordinates of sample n are start + n * stride.  `pace` is samples per index step along each axis;
 * where slices lie at places of their own, the least that any layer has. */
typedef struct {
    floats start_i, start_j, start_k, stride_i, stride_j, stride_k, pace_i, pace_j, pace_k;
} ray_lanes;

/* Samples per index step: large, not infinite, for rays that do not move along an axis.  With UNEVEN `slope` is the
 * largest number of index steps along i, j and k that a mm of height makes. */
static inline void find_pace(ray_lanes *rays, const float4 slope)
{
#ifdef UNEVEN
    const floats rise = fabs(rays->stride_k);
    rays->pace_i = 1.0f / greater(fabs(rays->stride_i) + rise * slope.x, (floats)(1e-9f));
    rays->pace_j = 1.0f / greater(fabs(rays->stride_j) + rise * slope.y, (floats)(1e-9f));
    rays->pace_k = 1.0f / greater(rise * slope.z, (floats)(1e-9f));
#else
    rays->pace_i = 1.0f / choose(fabs(rays->stride_i) < 1e-9f, (floats)(1e-9f), rays->stride_i);
    rays->pace_j = 1.0f / choose(fabs(rays->stride_j) < 1e-9f, (floats)(1e-9f), rays->stride_j);
    rays->pace_k = 1.0f / choose(fabs(rays->stride_k) < 1e-9f, (floats)(1e-9f), rays->stride_k);
#endif
}

/* Samples along one axis to the face of the empty cube around `brick` that the ray runs to: that of the sign of `pace`,
 * which a stride that rounding left below 0 does not have. */
static inline floats count_to_face(
    const floats place, const floats pace, const ints brick, const ints distance, const int cells)
{
#ifdef UNEVEN
    const floats low = to_floats((brick - distance + 1) * cells);
    const floats high = to_floats((brick + distance) * cells);
    return lesser(place - low, high - place) * pace;
#else
    const ints face = choose(pace >= 0.0f, brick + distance, brick - distance + 1);
    return (to_floats(face * cells) - place) * pace;
#endif
}

/* Places of LANES rays, k from the first slice of the buffer, the bricks that they lie in, and the distance in bricks
 * to the nearest visible one: 0 in a visible brick. */
typedef struct {
    floats i, j, k;
    ints brick_i, brick_j, brick_k, distance;
} brick_lanes;

/* Bricks that sample n of each ray lies in, and their places in the map; beyond the bricks counts the nearest one. */
static inline ints place_bricks(const leap_map *map, const slice_stack *stack, const ray_lanes *rays, const floats n,
    const int first_k, brick_lanes *b)
{
    const float bricks_per_k = 1.0f / (float)map->cells_k;
    b->i = rays->start_i + n * rays->stride_i;
    b->j = rays->start_j + n * rays->stride_j;
    b->k = rays->start_k + n * rays->stride_k;
    to_indices(stack, &b->i, &b->j, &b->k);
    b->k -= (float)first_k;
    b->brick_i = lesser_int(greater_int(to_ints(b->i * BRICKS_PER_CELL), (ints)(0)), (ints)(map->bi - 1));
    b->brick_j = lesser_int(greater_int(to_ints(b->j * BRICKS_PER_CELL), (ints)(0)), (ints)(map->bj - 1));
    b->brick_k = lesser_int(greater_int(to_ints(b->k * bricks_per_k), (ints)(0)), (ints)(map->bk - 1));
    return (b->brick_k * map->bj + b->brick_j) * map->bi + b->brick_i;
}

/* Samples of each ray to the faces of a box that reaches so many bricks ahead along each axis, the own one counted. */
static inline floats count_to_box(const leap_map *map, const ray_lanes *rays, const brick_lanes *b, const ints reach_i,
    const ints reach_j, const ints reach_k)
{
    return lesser(lesser(count_to_face(b->i, rays->pace_i, b->brick_i, reach_i, BRICK_CELLS),
                      count_to_face(b->j, rays->pace_j, b->brick_j, reach_j, BRICK_CELLS)),
        count_to_face(b->k, rays->pace_k, b->brick_k, reach_k, map->cells_k));
}

/* Samples of each ray to the faces of the cube of empty bricks around it, a fraction; 0 in a visible brick. */
static inline floats count_to_faces(const leap_map *map, const ray_lanes *rays, const brick_lanes *b)
{
    const floats steps = count_to_box(map, rays, b, b->distance, b->distance, b->distance);
    /* Half a voxel before the first brick, which belongs to it, a face lies ahead of what shows too. */
    return choose(b->distance > 0, steps, (floats)(0.0f));
}

/* Number of samples of each ray, from number n on, in bricks that are more than `margin` bricks from a visible one; 0
 * where sample n is nearer. */
static inline floats count_free_steps(const leap_map *map, const slice_stack *stack, const ray_lanes *rays,
    const floats n, const int first_k, const int margin)
{
    brick_lanes b;
    const ints at = place_bricks(map, stack, rays, n, first_k, &b);
    b.distance = (ints)(GATHER(uchar, map->distances, at)) - margin;
    const floats steps = round_up(count_to_faces(map, rays, &b));
    return choose(b.distance > 0, greater(steps, (floats)(1.0f)), (floats)(0.0f));
}

/* True where the brick of a place is visible; k counts from the first slice of the buffer. */
static inline int is_shown(const leap_map *map, const float i, const float j, const float k)
{
    const int brick_i = clamp((int)(i * BRICKS_PER_CELL), 0, map->bi - 1);
    const int brick_j = clamp((int)(j * BRICKS_PER_CELL), 0, map->bj - 1);
    const int brick_k = clamp((int)(k / (float)map->cells_k), 0, map->bk - 1);
    return map->distances[(brick_k * map->bj + brick_j) * map->bi + brick_i] == 0;
}

#endif
