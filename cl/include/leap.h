/* A map of how far around nothing shows, and leaps along rays with it. */
#ifndef CLRECON_LEAP_H
#define CLRECON_LEAP_H

#define BRICK_CELLS 8 /* cells along each side of a brick: it reads 9 x 9 x 9 voxels */

typedef struct {
    __global const uchar *distances;
    int bi, bj, bk;
} leap_map;

/* Steps of `stride` from `from` that end in empty bricks; 0 where the brick of `from` shows. */
static inline int count_free_steps(const leap_map *map, const float4 from, const float4 stride)
{
    const int4 cell = convert_int4(fmax(from, (float4)(0.0f)));
    const int4 brick = min(cell / BRICK_CELLS, (int4)(map->bi - 1, map->bj - 1, map->bk - 1, 0));
    const int distance = map->distances[(brick.z * map->bj + brick.y) * map->bi + brick.x];
    if (distance == 0)
        return 0;
    /* The cube of bricks less than `distance` away is empty. */
    const float4 low = convert_float4((brick - (distance - 1)) * BRICK_CELLS);
    const float4 high = convert_float4((brick + distance) * BRICK_CELLS);
    const float4 room = select(low - from, high - from, stride >= 0.0f);
    const float4 steps = room / select(stride, (float4)(1e-12f), fabs(stride) < (float4)(1e-12f));
    return max(1, (int)ceil(fmin(fmin(fmin(steps.x, steps.y), steps.z), 1e6f)));
}

#endif
