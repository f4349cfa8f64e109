/* With -D BETWEEN: rays that count only between two depths of each pixel, see cl/rays/layers.cl. */
#ifndef CLRECON_BETWEEN_H
#define CLRECON_BETWEEN_H

#include "rays/ray_packet.h"

#ifdef BETWEEN
#define BETWEEN_PARAMETERS , __global const float *restrict nearest, __global const float *restrict farthest
#define BETWEEN_ARGUMENTS , nearest, farthest

/* Shorten the ways of rays to what lies between two depths.  The ends of a way stay finite. */
static inline void shorten_ways(__global const float *nearest, __global const float *farthest, const int2 first_pixel,
    const int2 size, ray_packet *way)
{
    float begin_of[LANES], end_of[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const int inside = first_pixel.x + lane < size.x && first_pixel.y < size.y;
        const size_t place = (size_t)first_pixel.y * (size_t)size.x + (size_t)(first_pixel.x + lane);
        begin_of[lane] = inside ? nearest[place] : 0.0f;
        end_of[lane] = inside ? farthest[place] : 0.0f;
    }
    const floats begin = load_lanes(begin_of) - way->offset, end = load_lanes(end_of) - way->offset;
    way->t_in = lesser(greater(way->t_in, begin), way->t_out);
    way->t_out = greater(lesser(way->t_out, end), way->t_in);
}
#else
#define BETWEEN_PARAMETERS
#define BETWEEN_ARGUMENTS
#endif

#endif
