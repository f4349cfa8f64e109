/* Trilinear samples at places in fixed point: index coordinates in units of 2^-32 of a voxel.
 *
 * A place on a voxel is exactly on it, however far from the picture's first pixel: its value is the voxel's own.  The
 * box of a volume runs half a voxel beyond the outer centres, where the nearest value goes on. */
#ifndef CLRECON_TRILINEAR_SAMPLE_H
#define CLRECON_TRILINEAR_SAMPLE_H

#include "include/volume.h"

#define FIXED_HALF 0x80000000L
#define FIXED_EDGE 0x1000L /* 2^-20 of a voxel: what rounding may add to a pixel on the box's face */

/* True where a coordinate lies within the box of n voxels. */
static inline int is_within(const long place, const int n)
{
    return place >= -FIXED_HALF - FIXED_EDGE && place <= ((long)(n - 1) << 32) + FIXED_HALF + FIXED_EDGE;
}

/* The coordinate, or that of the nearest voxel centre beyond the outer ones. */
static inline long clamp_place(const long place, const int n)
{
    const long last = (long)(n - 1) << 32;
    return place < 0 ? 0 : place > last ? last : place;
}

/* Between a and b, at share f of the way. */
static inline float blend(const float a, const float b, const float f)
{
    return a + (b - a) * f;
}

/* Value at (i, j), clamped places, of the slices that begin at `lower` and `upper`, at share fk between them.
 * A voxel without weight is never read. */
static inline float sample_trilinear(
    __global const VOXEL *lower, __global const VOXEL *upper, const long i, const long j, const float fk,
    const int ni)
{
    const float scale = 1.0f / 4294967296.0f;
    const float fi = (float)(uint)i * scale, fj = (float)(uint)j * scale;
    const size_t row = voxel_index(0, (int)(j >> 32), 0, ni, 0), next_row = fj > 0.0f ? row + (size_t)ni : row;
    const size_t at = (size_t)(i >> 32), next = fi > 0.0f ? at + 1 : at;
    const float low
        = blend(blend((float)lower[row + at], (float)lower[row + next], fi),
                blend((float)lower[next_row + at], (float)lower[next_row + next], fi), fj);
    const float high
        = blend(blend((float)upper[row + at], (float)upper[row + next], fi),
                blend((float)upper[next_row + at], (float)upper[next_row + next], fi), fj);
    return blend(low, high, fk);
}

#endif
